"""Strands led back to the scalp: followed through the hair around them, grown along rooted neighbours, and the root curved
into the scalp (paper 3.2.2, supplement 2)."""

from __future__ import annotations

import numba
import numpy as np
from scipy.spatial import cKDTree

from ..head import Head
from ..progress import Progress, silent
from ..settings import GuideSettings
from ..strands import Strands, offsets_from_counts
from .direction import TOUCH, end_tangents, unit
from .knots import tie_to_knots

REACHES = (1.0, 2.0, 4.0)
"""Multiples of the neighbour radius that are tried in turn: the nearest hair first, thin places last."""
MOST_ROUNDS = 12
"""Rounds at one reach at most: each one roots the neighbours of the last one's."""
CANDIDATES = 12
"""Neighbouring points that are weighed for the one to grow along."""
ROOT_STEP = 0.5
"""mm between the points that lead into the scalp."""
LEAVING = 6.0
"""mm over which hair turns, at most, from the knot that it leaves to the way that it goes on."""
COURSE_STEP, COURSE_REACH, COURSE_POINTS = 2.0, 6.0, 48
"""mm between the points of hair whose mean is a place's course, within so many mm, so many at most."""
OWN = 0.25
"""Weight of a strand's own direction against the course of the hair around it: an end's own is noise."""
FLATTEST = 0.03
"""Sine of the angle to the scalp that hair is taken to lie at, at least."""
FOLLOWED_BACK = 0.45
"""Share of the way to where hair, followed straight back, meets the scalp, at which its root lies: it leaves the knot steeper
than it goes on. Measured on hair at 2 and at 30 degrees to the scalp alike."""
HIDDEN = 30.0
"""mm of hair that are hidden at its root, at most."""
WALK_STEP, WALK_REACH, WALK_SPREAD = 0.5, 2.5, 1.0
"""mm: steps back through the hair, how far the nearest hair may be, and the Gaussian that neighbours are weighed by."""
WALK_POINTS, WALK_TURN = 16, 0.3
"""Neighbours that are listened to, and the weight of what they say against the way so far."""
WALK_AHEAD = WALK_STEP * ((1.0 - WALK_TURN) / WALK_TURN + 0.5)
"""mm ahead that they are asked at: by so much the way lags behind, and over a curved scalp a lag would lead off it."""
LONGEST_WALK = 150.0
"""mm that a strand is followed back at most."""
CLEARANCE = 0.05
"""mm; points inside the head are pushed this far out of it."""


def grow_to_root(strands: Strands, rooted: np.ndarray, settings: GuideSettings) -> tuple[Strands, np.ndarray, np.ndarray]:
    """Grow directed strands that are not `rooted` (N,) back along the nearest rooted one, by its own steps (supplement 2,
    Algorithm 1).

    Rooted means that the first point is within reach of the scalp. Done in rounds, so that hair far from any fine strand is
    reached over what was grown before. Returns (strands with the grown points put before them, (N,) bool reached,
    (N,) float32 mm grown).
    """
    count = len(strands)
    reached = np.asarray(rooted, bool).copy()
    parts: list[np.ndarray | None] = [None] * count
    grown = np.zeros(count, np.float32)
    forward, _ = end_tangents(strands)
    forest: list[tuple[cKDTree, Strands, np.ndarray]] = []
    fresh = np.flatnonzero(reached)
    current = strands.select(fresh)
    for reach in REACHES:
        for _ in range(MOST_ROUNDS):
            if len(fresh):
                forest.append((cKDTree(current.points), current, current.tangents()))
            waiting = np.flatnonzero(~reached)
            if not len(waiting) or not forest:
                break
            source, place, found = _guides_for(
                strands.roots[waiting], forward[waiting], forest, reach * settings.neighbour_radius
            )
            chosen = np.flatnonzero(found)
            if not len(chosen):
                fresh = waiting[:0]
                break
            fresh = waiting[chosen]
            bodies = []
            for slot, n in zip(chosen, fresh, strict=True):
                guide = forest[source[slot]][1]
                strand = np.searchsorted(guide.offsets, place[slot], side="right") - 1
                path = guide.points[guide.offsets[strand] : place[slot]]
                shift = strands.points[strands.offsets[n]] - guide.points[place[slot]]
                parts[n] = path + shift
                body = np.concatenate([parts[n], strands.points[strands.offsets[n] : strands.offsets[n + 1]]])
                grown[n] = np.linalg.norm(np.diff(body[: len(path) + 1], axis=0), axis=1).sum()
                bodies.append(body)
            reached[fresh] = True
            current = Strands.from_polylines(bodies)
    put = [part for part in parts if part is not None]
    counts = np.zeros(count, np.int64)
    counts[[n for n, part in enumerate(parts) if part is not None]] = [len(part) for part in put]
    before = np.concatenate(put) if put else np.zeros((0, 3), np.float32)
    points = _joined(before.astype(np.float32), offsets_from_counts(counts), strands.points, strands.offsets)
    out = Strands(points, offsets_from_counts(counts + strands.counts))
    return out.with_attributes(**strands.strand_attributes), reached, grown


