"""Roots: where each strand enters the scalp, at a knot of the hairnet where one is seen, and the curve that leads there (paper
3.2.2, Algorithm 1)."""

from __future__ import annotations

import numpy as np

from ..head import Head
from ..progress import Progress, silent
from ..strands import Strands, normalized, offsets_from_counts
from .direction import end_tangents
from .free_knots import lead_to_free_knots
from .growing import course_around, joined
from .knots import SHORT, by_the_scalp, tie_to_knots

ROOT_STEP = 0.5
"""mm between the points that lead into the scalp."""
LEAVING = 6.0
"""mm over which hair turns, at most, from the knot that it leaves to the way that it goes on."""
FLATTEST = 0.03
"""Sine of the angle to the scalp that hair is taken to lie at, at least."""
FOLLOWED_BACK = 0.45
"""Share of the way to where hair, followed straight back, meets the scalp, at which its root lies: it leaves the knot steeper
than it goes on. Measured on hair at 2 and at 30 degrees to the scalp alike."""
HIDDEN = 30.0
"""mm of hair that are hidden at its root, at most."""
CLEARANCE = 0.05
"""mm; points inside the head are pushed this far out of it."""


def lead_into_scalp(
    strands: Strands,
    head: Head,
    knots: np.ndarray | None = None,
    made: np.ndarray | None = None,
    progress: Progress = silent,
    usual: float | None = None,
) -> tuple[Strands, int, int]:
    """Put a curve before each strand that runs from the scalp into its first point's direction; returns (strands, how many
    begin at knots, how many of these at knots that were left).

    The root lies FOLLOWED_BACK of the way to where the hair around, followed straight back, meets the scalp, or at the knot by
    there, if there is one among `knots` (K, 3), mm (`tie_to_knots`). Where `made` (N,) tells how many points of each strand
    were not traced, those without a knot are led to the ones that are left (`lead_to_free_knots`), and so are those that were
    followed back over the scalp: they may have passed theirs (usual: as there). The curve is a cubic Hermite piece that leaves
    the scalp leaning to its normal; a first point already on the scalp or in the head is moved there.
    """
    if not len(strands):
        return strands, 0, 0
    knots = by_the_scalp(np.zeros((0, 3)) if knots is None else knots, head)
    place, chosen = _beside(strands, head, knots, np.zeros(len(strands), bool) if made is None else made > 0)
    tied, late = chosen >= 0, np.zeros(len(strands), bool)
    if made is not None and tied.any():
        free = np.delete(knots, chosen[tied], axis=0)
        strands, left, late = lead_to_free_knots(strands, made, np.flatnonzero(~tied), free, head, progress, usual)
        place[late] = left[late]
    return _led(strands, head, place), int((tied | late).sum()), int(late.sum())


def _beside(strands: Strands, head: Head, knots: np.ndarray, followed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(roots (N, 3) float64 by the course of the hair at the strands' first points, at knots where they are; (N,) the knot,
    -1 for none): none to those that were `followed` (N,) bool and lie flat."""
    forward, _ = end_tangents(strands)
    ends = strands.roots.astype(np.float64)
    normal = head.closest_scalp(ends).normal.astype(np.float64)
    depth = np.maximum(head.signed_distance(ends), 0.0).astype(np.float64)
    course = course_around(strands, ends, forward)
    sine = (course * normal).sum(axis=1)
    along = normalized(course - sine[:, None] * normal)
    sine = np.clip(sine, FLATTEST, 1.0)
    hidden = np.minimum(FOLLOWED_BACK * depth * np.sqrt(1.0 - sine**2) / sine, HIDDEN)
    found = head.closest_scalp(ends - hidden[:, None] * along - depth[:, None] * normal)
    place, chosen = np.array(found.position, np.float64), np.full(len(strands), -1)
    some = np.flatnonzero(~followed | (hidden <= SHORT))
    place[some], chosen[some] = tie_to_knots(found.select(some), along[some], hidden[some], knots)
    return place, chosen


def _led(strands: Strands, head: Head, place: np.ndarray) -> Strands:
    """The strands with a curve before each from the scalp by `place` (N, 3)."""
    forward, _ = end_tangents(strands)
    ends = strands.roots.astype(np.float64)
    root = head.closest_scalp(place)
    gap = np.linalg.norm(root.position - ends, axis=1)
    leaving = normalized(forward + 0.7 * root.normal)
    counts = np.maximum(np.ceil(gap / ROOT_STEP).astype(np.int64), 1)
    offsets = offsets_from_counts(counts)
    index = np.repeat(np.arange(len(strands)), counts)
    t = ((np.arange(offsets[-1]) - offsets[:-1][index]) / counts[index])[:, None]
    start, end, pull = root.position.astype(np.float64)[index], ends[index], gap[index][:, None]
    curve = (2 * t**3 - 3 * t**2 + 1) * start + (t**3 - 2 * t**2 + t) * np.minimum(pull, LEAVING) * leaving[index]
    curve += (3 * t**2 - 2 * t**3) * end + (t**3 - t**2) * pull * forward[index]
    points = joined(curve.astype(np.float32), offsets, strands.points, strands.offsets)
    return Strands(points, offsets_from_counts(counts + strands.counts), strands.strand_attributes)


def push_out(strands: Strands, head: Head) -> tuple[Strands, int]:
    """Strands with every point but the first outside the head: those inside go straight out through the nearest surface."""
    points = strands.points.astype(np.float64)
    first = np.zeros(len(points), bool)
    first[strands.offsets[:-1]] = True
    depth = head.signed_distance(points, CLEARANCE)
    moved = np.flatnonzero((depth < CLEARANCE) & ~first)
    total = len(moved)
    for _ in range(4):
        if not len(moved):
            break
        points[moved] += head.outward(points[moved]) * (CLEARANCE * 1.5 - depth[moved])[:, None]
        depth[moved] = head.signed_distance(points[moved])
        moved = moved[depth[moved] < CLEARANCE]
    return strands.with_points(points.astype(np.float32)), total
