"""A raw CT scan made from strands: what a scanner would see of that wig on a mannequin (supplement, section 3; EVALUATION.md).

Goes slab by slab from strands to the file, so that memory follows one slab; noise is a hash of the voxel's number, so that
slabs and threads change no bit of it.
"""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from scipy.special import ndtri

from ..errors import ScanError, SettingsError
from ..head import Head, HeadMesh, fit_to_roots, template_head
from ..measure import allowed_memory
from ..progress import Progress, part, silent
from ..settings import SynthesisSettings
from ..strands import Strands, concatenate
from ..volume import BRICK, ScanWriter
from ..volume.writers import scan_format
from .curves import curve_arcs
from .density import frame_around, render_layers, strand_peak
from .distance_field import DistanceField, lattice_value
from .hairnet import hairnet, knots

MANNEQUIN_LEVELS = {"shell": 12.0, "solid": 12.0, "foam": 0.3}
"""Density of the mannequin's materials in lone strands: plastic is far denser than hair, foam is near air."""

WITHOUT_ORIGIN = (".npy", ".raw")
"""Formats that hold no origin: the scan's first voxel becomes (0, 0, 0), and truth and head are moved with it."""

HAIR_SHARE = 0.35
"""A voxel counts as hair above this share of a lone strand's peak."""

_SLAB_BYTES = 256e6
"""Values of one slab on its way to the file, roughly."""

GRID_BYTES = 4.6
"""Memory a voxel of an OpenVDB grid of floats that is full."""

_FIELD_STEP = 1.0
"""Lattice (mm) of the mannequin's signed distance: ears and nose are curved over several millimetres."""

_NOISE_BITS = 16
_NOISE_TABLE = ndtri((np.arange(1 << _NOISE_BITS) + 0.5) / (1 << _NOISE_BITS)).astype(np.float32)
"""Quantiles of the normal distribution; two draws added reach over 6 standard deviations."""


@dataclass(frozen=True)
class Synthesis:
    """What `synthesize` wrote. truth: the strands as they lie in the scan's frame; head: likewise, or None.

    files: name ("scan", "strands", "head", "json") -> path. description: what the JSON says. tally: counts.
    """

    truth: Strands
    head: HeadMesh | None
    files: dict[str, Path]
    description: dict
    tally: dict[str, int]


