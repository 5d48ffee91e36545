"""Stage 6: dense strands moved to fit the scan (paper 3.3.2), by the volume itself or by the paper's Chamfer distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..progress import Progress, part, silent
from ..settings import RefinementSettings
from ..strands import Strands, offsets_from_counts
from ..volume import BrickVolume
from ..volume.strand_signal import StrandProfile, data_floor, lone_profile, support_along
from .agreement import agreements
from .boundary import Boundary
from .curves import EVEN, SEGMENT_LENGTH, control_points, even_lines, polylines
from .exchange import exchange_tips
from .fit import FIRST_SMOOTH, fit_to_volume
from .pruning import prune
from .tips import settle_tips

MISPLACED = 2.0
"""voxel; strands may be off by so much before they are fitted, and are not held to be wrong for it."""
CHAMFER_SEGMENT = 6.0
"""mm between two control points of the paper's fit at most: it holds nothing but lengths and tangents, and follows noise with
closer ones."""
SETTLED = 15
"""Iterations after which strands are where they belong."""
EXCHANGES, EXCHANGED_SHARE, LEAST_BETWEEN = 3, 0.4, 3
"""How often tips are exchanged, the share of all iterations before the last of these, and how many lie between two at least."""
FIRST_SHARE = 0.24
"""Share of the iterations before them."""
LOOSE = 1.5
"""`stiffness` by then, voxel: each point lies where there is hair, not where the strand's smoothness takes it."""
AGAIN_SMOOTH = 2.0
"""Times `stiffness` that the last fit sets out with."""


@dataclass(frozen=True)
class Refined:
    """Strands fitted to the scan.

    strands: mm, scan frame, root first, with strand attributes `root_uv` (where given) and `support` (N,) and the point
    attribute `support` (M,): 0 (made up) to 1 (backed by the scan). tally: counts in plain English.
    scores: {"before" | "after": {voxel size in mm: {"iou", "precision", "recall"}}} against the scan itself.
    """

    strands: Strands
    tally: dict[str, int]
    scores: dict[str, dict[str, dict[str, float]]]


def refine(
    strands: Strands,
    density: BrickVolume,
    hair_level: float,
    head,
    settings: RefinementSettings | None = None,
    seed: int = 0,
    progress: Progress = silent,
    profile: StrandProfile | None = None,
    device: str = "auto",
    peak: float = 0.0,
    final: bool = True,
    fewest: int = 0,
) -> Refined:
    """Fit strands to the scan that they came from: roots stay where they are, curls are kept.

    strands: mm, scan frame, root first, rooted on the scalp. density: air subtracted, exactly 0 where nothing is known, as
    where the net was cleared; hair_level: density above which a voxel is hair. head: as `Boundary` wants it. profile: a lone
    strand's signature, measured on the strands where not given, or taken from `peak`, a lone strand's by the thresholds, where
    none runs alone.
    device: auto, cpu or cuda (see `device.py`). final: False where more is done to the strands: they are left as fitted,
    with a point every other voxel, and there are neither support nor scores. fewest: how many strands are known to be there:
    of traced ones none is taken for a double where no more are left. The same input and seed give the same bits on
    any number of threads; a graphics card rounds differently. Raises Cancelled and CT2HairError (cuda asked for, no card).
    """
    settings = settings or RefinementSettings()
    progress(0.0, 1.0)
    finite = np.bincount(strands.strand_index, ~np.isfinite(strands.points).all(axis=1), len(strands)) == 0
    kept = strands.select(finite & (strands.counts >= 2))
    tally = {"strands": len(kept), "dropped: not finite or fewer than two points": len(strands) - len(kept)}
    if not len(kept) or not len(density.bricks):
        return Refined(_supported(kept, density, hair_level), tally, {})
    profile = profile or lone_profile(density, hair_level, kept, peak, part(progress, 0.0, 0.05))
    tally["pieces of lone strands measured"] = profile.pieces
    tally["blur of the scan (thousandths of a voxel)"] = round(1000 * profile.blur)
    boundary = Boundary(head, data_floor(density, hair_level, head), density.spacing)
    longest = CHAMFER_SEGMENT if settings.method == "chamfer" else SEGMENT_LENGTH
    points, offsets = control_points(kept, settings.points, longest)
    given = (Strands(points, offsets), boundary.look(points)) if final else None
    judged = settings.prune and settings.method == "volume"
    if judged and settings.iterations:
        points, offsets, kept, counts = _pruned(
            points, offsets, kept, density, profile, boundary, part(progress, 0.1, 0.15), MISPLACED, fewest
        )
        tally |= {f"{name}, before fitting": count for name, count in counts.items()}
    if settings.iterations and len(kept):
        step = part(progress, 0.15, 0.85)
        traced = kept.strand_attributes.get("guide")
        points, offsets, counts = _moved(
            points, offsets, density, hair_level, profile, boundary, settings, seed, device, step, traced
        )
        tally |= counts
        if judged and final:
            points, offsets, kept, counts = _pruned(
                points,
                offsets,
                kept,
                density,
                profile,
                boundary,
                part(progress, 0.85, 0.88),
                0.0 if settings.iterations >= SETTLED else MISPLACED,
                fewest,
            )
            tally |= {f"{name}, after fitting": count for name, count in counts.items()}
        traced = kept.strand_attributes.get("guide")
        if settings.method == "volume" and final and traced is not None and np.any(traced):
            step = part(progress, 0.88, 0.9)
            points, moved = settle_tips(points, offsets, boundary.look(points), density, profile, traced, step)
            tally["tips moved out"], tally["tips moved in"] = int((moved > 0.0).sum()), int((moved < 0.0).sum())
    if settings.iterations and settings.method == "volume":
        points = boundary.raised(points, offsets)
    if not final:
        progress(1.0, 1.0)
        return Refined(Strands(*even_lines(points, offsets, EVEN * density.spacing), kept.strand_attributes), tally, {})
    fitted = (Strands(points, offsets), boundary.look(points))
    each = agreements([given, fitted], density, profile, progress=part(progress, 0.9, 0.98))
    scores = dict(zip(("before", "after"), each, strict=True))
    fine, fine_offsets = polylines(points, offsets)
    fine[fine_offsets[:-1]] = kept.roots
    cleared, inside = boundary.clear(fine, fine_offsets)
    tally["points pushed out of the head at the end"] = int(inside)
    result = _supported(Strands(cleared, fine_offsets, kept.strand_attributes), density, hair_level)
    progress(1.0, 1.0)
    return Refined(result, tally, scores)


