"""Strands led back to the scalp: followed through the hair around them, or grown along rooted neighbours (paper 3.2.2,
supplement 2)."""

from __future__ import annotations

import numba
import numpy as np
from scipy.spatial import cKDTree

from ..head import Head
from ..progress import Progress, silent
from ..settings import GuideSettings
from ..strands import Strands, concatenate, nearest_points, normalized, offsets_from_counts, point_tree, points_around
from .direction import TOUCH, end_tangents

REACHES = (1.0, 2.0, 4.0)
"""Multiples of the neighbour radius that are tried in turn: the nearest hair first, thin places last."""
MOST_ROUNDS = 12
"""Rounds at one reach at most: each one roots the neighbours of the last one's."""
CANDIDATES = 12
"""Neighbouring points that are weighed for the one to grow along."""
COURSE_STEP, COURSE_REACH, COURSE_POINTS = 2.0, 6.0, 48
"""mm between the points of hair whose mean is a place's course, within so many mm, so many at most."""
OWN = 0.25
"""Weight of a strand's own direction against the course of the hair around it: an end's own is noise."""
WALK_STEP, WALK_REACH, WALK_SPREAD = 0.5, 2.5, 1.0
"""mm: steps back through the hair, how far the nearest hair may be, and the Gaussian that neighbours are weighed by."""
WALK_POINTS, WALK_TURN = 16, 0.3
"""Neighbours that are listened to, and the weight of what they say against the way so far."""
WALK_AHEAD = WALK_STEP * ((1.0 - WALK_TURN) / WALK_TURN + 0.5)
"""mm ahead that they are asked at: by so much the way lags behind, and over a curved scalp a lag would lead off it."""
LONGEST_WALK = 150.0
"""mm that a strand is followed back at most."""
CLOSE, MERGED = 1.0, 10.0
"""mm: a strand is grown no farther beside its guide than this, and comes so close over this length (e-fold): farther off it
would lie where there is no hair."""


def grow_to_root(strands: Strands, rooted: np.ndarray, settings: GuideSettings) -> tuple[Strands, np.ndarray, np.ndarray]:
    """Grow directed strands that are not `rooted` (N,) back along the nearest rooted one, by its own steps (supplement 2,
    Algorithm 1), but drawn closer to it where it is farther than CLOSE.

    Rooted means that the first point is within reach of the scalp. Done in rounds, so that hair far from any fine strand is
    reached over what was grown before. Returns (strands with the grown points put before them, (N,) bool reached,
    (N,) float32 mm grown).
    """
    reached = np.asarray(rooted, bool).copy()
    grown = np.zeros(len(strands), np.float32)
    forward, _ = end_tangents(strands)
    forest: list[tuple[cKDTree, Strands, np.ndarray]] = []
    fresh = np.flatnonzero(reached)
    bare = Strands(strands.points, strands.offsets)
    current = bare.select(fresh)
    done, bodies = [fresh], [current]
    for reach in REACHES:
        for _ in range(MOST_ROUNDS):
            waiting = np.flatnonzero(~reached)
            if not len(waiting):
                break
            if len(fresh):
                forest.append((point_tree(current.points), current, current.tangents()))
            if not forest:
                break
            source, place, found = _guides_for(
                strands.roots[waiting], forward[waiting], forest, reach * settings.neighbour_radius
            )
            fresh = waiting[found]
            if not len(fresh):
                break
            guides = [one for _, one, _ in forest]
            current, grown[fresh] = _grown_beside(bare.select(fresh), guides, source[found], place[found])
            reached[fresh] = True
            done.append(fresh)
            bodies.append(current)
    rest = np.flatnonzero(~reached)
    order = np.argsort(np.concatenate([*done, rest]))
    out = concatenate([*bodies, bare.select(rest)]).select(order)
    return out.with_attributes(**strands.strand_attributes), reached, grown


def _grown_beside(strands: Strands, guides: list[Strands], source: np.ndarray, place: np.ndarray) -> tuple[Strands, np.ndarray]:
    """(the strands (N) with what their guides are before a point put before them, (N,) float32 mm of it): moved by how far they
    are from there, and by no more than CLOSE long before.

    source, place (N,): which of `guides` each grows along, and from which of its points.
    """
    hair = concatenate(guides)
    place = place + offsets_from_counts([len(one.points) for one in guides])[source]
    first = hair.offsets[np.searchsorted(hair.offsets, place, side="right") - 1]
    counts = place - first + 1
    offsets = offsets_from_counts(counts)
    owner = np.repeat(np.arange(len(strands)), counts)
    path = hair.points[(first - offsets[:-1])[owner] + np.arange(offsets[-1])]
    # the last point of each path is the one that its strand begins beside
    last = offsets[1:] - 1
    shift = strands.roots.astype(np.float64) - path[last]
    along = Strands(path, offsets).arc_lengths()
    before = (along[last][owner] - along)[:, None]
    close = np.minimum(CLOSE / np.maximum(np.linalg.norm(shift, axis=1), 1e-6), 1.0)[owner, None]
    path += (close + (1.0 - close) * np.exp(-before / MERGED)) * shift[owner]
    keep = np.ones(len(path), bool)
    keep[last] = False
    points = joined(path[keep], offsets_from_counts(counts - 1), strands.points, strands.offsets)
    out = Strands(points, offsets_from_counts(counts - 1 + strands.counts))
    return out, out.arc_lengths()[out.offsets[:-1] + counts - 1]