def synthesize(
    strands: Strands,
    head: HeadMesh | None,
    out: str | os.PathLike,
    spacing: float,
    *,
    settings: SynthesisSettings | None = None,
    progress: Progress = silent,
    **changes,
) -> Synthesis:
    """Write a scan of strands (mm) on a head (same frame; None fits the template to the roots) with voxels of `spacing` mm.

    out: the ending picks the format (any that `ScanWriter` knows). Settings are those of `SynthesisSettings`, the defaults or
    `settings`, with `changes` by name on top: `synthesize(strands, head, "scan.nii.gz", 0.4, snr=2.0, seed=3)`. `mannequin`
    also takes True (shell) and False (none). A raw scan is uint16: air + strands, net and knots + mannequin + noise; `clean`
    is the blurred counts alone, float32.

    Beside the scan lie `STEM.strands.npz` (the truth), `STEM.head.obj` and `STEM.json` (how it was made), all in the scan's
    frame. Raises SettingsError, HeadError, ScanError.
    """
    if isinstance(changes.get("mannequin"), bool):
        changes["mannequin"] = "shell" if changes["mannequin"] else "none"
    chosen = (settings or SynthesisSettings()).changed(changes)
    if not spacing > 0.0:
        raise SettingsError(f"the voxel size must be over 0 mm, got {spacing}")
    if not len(strands.points):
        raise SettingsError("there are no strands to make a scan of")
    out = Path(out)
    raw = not chosen.clean
    if head is None:
        head = fit_to_roots(template_head(), strands.roots).head
    surface = Head(head) if raw and (chosen.net or chosen.mannequin != "none") else None

    origin, shape = _box(strands, head if raw and chosen.mannequin != "none" else None, spacing, chosen)
    if raw and scan_format(out) == ".vdb":
        _check_grid(out, shape)
    if scan_format(out) in WITHOUT_ORIGIN:
        shift = np.eye(4)
        shift[:3, 3] = -origin
        strands, head, origin = strands.transformed(shift), head.transformed(shift), np.zeros(3)
        surface = Head(head) if surface is not None else None
    else:
        shift = np.eye(4)

    seen = [strands]
    tally = {"strands": len(strands)}
    if raw and chosen.net:
        net = hairnet(surface, chosen.net_cell or 10.0 * spacing, chosen.net_height, chosen.seed)
        tally["threads of the net"] = len(net)
        seen.append(Strands(net.points, net.offsets))
        if chosen.knot_level > 0.0:
            seen.append(knots(strands.roots, spacing, chosen.knot_level, max(chosen.blur, 0.5), chosen.seed))
            tally["knots"] = len(strands)
    content = concatenate([Strands(each.points, each.offsets) for each in seen])

    thickness = max(1, int(_SLAB_BYTES / (4.0 * shape[0] * shape[1] * BRICK)))
    layers = -(-shape[2] // BRICK)
    thickness = min(thickness, layers)
    make = _raw_slabs if raw else _clean_slabs
    dtype = np.uint16 if raw else np.float32
    hair = 0
    with ScanWriter(out, shape, spacing, origin, dtype) as writer:
        field = None
        if raw and chosen.mannequin != "none":
            high = origin + (np.asarray(shape) - 1) * spacing
            field = DistanceField.around(surface, origin, high, max(_FIELD_STEP, spacing), part(progress, 0.0, 0.1))
        arcs = curve_arcs(content)
        for first in range(0, layers, thickness):
            last = min(first + thickness, layers)
            share = part(progress, 0.1 + 0.9 * first / layers, 0.1 + 0.9 * last / layers)
            density = render_layers(content, arcs, spacing, chosen.blur, origin, shape, first, last, part(share, 0.0, 0.5))
            slab, count = make(density, field, shape, spacing, first, last, chosen, part(share, 0.5, 0.9))
            hair += count
            writer.write_slab(first * BRICK, slab)
            share(1, 1)
    tally["hair voxels"] = hair

    stem = out.name[: -len(scan_format(out))]
    files = {
        "scan": out,
        "strands": out.with_name(f"{stem}.strands.npz"),
        "head": out.with_name(f"{stem}.head.obj"),
        "json": out.with_name(f"{stem}.json"),
    }
    strands.save(files["strands"])
    head.save(files["head"])
    description = {
        "made by": "ct2hair synthesize",
        "scan": out.name,
        "strands": len(strands),
        "spacing_mm": spacing,
        "origin_mm": origin.tolist(),
        "shape": list(shape),
        "moved_by_mm": shift[:3, 3].tolist(),
        "fill_mm2": len(strands) * spacing * spacing,
        "hair_voxels": int(hair),
        "value_of_air": chosen.air if raw else 0.0,
        "noise": chosen.strand / chosen.snr if raw else 0.0,
        "lone_strand_above_air": chosen.strand if raw else strand_peak(chosen.blur) if chosen.blur else None,
        "mannequin_above_air": _mannequin_value(chosen) if raw else 0.0,
        "settings": dataclasses.asdict(chosen),
        "tally": tally,
    }
    beside = files["json"].with_name(f".{files['json'].name}.part")
    beside.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
    beside.replace(files["json"])
    return Synthesis(strands, head, files, description, tally)


def _check_grid(out: Path, shape: tuple[int, ...]) -> None:
    """Refuse a raw scan as a grid that no memory holds: noise fills every voxel, and OpenVDB's writer takes it whole."""
    needed, allowed = GRID_BYTES * float(np.prod(shape, dtype=np.float64)) / 1e9, allowed_memory()
    if needed > allowed:
        raise ScanError(
            f"{out}: a raw scan of {shape[0]} x {shape[1]} x {shape[2]} voxels takes {needed:.1f} GB as a grid, and "
            f"{allowed:.1f} GB of memory are there for it; write a .nrrd, which goes to the disk slab by slab, or a clean scan"
        )


def _mannequin_value(settings: SynthesisSettings) -> float:
    """The mannequin's value above air."""
    if settings.mannequin == "none":
        return 0.0
    return settings.strand * (settings.mannequin_level or MANNEQUIN_LEVELS[settings.mannequin])


def _box(strands: Strands, head: HeadMesh | None, spacing: float, settings: SynthesisSettings):
    """(origin, shape) around the hair and, where there is a mannequin, its head and neck; not its shoulders."""
    points = strands.points
    if head is not None:
        scalp = head.vertices[head.scalp] if head.scalp.any() else strands.roots
        centre = (scalp.min(axis=0) + scalp.max(axis=0)) / 2
        reach = 1.4 * np.linalg.norm(scalp - centre, axis=1).max()
        near = np.linalg.norm(head.vertices - centre, axis=1) < reach
        points = np.concatenate([points, head.vertices[near]])
    return frame_around(points, spacing, settings.margin + 4.0 * settings.blur * spacing)


def _clean_slabs(density, field, shape, spacing, first, last, settings, progress):
    """(float32 slab, hair voxels) of the blurred counts."""
    depth = min(last * BRICK, shape[2]) - first * BRICK
    slab = density.block((0, 0, 0), (shape[0], shape[1], depth))
    return slab, int(np.count_nonzero(slab > HAIR_SHARE * strand_peak(settings.blur or 1.0)))


def _raw_slabs(density, field, shape, spacing, first, last, settings, progress):
    """(uint16 slab, hair voxels) of what the scanner sees."""
    depth = min(last * BRICK, shape[2]) - first * BRICK
    slab = np.empty((shape[0], shape[1], depth), np.uint16)
    blur = settings.blur or 1.0
    counts = np.zeros(shape[0], np.int64)
    values = field.values if field is not None else np.zeros((2, 2, 2), np.float32)
    mannequin = _mannequin_value(settings) if field is not None else 0.0
    wall = settings.mannequin_thickness if settings.mannequin == "shell" else 0.0
    noise = settings.strand / settings.snr
    rows = max(1, int(16e6 / (shape[1] * depth)))
    for start in range(0, shape[0], rows):
        progress(start, shape[0])
        _scan_rows(
            density.table,
            density.bricks,
            np.int64(start),
            np.int64(min(start + rows, shape[0])),
            np.int64(first * BRICK),
            np.array(shape, np.int64),
            settings.strand / strand_peak(blur),
            HAIR_SHARE * strand_peak(blur),
            values,
            spacing / (field.step if field is not None else 1.0),
            mannequin,
            wall,
            field.step if field is not None else 1.0,
            max(settings.blur, 0.3) * spacing,
            settings.air,
            noise,
            settings.rings * noise,
            np.uint64(_mix(settings.seed)),
            _NOISE_TABLE,
            slab,
            counts,
        )
    return slab, int(counts.sum())


def _mix(seed: int) -> int:
    """A seed spread over 64 bits, so that neighbouring seeds share nothing."""
    return int(_splitmix(np.uint64(seed)))


@numba.njit(cache=True, inline="always")
def _splitmix(x):
    """The 64-bit finaliser of SplitMix (Steele, Lea and Flood 2014): a hash of a counter."""
    x = np.uint64(x) + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@numba.njit(cache=True, inline="always")
def _normal(key, number, quantiles):
    """A standard normal for a counter: the sum of two quantiles drawn by one hash."""
    bits = _splitmix(key ^ _splitmix(np.uint64(number)))
    return (quantiles[bits & np.uint64(0xFFFF)] + quantiles[(bits >> np.uint64(16)) & np.uint64(0xFFFF)]) * np.float32(
        0.70710678
    )


@numba.njit(cache=True, inline="always")
def _step(x):
    """A smooth step that follows the normal distribution function to 0.01 (logistic)."""
    return 1.0 / (1.0 + np.exp(-1.702 * x)) if x > -12.0 else 0.0


@numba.njit(cache=True, parallel=True)
def _scan_rows(
    table,
    bricks,
    start,
    end,
    first,
    shape,
    scale,
    hair,
    field,
    ratio,
    mannequin,
    wall,
    field_step,
    edge,
    air,
    noise,
    rings,
    key,
    quantiles,
    slab,
    hair_counts,
):
    """Fill slab[start:end]: air + counts + mannequin + rings + noise, rounded. hair_counts (nx,): hair voxels per row."""
    nothing = np.float32(0.0)
    centre_x, centre_y = 0.5 * (shape[0] - 1), 0.5 * (shape[1] - 1)
    ring_key = _splitmix(key + np.uint64(1))
    for i in numba.prange(start, end):
        for j in range(shape[1]):
            radius = np.int64(np.sqrt((i - centre_x) ** 2 + (j - centre_y) ** 2) + 0.5)
            row = np.int32(-1)
            hollow = False
            for k in range(slab.shape[2]):
                if k % 16 == 0:
                    row = table[i >> 4, j >> 4, k >> 4]
                    if mannequin > 0.0:
                        # a whole run of 16 voxels clear of the mannequin's surface needs no look at each
                        distance = lattice_value(field, i * ratio, j * ratio, (first + k + 8) * ratio)
                        clear = 8.0 * ratio * field_step + 4.0 * edge
                        hollow = distance > clear or (wall > 0.0 and distance < -wall - clear)
                value = air
                if row >= 0:
                    count = bricks[row, i & 15, j & 15, k & 15]
                    value += scale * count
                    if count > hair:
                        hair_counts[i] += 1
                if mannequin > 0.0 and not hollow:
                    distance = lattice_value(field, i * ratio, j * ratio, (first + k) * ratio)
                    share = _step(-distance / edge)
                    if wall > 0.0:
                        share -= _step(-(distance + wall) / edge)
                    value += mannequin * share
                if rings > 0.0:
                    value += rings * _normal(ring_key, radius + (first + k) * np.int64(100003), quantiles)
                if noise > 0.0:
                    value += noise * _normal(key, ((first + k) * shape[1] + j) * shape[0] + i, quantiles)
                slab[i, j, k] = np.uint16(min(max(value + 0.5, nothing), 65535.0))
