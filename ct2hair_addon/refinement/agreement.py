"""How well strands agree with the scan that they came from: voxel IoU, precision and recall without any truth at hand.

Both sides are brought to the same voxels and the same blur (EVALUATION.md: 1.25 and 2.5 times the scan's voxel, 0.8 voxel of
blur, hair above 0.35 of a lone strand's peak). Noise in the scan counts against the strands, so read these as a lower bound.
"""

from __future__ import annotations

import numba
import numpy as np

from ..progress import Progress, part, silent
from ..strands import Strands
from ..volume import BRICK, BrickVolume
from ..volume.strand_signal import StrandProfile
from .blur import CHUNK, blurred
from .splat import render

SCALES = (1.25, 2.5)
"""Voxel sizes of the comparison in units of the scan's (EVALUATION.md)."""
SCORE_BLUR = 0.8
"""Blur of the comparison, voxels (EVALUATION.md)."""
HAIR_SHARE = 0.35
"""A voxel is hair above this share of a lone strand's peak (EVALUATION.md)."""
LONE_PEAK = 1.0 / (2.0 * np.pi * SCORE_BLUR**2)
"""Peak of a lone straight strand of 1 voxel of length a voxel."""
NOISE_BLUR, NOISE_SHARE = 1.0, 0.15
"""A voxel of the scan that passes only by noise has nothing around it: blurred by one more voxel, it falls below this share
of a lone strand's peak, which the rim of a strand keeps up to 0.25 of."""
_STRANDS = 2000
"""Strands looked at together: each has some hundred points."""


def scan_agreement(
    strands: Strands,
    density: BrickVolume,
    profile: StrandProfile,
    visible: np.ndarray | None = None,
    scales: tuple[float, ...] = SCALES,
    progress: Progress = silent,
) -> dict[str, dict[str, float]]:
    """Voxel scores of `strands` (scan frame, mm) against the scan, per voxel size: {"0.50": {"iou", "precision", "recall"}}.

    visible (M,) 0..1 leaves out parts that the scan cannot show (inside the hairnet's zone); all by default.
    """
    shown = np.ones(len(strands.points)) if visible is None else np.asarray(visible, np.float64)
    return agreements([(strands, shown)], density, profile, scales, progress)[0]


def agreements(
    sets: list[tuple[Strands, np.ndarray]],
    density: BrickVolume,
    profile: StrandProfile,
    scales: tuple[float, ...] = SCALES,
    progress: Progress = silent,
) -> list[dict[str, dict[str, float]]]:
    """`scan_agreement` of several (strands, visible), the scan being resampled once for all."""
    scores = [{} for _ in sets]
    level = np.float32(HAIR_SHARE * LONE_PEAK)
    for number, scale in enumerate(scales):
        step = part(progress, number / len(scales), (number + 1) / len(scales))
        grid = _coarse_grid([strands for strands, _ in sets], density, scale)
        scan = _hair(BrickVolume(grid.table, _resampled(density, grid, profile, scale, part(step, 0.0, 0.4)), 1.0, (0, 0, 0)))
        step(0.5, 1.0)
        for which, (strands, visible) in enumerate(sets):
            share = part(step, 0.5 + 0.5 * which / len(sets), 0.5 + 0.5 * (which + 1) / len(sets))
            shown = render(grid.to_voxel(strands.points), strands.offsets, visible, grid, SCORE_BLUR, share)
            both, ours, theirs = 0, 0, 0
            for start in range(0, len(shown), CHUNK):
                mine, scanned = shown[start : start + CHUNK] > level, scan[start : start + CHUNK]
                both += int(np.count_nonzero(mine & scanned))
                ours += int(np.count_nonzero(mine))
                theirs += int(np.count_nonzero(scanned))
            scores[which][f"{grid.spacing:.2f}"] = {
                "iou": both / max(ours + theirs - both, 1),
                "precision": both / max(ours, 1),
                "recall": both / max(theirs, 1),
            }
    return scores


def _hair(scan: BrickVolume) -> np.ndarray:
    """(B, 16, 16, 16) bool: the voxels of the resampled scan that are hair, and not just noise."""
    return (scan.bricks > HAIR_SHARE * LONE_PEAK) & (blurred(scan, NOISE_BLUR) > NOISE_SHARE * LONE_PEAK)