def _guides_for(ends, tangents, forest, reach):
    """The tree, the point in it and whether there is one, for each end (M, 3): near and of one direction."""
    source, place = np.zeros(len(ends), np.int64), np.zeros(len(ends), np.int64)
    best = np.full(len(ends), np.inf)
    for number, (tree, _, directions) in enumerate(forest):
        distance, near = nearest_points(tree, ends, CANDIDATES, reach)
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
    some = points_around(hair.points, places, COURSE_REACH)
    if not len(some):
        return normalized(own)
    points, tangents = hair.points[some], hair.tangents()[some].astype(np.float64)
    distance, near = nearest_points(point_tree(points), places, COURSE_POINTS, COURSE_REACH)
    found = np.isfinite(distance)
    tangents = tangents[np.where(found, near, 0)]
    along = found & (np.einsum("nkc,nc->nk", tangents, own) > 0.0)
    return normalized(normalized(np.einsum("nkc,nk->nc", tangents, along.astype(np.float64))) + OWN * own)


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
    path, taken, height = walked_back(strands, walkers, head, low, progress)
    arrived = height < max(TOUCH, low)
    low_now[walkers] = arrived
    counts[walkers] = np.where(arrived, taken, 0)
    offsets = offsets_from_counts(counts)
    walker = np.repeat(np.arange(len(walkers)), counts[walkers])
    back = np.repeat(taken, counts[walkers]) - (np.arange(offsets[-1]) - np.repeat(offsets[walkers], counts[walkers]))
    points = joined(path[back, walker], offsets, strands.points, strands.offsets)
    out = Strands(points, offsets_from_counts(counts + strands.counts), strands.strand_attributes)
    return out, low_now, (WALK_STEP * counts).astype(np.float32)


def walked_back(
    strands: Strands,
    walkers: np.ndarray,
    head: Head,
    low: float,
    progress: Progress = silent,
    glide: bool = False,
    longest: float = LONGEST_WALK,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The steps of the strands `walkers` (W,) back from their roots, until they are `low` (mm), have no hair around or came
    `longest` mm; with `glide` they go on over the head where they are low, as low as that.

    Returns (path (S + 1, W, 3) float32 mm, the root first; (W,) int64 steps taken; (W,) mm over the head at the last of them).
    """
    steps = round(min(longest, LONGEST_WALK) / WALK_STEP)
    path = np.zeros((steps + 1, len(walkers), 3), np.float32)
    path[0] = strands.roots[walkers]
    taken = np.zeros(len(walkers), np.int64)
    height = np.array(head.signed_distance(path[0]))
    hair = strands.resampled_by_step(2.0 * WALK_STEP)
    tree, index, tangents = point_tree(hair.points), hair.strand_index, hair.tangents().astype(np.float64)
    own, _ = end_tangents(strands)
    way = course_around(strands, path[0], own[walkers])
    going = np.arange(len(walkers))
    for step in range(1, steps + 1):
        progress(step - 1, steps)
        if not len(going):
            break
        place, onward = path[step - 1, going].astype(np.float64), way[going]
        distance, near = nearest_points(tree, place - WALK_AHEAD * onward, WALK_POINTS, WALK_REACH)
        found = np.isfinite(distance)
        near, distance = np.where(found, near, 0), np.where(found, distance, WALK_REACH)
        found &= index[near] != walkers[going][:, None]
        agreement = np.einsum("nkc,nc->nk", tangents[near], onward)
        weight = np.where(found & (agreement > 0.5), agreement * np.exp(-0.5 * (distance / WALK_SPREAD) ** 2), 0.0)
        heard = weight.sum(axis=1) > 1e-3
        mean = normalized(np.einsum("nkc,nk->nc", tangents[near], weight))
        going = going[heard]
        way[going] = normalized((1.0 - WALK_TURN) * onward + WALK_TURN * mean)[heard]
        path[step, going] = place[heard] - WALK_STEP * way[going]
        taken[going] = step
        height[going] = head.signed_distance(path[step, going])
        lowest = going[height[going] <= low]
        if glide and len(lowest):
            out = head.closest_scalp(path[step, lowest]).normal.astype(np.float64)
            path[step, lowest] += (low - height[lowest])[:, None] * out
            way[lowest] = normalized(way[lowest] - np.maximum((way[lowest] * out).sum(axis=1), 0.0)[:, None] * out)
        elif not glide:
            going = going[height[going] > low]
    return path, taken, height


@numba.njit(cache=True)
def joined(before, before_offsets, after, after_offsets):
    """The points of strands with others put before them: both (M, 3) float32, as many strands in each."""
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
