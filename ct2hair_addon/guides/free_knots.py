"""Strands without a knot of their own, led to the knots that no strand has: where hair lies on hair, roots are hidden.

Pulled back into a tail, hair streams over the roots of other hair. What leaves the stream is known strand by strand, but not
where each entered it: some are taken for rooted where they leave it, others are followed back to where it begins. Knots tell.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..head import Head
from ..progress import Progress, silent
from ..strands import Strands, nearest_points, offsets_from_counts
from .growing import WALK_STEP, joined, walked_back
from .knots import chosen_knots

BESIDE = 1.2
"""mm beside a strand's way back over the scalp that its knot is usually off."""
FARTHEST, ASIDE = 4.0 * BESIDE, 0.1
"""mm, and share of how far back knots are looked for, that one may lie beside it at most: strands make room for each other."""
FAR, FAR_COST = 2.0, 4.0
"""How many times BESIDE a knot costs the square of how far beside it is, and what each time more costs from there on."""
WITHOUT = 60.0
"""Cost of a strand without a knot: dearer than the dearest knot."""
A_MILLIMETRE = 0.04
"""Cost of a millimetre back along that way: of two knots the nearer one."""
AS_FAR = 4.0
"""How far back knots are looked for, in the median of how far strands of the wig had to be followed: where hair stands up that
is a few millimetres, and a strand without a knot is one too many."""
CANDIDATES, EVERY = 32, 4
"""Knots looked at beside a step, and of how many steps one is asked."""
LEAVING = 4.0
"""mm behind its knot at which a strand is among the hair."""
LOW = 0.8
"""mm over the scalp that it is at there."""
CHUNK = 1024
"""Strands whose ways are looked at together: some 200 MB where hair is hidden for 30 mm."""


def usually_followed(strands: Strands, made: np.ndarray) -> float:
    """How far strands were followed back, `made` (N,) points at their roots, mm: the median of those that were; 0 if none."""
    followed = strands.arc_lengths()[strands.offsets[:-1] + made][made > 0]
    return float(np.median(followed)) if len(followed) else 0.0


def lead_to_free_knots(
    strands: Strands,
    made: np.ndarray,
    rest: np.ndarray,
    free: np.ndarray,
    head: Head,
    progress: Progress = silent,
    usual: float | None = None,
) -> tuple[Strands, np.ndarray, np.ndarray]:
    """Strands with those of `rest` (R,) led back through the hair around them to one of the knots `free` (K, 3) mm each.

    made (N,): points at the root of each that were not traced. usual: how far the wig's strands usually had to be followed, mm
    (None: these, `usually_followed`). Each knot goes to one strand at most, so that they are as near as possible beside the
    strands' ways over the scalp, and not far back; where hair is hidden for long, most have one. A strand runs from its knot,
    over the way that it was followed, up to where it was traced, and nowhere higher than that way; one without a knot stays as
    it is. Returns (strands, (N, 3) float64 the knots, (N,) bool which have one).
    """
    knots, tied = np.zeros((len(strands), 3)), np.zeros(len(strands), bool)
    farthest = AS_FAR * (usually_followed(strands, made) if usual is None else usual)
    if not len(rest) or not len(free) or farthest < LEAVING:
        return strands, knots, tied
    way, counts = _ways(strands, made, rest, head, farthest, progress)
    offsets = offsets_from_counts(counts)
    tree = cKDTree(free)
    parts = []
    for low in range(0, len(rest), CHUNK):
        high = min(low + CHUNK, len(rest))
        owner, knot, cost, step = _passed(way[offsets[low] : offsets[high]], counts[low:high], tree, head, farthest)
        parts.append((owner + low, knot, cost, step + offsets[low]))
    owner, knot, cost, step = (np.concatenate(column) for column in zip(*parts, strict=True))
    chosen = chosen_knots(owner, knot, cost, len(rest), len(free), WITHOUT)
    won = np.flatnonzero(chosen >= 0)
    at = step[np.searchsorted(owner * len(free) + knot, won * len(free) + chosen[won])]
    return _relaid(strands, made, rest[won], free[chosen[won]], way, offsets[won], at, head)