def _guides_for(ends, tangents, forest, reach):
    """The tree, the point in it and whether there is one, for each end (M, 3): near and of one direction."""
    source, place = np.zeros(len(ends), np.int64), np.zeros(len(ends), np.int64)
    best = np.full(len(ends), np.inf)
    for number, (tree, _, directions) in enumerate(forest):
        distance, near = tree.query(ends, k=CANDIDATES, distance_upper_bound=reach, workers=-1)
        found = np.isfinite(distance)
        near = np.where(found, near, 0)
        agreement = np.einsum("nkc,nc->nk", directions[near], tangents)
        # A neighbour of another direction is as bad as one at the edge of reach; later rounds' are worse than earlier ones'.
        cost = np.where(found & (agreement > 0.5), distance / reach + 2.0 * (1.0 - agreement) + 0.05 * number, np.inf)
        column = cost.argmin(axis=1)
        rows = np.arange(len(ends))
        better = cost[rows, column] < best
        best = np.where(better, cost[rows, column], best)
        source = np.where(better, number, source)
        place = np.where(better, near[rows, column], place)
    return source, place, np.isfinite(best)


def course_around(strands: Strands, places: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N, 3) float64 unit: which way hair goes around `places` (N, 3), the mean of the directed `strands` there, those against
    the directions `own` (N, 3) left out; `own` itself counts little, unless there is no other."""
    hair = strands.resampled_by_step(COURSE_STEP)
    tangents = hair.tangents().astype(np.float64)
    distance, near = cKDTree(hair.points).query(places, k=COURSE_POINTS, distance_upper_bound=COURSE_REACH, workers=-1)
    found = np.isfinite(distance)
    tangents = tangents[np.where(found, near, 0)]
    along = found & (np.einsum("nkc,nc->nk", tangents, own) > 0.0)
    return unit(unit(np.einsum("nkc,nk->nc", tangents, along.astype(np.float64))) + OWN * own)


def follow_to_scalp(
    strands: Strands, head: Head, low: float, progress: Progress = silent
) -> tuple[Strands, np.ndarray, np.ndarray]:
    """Directed strands followed back through the hair around them to where they are `low` (mm) over the scalp.

    Where hair is dense a trace begins high over the scalp: what lies before it has gone to others that run beside it, and it
    runs as they do. Each step goes against the mean direction of its neighbours. Returns (strands with the steps before them,
    (N,) bool which are low now, or as low as a root end may be, (N,) float32 mm put before); a strand that does not come
    there stays as it is.
    """
    low_now = head.signed_distance(strands.roots) <= low
    walkers = np.flatnonzero(~low_now)
    counts = np.zeros(len(strands), np.int64)
    if not len(walkers):
        return strands, low_now, counts.astype(np.float32)
    path, taken, height = _walked_back(strands, walkers, head, low, progress)
    arrived = height < max(TOUCH, low)
    low_now[walkers] = arrived
    counts[walkers] = np.where(arrived, taken, 0)
    offsets = offsets_from_counts(counts)
    walker = np.repeat(np.arange(len(walkers)), counts[walkers])
    back = np.repeat(taken, counts[walkers]) - (np.arange(offsets[-1]) - np.repeat(offsets[walkers], counts[walkers]))
    points = _joined(path[back, walker], offsets, strands.points, strands.offsets)
    out = Strands(points, offsets_from_counts(counts + strands.counts), strands.strand_attributes)
    return out, low_now, (WALK_STEP * counts).astype(np.float32)


def _walked_back(strands, walkers, head, low, progress) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The steps of the strands `walkers` (W,) back from their roots, until they are low or have no hair around.

    Returns (path (S + 1, W, 3) float32 mm, the root first; (W,) int64 steps taken; (W,) mm over the head at the last of them).
    """
    steps = round(LONGEST_WALK / WALK_STEP)
    path = np.zeros((steps + 1, len(walkers), 3), np.float32)
    path[0] = strands.roots[walkers]
    taken = np.zeros(len(walkers), np.int64)
    height = np.array(head.signed_distance(path[0]))
    hair = strands.resampled_by_step(2.0 * WALK_STEP)
    tree, index, tangents = cKDTree(hair.points), hair.strand_index, hair.tangents().astype(np.float64)
    own, _ = end_tangents(strands)
    way = course_around(strands, path[0], own[walkers])
    going = np.arange(len(walkers))
    for step in range(1, steps + 1):
        progress(step - 1, steps)
        if not len(going):
            break
        place, onward = path[step - 1, going].astype(np.float64), way[going]
        distance, near = tree.query(place - WALK_AHEAD * onward, k=WALK_POINTS, distance_upper_bound=WALK_REACH, workers=-1)
        found = np.isfinite(distance)
        near, distance = np.where(found, near, 0), np.where(found, distance, WALK_REACH)
        found &= index[near] != walkers[going][:, None]
        agreement = np.einsum("nkc,nc->nk", tangents[near], onward)
        weight = np.where(found & (agreement > 0.5), agreement * np.exp(-0.5 * (distance / WALK_SPREAD) ** 2), 0.0)
        heard = weight.sum(axis=1) > 1e-3
        mean = unit(np.einsum("nkc,nk->nc", tangents[near], weight))
        going = going[heard]
        way[going] = unit((1.0 - WALK_TURN) * onward + WALK_TURN * mean)[heard]
        path[step, going] = place[heard] - WALK_STEP * way[going]
        taken[going] = step
        height[going] = head.signed_distance(path[step, going])
        going = going[height[going] > low]
    return path, taken, height


