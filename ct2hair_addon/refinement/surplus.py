"""What strands that were fitted have too many, cut out, and what the scan shows beyond the rest: what is to be traced anew.

Where a trace went over to another strand, that has two of ours from there on and its own has none. Both show: summed over the
width of a bundle, the misfit counts strands.
"""

from __future__ import annotations

import numba
import numpy as np

from ..progress import Progress, part, silent
from ..strands import Strands, offsets_from_counts
from ..volume import BrickVolume
from ..volume.strand_signal import StrandProfile, data_floor
from .boundary import Boundary
from .curves import EVEN, control_points, even_lines
from .pruning import earnings, excess_of, prefix, take_out

REACH = 2.0
"""voxel that strands may be off by: the misfit is summed over as much.

The blur is cut off at 3 voxels, which leaves one of 1.6, under which a strand too many reads 1.2 of itself: what is asked of
stretches here, and of doubles before a fit (`pruning`), holds for that.
"""
LEAST_SURPLUS = 4.0
"""voxel; a stretch is cut out where so much of a lone strand's length is won by it."""
MOST_CUTS = 8
"""Stretches cut out of one strand."""
CHUNK = 1000
"""Strands judged in one call: a fraction of a second."""
LEAST_POINTS, MOST_POINTS = 3, 256
"""Control points of what is kept, and of a strand."""


def without_surplus(
    strands: Strands, density: BrickVolume, hair_level: float, head, profile: StrandProfile, progress: Progress = silent
) -> tuple[Strands, dict[str, int]]:
    """The strands (mm, root first) in pieces, without the stretches that the scan has no hair left for; and a tally.

    The strands should have been fitted to the scan (`refine`). density, hair_level, head: as there; profile: a lone strand's.
    """
    points, offsets, visible = _seen(strands, density, hair_level, head)
    voxels = density.to_voxel(points)
    excess, mark = excess_of(voxels, offsets, visible, density, profile, REACH, part(progress, 0.0, 0.7))
    earned, _, loss = earnings(density.table, excess, density.bricks, 0.0, voxels, offsets, visible, mark.peak, mark.seen)
    edges = np.ones(len(points), bool)
    edges[offsets[1:] - 1] = False
    whole = int(edges.sum())
    # what is cut out makes the rest earn more: a strand without such a stretch now will have none
    order = np.argsort(earned, kind="stable")
    order = order[loss[order] >= LEAST_SURPLUS]
    for start in range(0, len(order), CHUNK):
        progress(0.7 + 0.3 * start / len(order), 1.0)
        some = order[start : start + CHUNK]
        _cut(density.table, excess, density.bricks, voxels, offsets, visible, some, mark.peak, mark.seen, mark.blur, edges)
    tally = {"stretches cut out, control points": whole - int(edges.sum())}
    points, offsets = _runs(points, offsets, edges)
    tally["pieces kept"] = len(offsets) - 1
    progress(1.0, 1.0)
    return Strands(*even_lines(points, offsets, EVEN * density.spacing)), tally


def unexplained(
    strands: Strands, density: BrickVolume, hair_level: float, head, profile: StrandProfile, progress: Progress = silent
) -> BrickVolume:
    """The scan without what the strands (mm) explain of it, float32, negative where that is more. The rest as above."""
    points, offsets, visible = _seen(strands, density, hair_level, head)
    rest, _ = excess_of(density.to_voxel(points), offsets, visible, density, profile, 0.0, progress)
    np.negative(rest, out=rest)
    return BrickVolume(density.table, rest, density.spacing, density.origin)


def _seen(strands: Strands, density: BrickVolume, hair_level: float, head):
    """(points, offsets, visible) of the strands' control points."""
    points, offsets = control_points(strands, MOST_POINTS)
    boundary = Boundary(head, data_floor(density, hair_level, head), density.spacing)
    return points, offsets, boundary.look(points)


def _runs(points, offsets, edges):
    """(points, offsets) of the runs of `edges` (M,) bool, each from its point to the next."""
    behind = np.concatenate([[False], edges[:-1]])
    first = (edges & ~behind)[edges | behind]
    kept = edges | behind
    run = np.cumsum(first) - 1
    counts = np.bincount(run)
    long = counts >= LEAST_POINTS
    chosen = np.flatnonzero(kept)[long[run]] if len(run) else np.zeros(0, np.int64)
    return points[chosen], offsets_from_counts(counts[long])


@numba.njit(cache=True, nogil=True)
def _cut(table, excess, scan, points, offsets, visible, order, peak, seen, blur, edges):
    """Clear `edges` (M,) bool, those from each control point to the next, where a strand is one too many: strand by strand,
    each against what the ones before have left, the stretch first by which most is won."""
    for n in order:
        start, end = offsets[n], offsets[n + 1]
        size = end - start
        if size < 2:
            continue
        earned = np.empty(size)
        for _ in range(MOST_CUTS):
            prefix(table, excess, scan, 0.0, points, visible, start, end, peak, seen, earned)
            most, low, high, top = 0.0, 0, 0, 0
            for m in range(1, size):
                if not edges[start + m - 1] or earned[m] > earned[top]:
                    top = m
                elif earned[top] - earned[m] > most:
                    most, low, high = earned[top] - earned[m], top, m
            if most < LEAST_SURPLUS:
                break
            edges[start + low : start + high] = False
            take_out(table, excess, points, visible, start, end, start + low, start + high, peak, blur)