def _passed(way, counts, tree, head, farthest):
    """Which knots of `tree` the ways (points (S, 3), `counts` (W,) each) pass, `farthest` mm back at most and no farther off:
    (owner, knot, cost, step) (J,) each, by owner and knot, each pair once, at the step that passes it the cheapest."""
    owner, begin = np.repeat(np.arange(len(counts)), counts), np.repeat(offsets_from_counts(counts)[:-1], counts)
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    back = along - along[begin]
    some = np.flatnonzero((back >= LEAVING) & (back <= farthest) & ((np.arange(len(back)) - begin) % EVERY == 0))
    below = head.closest_scalp(way[some]).position
    candidates = np.arange(1, min(CANDIDATES, tree.n) + 1)
    near, knot = nearest_points(tree, below, candidates, max(FARTHEST, ASIDE * farthest))
    row, column = np.nonzero(np.isfinite(near))
    step, knot = some[row], knot[row, column].astype(np.int64)
    # a way high over the head or beside the scalp may be above a knot, or nearest to it, and yet far from it
    within = np.linalg.norm(tree.data[knot] - way[begin[step]], axis=1) <= farthest
    row, column, step, knot = row[within], column[within], step[within], knot[within]
    beside = near[row, column] / BESIDE
    cost = np.where(beside < FAR, beside**2, FAR**2 + FAR_COST * (beside - FAR)) + A_MILLIMETRE * back[step]
    order = np.lexsort((cost, knot, owner[step]))
    order = order[np.unique(owner[step[order]] * tree.n + knot[order], return_index=True)[1]]
    return owner[step[order]], knot[order], cost[order], step[order]


def _ways(strands: Strands, made: np.ndarray, rest: np.ndarray, head: Head, farthest: float, progress: Progress):
    """(points (S, 3) float32, counts (R,)): the ways back from first traced points, `farthest` mm and more; steps of WALK_STEP
    at their ends."""
    # steps that glide over the head may be shorter
    path, taken, _ = walked_back(strands, rest, head, LOW, progress, glide=True, longest=1.5 * farthest)
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


def _relaid(strands, made, won, knot, way, begin, at, head):
    """The strands `won` from their `knot` (W, 3) on: over the scalp below their `way`, rising evenly to their traced part, but
    never over the way: it leads through hair, and above it there may be none.

    begin, at (W,): the points of `way` where they were traced from, and by their knot.
    """
    knots, tied = np.zeros((len(strands), 3)), np.zeros(len(strands), bool)
    knots[won], tied[won] = knot, True
    # steps from the last that leaves the scalp to the first behind the trace
    last = at - round(LEAVING / WALK_STEP)
    counts = np.zeros(len(strands), np.int64)
    counts[won] = np.maximum(last - begin, 0)
    offsets = offsets_from_counts(counts)
    owner = np.repeat(np.arange(len(won)), counts[won])
    step = np.repeat(last, counts[won]) - (np.arange(offsets[-1]) - offsets[won][owner])
    share = ((step - begin[owner]) / np.maximum(at - begin, 1)[owner])[:, None]
    height = head.signed_distance(way)
    ceiling = np.maximum(height, LOW)
    rising = np.minimum(LOW + (ceiling[begin[owner]] - LOW) * (1.0 - share[:, 0]), ceiling[step])
    aside = knot - head.closest_scalp(way[at]).position
    # relative to the way: beside the scalp, over a brow or an ear, all that is closest there is the scalp's edge
    points = way[step] + share * aside[owner] + (rising - height[step])[:, None] * head.closest_scalp(way[step]).normal
    cut = np.where(tied, made, 0)
    keep = np.arange(len(strands.points)) - np.repeat(strands.offsets[:-1], strands.counts) >= np.repeat(cut, strands.counts)
    traced, traced_offsets = strands.points[keep], offsets_from_counts(strands.counts - cut)
    points = joined(points.astype(np.float32), offsets, traced, traced_offsets)
    out = Strands(points, offsets_from_counts(counts + strands.counts - cut), strands.strand_attributes)
    return out, knots, tied