def lead_into_scalp(strands: Strands, head: Head, knots: np.ndarray | None = None) -> tuple[Strands, np.ndarray, int]:
    """Put a curve before each strand that runs from the scalp into its first point's direction; returns (strands, (N,) mm
    added, roots at knots).

    The root lies FOLLOWED_BACK of the way to where the hair around, followed straight back, meets the scalp, or at the knot by
    there, if there is one among `knots` (K, 3), mm (`tie_to_knots`); the curve is a cubic Hermite piece that leaves the scalp
    leaning to its normal. A first point already on the scalp or in the head is moved there.
    """
    if not len(strands):
        return strands, np.zeros(0, np.float32), 0
    forward, _ = end_tangents(strands)
    ends = strands.roots.astype(np.float64)
    normal = head.closest_scalp(ends).normal.astype(np.float64)
    depth = np.maximum(head.signed_distance(ends), 0.0).astype(np.float64)
    course = course_around(strands, ends, forward)
    sine = (course * normal).sum(axis=1)
    along = unit(course - sine[:, None] * normal)
    sine = np.clip(sine, FLATTEST, 1.0)
    hidden = np.minimum(FOLLOWED_BACK * depth * np.sqrt(1.0 - sine**2) / sine, HIDDEN)
    root = head.closest_scalp(ends - hidden[:, None] * along - depth[:, None] * normal)
    tied = np.zeros(len(strands), bool)
    if knots is not None:
        place, tied = tie_to_knots(root, along, hidden, head, knots)
        root = head.closest_scalp(place)
    gap = np.linalg.norm(root.position - ends, axis=1)
    leaving = unit(forward + 0.7 * root.normal)
    counts = np.maximum(np.ceil(gap / ROOT_STEP).astype(np.int64), 1)
    offsets = offsets_from_counts(counts)
    index = np.repeat(np.arange(len(strands)), counts)
    t = ((np.arange(offsets[-1]) - offsets[:-1][index]) / counts[index])[:, None]
    start, end, pull = root.position.astype(np.float64)[index], ends[index], gap[index][:, None]
    curve = (2 * t**3 - 3 * t**2 + 1) * start + (t**3 - 2 * t**2 + t) * np.minimum(pull, LEAVING) * leaving[index]
    curve += (3 * t**2 - 2 * t**3) * end + (t**3 - t**2) * pull * forward[index]
    joined = _joined(curve.astype(np.float32), offsets, strands.points, strands.offsets)
    lead = Strands(joined, offsets_from_counts(counts + strands.counts), strands.strand_attributes)
    return lead, gap.astype(np.float32), int(tied.sum())


@numba.njit(cache=True)
def _joined(before, before_offsets, after, after_offsets):
    out = np.empty((len(before) + len(after), 3), np.float32)
    at = 0
    for n in range(len(after_offsets) - 1):
        for m in range(before_offsets[n], before_offsets[n + 1]):
            out[at] = before[m]
            at += 1
        for m in range(after_offsets[n], after_offsets[n + 1]):
            out[at] = after[m]
            at += 1
    return out


def push_out(strands: Strands, head: Head) -> tuple[Strands, int]:
    """Strands with every point but the first outside the head: those inside go straight out through the nearest surface."""
    points = strands.points.astype(np.float64)
    first = np.zeros(len(points), bool)
    first[strands.offsets[:-1]] = True
    depth = head.signed_distance(points)
    moved = np.flatnonzero((depth < CLEARANCE) & ~first)
    total = len(moved)
    step = 0.25
    for _ in range(4):
        if not len(moved):
            break
        at = points[moved]
        slope = np.stack(
            [head.signed_distance(at + step * axis) - head.signed_distance(at - step * axis) for axis in np.eye(3)], axis=1
        ).astype(np.float64)
        slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
        points[moved] = at + slope * (CLEARANCE * 1.5 - depth[moved])[:, None]
        depth[moved] = head.signed_distance(points[moved])
        moved = moved[depth[moved] < CLEARANCE]
    return strands.with_points(points.astype(np.float32)), total