def _pruned(points, offsets, strands, density, profile, boundary, progress, reach, fewest):
    """Control points, offsets and strands without what explains nothing of the scan; and the counts of what went.

    Strands with the attribute `guide` were traced in the scan; without it, all are taken for made up.
    """
    traced = strands.strand_attributes.get("guide")
    stay, tally = prune(points, offsets, boundary.look(points), density, profile, progress, reach, traced, fewest)
    first = np.repeat(offsets[:-1], np.diff(offsets))
    points = points[np.arange(len(points)) - first < np.repeat(stay, np.diff(offsets))]
    alive = stay > 0
    return points, offsets_from_counts(stay[alive]), strands.select(alive), tally


def _moved(points, offsets, density, hair_level, profile, boundary, settings, seed, device, progress, traced):
    """Control points and offsets after the chosen method, and its tally."""
    if settings.method == "chamfer":
        from .chamfer import fit_to_points  # torch takes seconds to import: only who asks for it pays

        moved, tally = fit_to_points(points, offsets, density, hair_level, boundary, settings, seed, device, progress)
        return moved, offsets, tally
    return _fitted(points, offsets, density, profile, boundary, settings, device, progress, traced)


def _fitted(points, offsets, density, profile, boundary, settings, device, progress, traced):
    """Control points and offsets after the fit to the volume, with tips of `traced` strands exchanged on the way; its tally."""
    plan = _plan(settings, traced is not None and bool(np.any(traced)))
    done = np.cumsum([0] + [wanted.iterations for wanted, _, _ in plan]) / settings.iterations
    tally: dict[str, int] = {}
    for number, (wanted, first, exchanges) in enumerate(plan):
        step = part(progress, done[number], done[number + 1])
        fitting = part(step, 0.0, 0.7) if exchanges else step
        points, counts = fit_to_volume(points, offsets, density, profile, boundary, wanted, device, fitting, traced, first)
        if exchanges:
            last = part(step, 0.7, 1.0)
            points, offsets, made = exchange_tips(points, offsets, density.spacing, traced, settings.points, last)
            counts["tips exchanged"] = tally.get("tips exchanged", 0) + made
        counts["iterations"] += tally.get("iterations", 0)
        tally = tally | counts | {name: value for name, value in tally.items() if name.startswith("misfit before")}
    return points, offsets, tally


def _plan(settings: RefinementSettings, traced: bool) -> list[tuple[RefinementSettings, float, bool]]:
    """The fits in their order: (settings, times their stiffness at first, whether tips are exchanged behind it)."""
    loose = round(EXCHANGED_SHARE * settings.iterations)
    count = min(EXCHANGES, loose // LEAST_BETWEEN) if settings.exchange and traced else 0
    if not count:
        return [(settings, FIRST_SMOOTH, False)]
    first = round(FIRST_SHARE * settings.iterations)
    each = loose // count
    between = replace(settings, iterations=each, stiffness=min(LOOSE, settings.stiffness), coarsest=1.0)
    last = replace(settings, iterations=settings.iterations - first - count * each, coarsest=1.0)
    set_out = replace(settings, iterations=first)
    return [(set_out, FIRST_SMOOTH, False), *count * [(between, 1.0, True)], (last, AGAIN_SMOOTH, False)]


def _supported(strands: Strands, density: BrickVolume, hair_level: float) -> Strands:
    """The strands with `support` per strand and per point."""
    per_point, per_strand = support_along(strands, density, hair_level)
    attributes = {**strands.strand_attributes, "support": per_strand}
    return Strands(strands.points, strands.offsets, attributes, {"support": per_point})