def _coarse_grid(sets: list[Strands], density: BrickVolume, scale: float) -> BrickVolume:
    """An empty volume of voxels `scale` times the scan's, with bricks wherever the scan or a strand has something."""
    spacing = density.spacing * scale
    edge = BRICK * spacing
    reach = 3.0 * spacing
    corners = np.array(list(np.ndindex(2, 2, 2)))
    lows = density.to_scan(BRICK * density.brick_index) - 0.5 * density.spacing
    inside = [lows, lows + BRICK * density.spacing]
    inside += [strands.points + way * reach for strands in sets if len(strands.points) for way in (-1.0, 1.0)]
    low = np.min([each.min(axis=0) for each in inside if len(each)], axis=0) - spacing
    high = np.max([each.max(axis=0) for each in inside if len(each)], axis=0) + spacing
    origin = density.origin + np.floor((low - density.origin) / edge) * edge
    size = np.floor((high - origin + 0.5 * spacing) / edge).astype(np.int64) + 1
    kept = np.zeros(tuple(size), bool)

    def keep(points: np.ndarray) -> None:
        kept[tuple(np.floor((points - origin + 0.5 * spacing) / edge).astype(np.int64).T)] = True

    for corner in corners:
        keep(lows + BRICK * density.spacing * corner)
    for strands in sets:
        for at in range(0, len(strands), _STRANDS):
            some = strands.select(np.arange(at, min(at + _STRANDS, len(strands)))).resampled_by_step(0.25 * edge).points
            for corner in corners:
                keep(some + reach * (2.0 * corner - 1.0))
    table = np.full(tuple(size), -1, np.int32)
    table[kept] = np.arange(np.count_nonzero(kept), dtype=np.int32)
    bricks = np.empty((np.count_nonzero(kept), BRICK, BRICK, BRICK), np.float32)
    return BrickVolume(table, bricks, spacing, origin)


def _resampled(density: BrickVolume, grid: BrickVolume, profile: StrandProfile, scale: float, progress: Progress) -> np.ndarray:
    """(B, 16, 16, 16) float32: the scan on `grid`, in voxels of strand length, under the comparison's blur."""
    extra = np.sqrt(max((SCORE_BLUR * scale) ** 2 - profile.blur**2, 0.05))
    reach = int(np.ceil(2.6 * extra))
    out = np.empty(grid.bricks.shape, np.float32)
    index = grid.brick_index
    # Density over line mass is length per volume; times a voxel's area it is length in voxels, per voxel.
    unit = np.float32(grid.spacing**2 / profile.line_mass)
    shift = (grid.origin - density.origin) / density.spacing
    chunk = max(8, CHUNK // max(1, int(scale**3)))
    for start in range(0, len(out), chunk):
        progress(start, len(out))
        stop = min(start + chunk, len(out))
        _resample_bricks(
            density.table, density.bricks, np.float32(density.background), index, shift, float(scale), float(extra), reach,
            unit, start, stop, out,
        )  # fmt: skip
    return out


@numba.njit(cache=True)
def _read_row(table, bricks, background, i, j, low, row):
    """Fill `row` with the voxels (i, j, low...); False where none of them is stored."""
    I, J = i >> 4, j >> 4
    inside = 0 <= I < table.shape[0] and 0 <= J < table.shape[1]
    found = False
    k = 0
    while k < len(row):
        K = (low + k) >> 4
        stop = min(len(row), 16 * (K + 1) - low)
        at = table[I, J, K] if inside and 0 <= K < table.shape[2] else -1
        for n in range(k, stop):
            row[n] = bricks[at, i & 15, j & 15, (low + n) & 15] if at >= 0 else background
        found = found or at >= 0
        k = stop
    return found


@numba.njit(cache=True, parallel=True)
def _resample_bricks(table, bricks, background, index, shift, scale, extra, reach, unit, low, high, out):
    """Each coarse voxel: a Gaussian mean of the fine ones around it, separably over the brick."""
    fine = int(np.ceil(BRICK * scale)) + 2 * reach + 2
    taps = 2 * reach + 2
    for b in numba.prange(low, high):
        # Fine voxel that the first tap of the brick's first voxel reads, per axis, and the weights per coarse voxel.
        base = np.empty(3, np.int64)
        first = np.empty((3, BRICK), np.int64)
        weight = np.zeros((3, BRICK, taps), np.float32)
        for axis in range(3):
            base[axis] = int(np.floor(shift[axis] + scale * BRICK * index[b, axis])) - reach
            for c in range(BRICK):
                centre = shift[axis] + scale * (BRICK * index[b, axis] + c)
                first[axis, c] = int(np.floor(centre)) - reach - base[axis]
                total = 0.0
                for t in range(taps):
                    d = (base[axis] + first[axis, c] + t - centre) / extra
                    w = np.exp(-0.5 * d * d)
                    weight[axis, c, t] = w
                    total += w
                for t in range(taps):
                    weight[axis, c, t] /= total
        block = np.empty((fine, fine, fine), np.float32)
        found = False
        for i in range(fine):
            for j in range(fine):
                found = _read_row(table, bricks, background, base[0] + i, base[1] + j, base[2], block[i, j]) or found
        if not found:
            out[b] = 0.0
            continue
        across = np.zeros((BRICK, fine, fine), np.float32)
        for c in range(BRICK):
            for t in range(taps):
                w = weight[0, c, t]
                for j in range(fine):
                    for k in range(fine):
                        across[c, j, k] += w * block[first[0, c] + t, j, k]
        along = np.zeros((BRICK, BRICK, fine), np.float32)
        for c in range(BRICK):
            for d in range(BRICK):
                for t in range(taps):
                    w = weight[1, d, t]
                    for k in range(fine):
                        along[c, d, k] += w * across[c, first[1, d] + t, k]
        for c in range(BRICK):
            for d in range(BRICK):
                for e in range(BRICK):
                    total = np.float32(0.0)
                    for t in range(taps):
                        total += weight[2, e, t] * along[c, d, first[2, e] + t]
                    out[b, c, d, e] = unit * total
