"""Strands without a knot of their own, led to the knots that no strand has: where hair lies on hair, roots are hidden.

Pulled back into a tail, hair streams over the roots of other hair. What leaves the stream is known strand by strand, but not
where each entered it: some are taken for rooted where they leave it, others are followed back to where it begins. Knots tell.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..head import Head
from ..progress import Progress, silent
from ..strands import Strands, offsets_from_counts
from .growing import WALK_STEP, joined, walked_back
from .knots import chosen_knots

BESIDE = 1.2
"""mm beside a strand's way back over the scalp that its knot is usually off."""
FARTHEST = 4.0 * BESIDE
A_MILLIMETRE = 0.04
"""Cost of a millimetre back along that way: of two knots the nearer one."""
AS_FAR = 4.0
"""How far back knots are looked for, in the median of how far strands of the wig had to be followed: where hair stands up that
is a few millimetres, and a strand without a knot is one too many."""
CANDIDATES = 4
"""Knots looked at beside each step."""
LEAVING = 4.0
"""mm behind its knot at which a strand is among the hair."""
LOW = 0.8
"""mm over the scalp that it is at there."""


def lead_to_free_knots(
    strands: Strands, made: np.ndarray, rest: np.ndarray, free: np.ndarray, head: Head, progress: Progress = silent
) -> tuple[Strands, np.ndarray, np.ndarray]:
    """Strands with those of `rest` (R,) led back through the hair around them to one of the knots `free` (K, 3) mm each.

    made (N,): points at the root of each that were not traced. Each knot goes to one strand at most, so that they are as near
    as possible beside the strands' ways over the scalp, and not far back. A strand runs from its knot, over the way that it was
    followed, up to where it was traced; one without a knot stays as it is. Returns (strands, (N, 3) float64 the knots, (N,)
    bool which have one).
    """
    knots, tied = np.zeros((len(strands), 3)), np.zeros(len(strands), bool)
    if not len(rest) or not len(free):
        return strands, knots, tied
    way, counts = _ways(strands, made, rest, head, progress)
    owner, begin = np.repeat(np.arange(len(rest)), counts), np.repeat(offsets_from_counts(counts)[:-1], counts)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    back = along - along[begin]
    below = head.closest_scalp(way)
    near, knot = cKDTree(free).query(below.position, k=min(CANDIDATES, len(free)), distance_upper_bound=FARTHEST, workers=-1)
    near, knot = near.reshape(len(way), -1), knot.reshape(len(way), -1)
    followed = strands.arc_lengths()[strands.offsets[:-1] + made][made > 0]
    farthest = AS_FAR * np.median(followed) if len(followed) else 0.0
    step, column = np.nonzero(np.isfinite(near) & ((back >= LEAVING) & (back <= farthest))[:, None])
    cost = (near[step, column] / BESIDE) ** 2 + A_MILLIMETRE * back[step]
    # of the steps that pass a knot, the cheapest
    order = np.lexsort((cost, knot[step, column], owner[step]))
    step, pair, cost = step[order], owner[step[order]] * len(free) + knot[step, column][order], cost[order]
    once = np.unique(pair, return_index=True)[1]
    step, cost, pair = step[once], cost[once], pair[once]
    chosen = chosen_knots(pair // len(free), pair % len(free), cost, len(rest), len(free))
    won = np.flatnonzero(chosen >= 0)
    first = step[np.searchsorted(pair, won * len(free) + chosen[won])]
    return _relaid(strands, made, rest[won], free[chosen[won]], way, begin, first, below, head)


def _ways(strands: Strands, made: np.ndarray, rest: np.ndarray, head: Head, progress: Progress):
    """(points (S, 3) float32, counts (R,)): the ways back from first traced points; steps of WALK_STEP at their ends."""
    path, taken, _ = walked_back(strands, rest, head, LOW, progress, glide=True)
    own = made[rest]
    counts = own + 1 + taken
    offsets = offsets_from_counts(counts)
    owner = np.repeat(np.arange(len(rest)), counts)
    place = np.arange(offsets[-1]) - offsets[owner]
    known = place <= own[owner]
    points = np.empty((offsets[-1], 3), np.float32)
    points[known] = strands.points[(strands.offsets[rest] + own)[owner[known]] - place[known]]
    points[~known] = path[(place - own[owner])[~known], owner[~known]]
    return points, counts


def _relaid(strands, made, won, knot, way, begin, first, below, head):
    """The strands `won` from their `knot` (W, 3) on: over the scalp below their `way`, rising evenly to their traced part."""
    knots, tied = np.zeros((len(strands), 3)), np.zeros(len(strands), bool)
    knots[won], tied[won] = knot, True
    # steps from the last that leaves the scalp to the first behind the trace
    last = first - round(LEAVING / WALK_STEP)
    counts = np.zeros(len(strands), np.int64)
    counts[won] = np.maximum(last - begin[first], 0)
    offsets = offsets_from_counts(counts)
    owner = np.repeat(np.arange(len(won)), counts[won])
    step = np.repeat(last, counts[won]) - (np.arange(offsets[-1]) - offsets[won][owner])
    share = (step - begin[step]) / np.maximum(first - begin[first], 1)[owner]
    height = np.maximum(head.signed_distance(way[begin[first]]), LOW)
    aside = knot - below.position[first]
    up = LOW + (height[owner] - LOW) * (1.0 - share)
    points = below.position[step] + share[:, None] * aside[owner] + up[:, None] * below.normal[step]
    cut = np.where(tied, made, 0)
    keep = np.arange(len(strands.points)) - np.repeat(strands.offsets[:-1], strands.counts) >= np.repeat(cut, strands.counts)
    traced, traced_offsets = strands.points[keep], offsets_from_counts(strands.counts - cut)
    points = joined(points.astype(np.float32), offsets, traced, traced_offsets)
    out = Strands(points, offsets_from_counts(counts + strands.counts - cut), strands.strand_attributes)
    return out, knots, tied
