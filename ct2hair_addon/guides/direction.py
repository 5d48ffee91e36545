"""Which segments touch the scalp (Algorithm 1), and which end of every other one is its root (paper 3.2.2)."""

from __future__ import annotations

import numba
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from ..head import Head
from ..settings import GuideSettings
from ..strands import Strands, nearest_points, normalized, point_tree
from .coherence import contracted, settled

TANGENT_SPAN = 3.0
"""mm; the length at an end over which its direction is taken: a voxel or two would be noise."""
TOUCH = 3.0
"""mm; an end this close over the cleared net is a root whatever the segment's length (short hair has none of tau_l)."""
VOTE_STEP = 2.0
"""mm between the points that vote on directions."""
VOTERS = 12
"""Neighbouring points each of them listens to."""
SHARPNESS = 8
"""Power of the cosine between two points' hair that their vote goes by: in curls what crosses at an angle says nothing."""
MEETING, MEETING_COST = 30.0, 2.0
"""What a joint of cost 0 between two ends says, in neighbouring points' votes, and the cost by which that falls e-fold. With a
tenth of it more length runs the right way in curls, but strands are torn."""
SCALP_HINT = 0.02
"""How much the nearness of an end to the scalp says by itself, against neighbours that say about 1."""
PASSED, ROOTS_SEEN = 5.0, 0.5
"""mm over the scalp that strands pass on their way, and the share of those that do of which the roots must be seen to go by
roots alone: 0.64 and more in loose hair, 0.14 to 0.21 in tied."""
CHUNK = 65_536
"""Points whose neighbours are asked at once: what bounds memory."""
OPPOSED = 0.5
"""Share of its neighbours' votes against which a strand is no root's, whatever its end looks like."""


def end_tangents(strands: Strands, span: float = TANGENT_SPAN) -> tuple[np.ndarray, np.ndarray]:
    """((N, 3), (N, 3)) unit directions from each strand's first point into it, and from its last point back into it."""
    arc = strands.arc_lengths()
    first, last = strands.offsets[:-1], strands.offsets[1:] - 1
    index = strands.strand_index
    near_first = np.minimum(first + np.bincount(index[arc <= span], minlength=len(strands)), last)
    total = arc[last]
    near_last = np.maximum(last - np.bincount(index[total[index] - arc <= span], minlength=len(strands)), first)
    out = []
    for at, to in ((first, near_first), (last, near_last)):
        out.append(normalized((strands.points[to] - strands.points[at]).astype(np.float64)))
    return out[0], out[1]


def fine_ends(strands: Strands, head: Head, settings: GuideSettings) -> np.ndarray:
    """(N,) int8: 1 where the first point is a root on the scalp, -1 where the last one is, 0 for poor segments (Algorithm 1).

    A root end lies within `scalp_reach` of the scalp and leaves it within `scalp_angle` of its normal; the segment is at least
    `fine_length` long or the end within 3 mm. Where both ends are, the one that is closer and steeper wins.
    """
    forward, backward = end_tangents(strands)
    long = strands.lengths() >= settings.fine_length
    merit = np.full((2, len(strands)), -np.inf)
    for n, (ends, inward) in enumerate(((strands.roots, forward), (strands.tips, backward))):
        scalp = head.closest_scalp(ends)
        steep = (scalp.normal * inward).sum(axis=1)
        reached = (scalp.distance <= settings.scalp_reach) & (steep >= np.cos(np.radians(settings.scalp_angle)))
        reached &= long | (scalp.distance <= TOUCH)
        merit[n] = np.where(reached, steep - scalp.distance / settings.scalp_reach, -np.inf)
    sign = np.where(merit[0] >= merit[1], 1, -1)
    return np.where(np.isfinite(merit.max(axis=0)), sign, 0).astype(np.int8)


def roots_seen(strands: Strands, fine: np.ndarray, head: Head) -> bool:
    """Whether so many strands are `fine` (N,) that the hair's roots are seen, and not only where it happens to stand up."""
    low, high = (head.closest_scalp(ends).distance < PASSED for ends in (strands.roots, strands.tips))
    return bool(np.count_nonzero(fine) >= ROOTS_SEEN * np.count_nonzero(low != high))


def signs(
    strands: Strands,
    fine: np.ndarray,
    head: Head,
    settings: GuideSettings,
    seen: bool,
    meeting: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """(N,) float64 in [-1, 1]: above 0 where a strand runs root to tip as it is, below where it must be turned, magnitude
    for certainty.

    Each takes the sign that agrees best with its neighbours along the hair: in a signed graph of strands an edge is the summed
    agreement of their neighbouring points' tangents. meeting: pairs of strands whose ends meet, with sign and cost
    (`joints.meeting_ends`): edges too, since hair goes on as it came. Where hair stands off the scalp its roots are `seen`, and
    are sure: all other signs follow from these `fine` strands. Where it lies flat few roots are, and of what seems one half is
    hair that passes close by: the signs by which all of the hair agrees are taken there, if they agree better.
    """
    graph = _agreements(strands, settings.neighbour_radius, meeting)
    scale = np.asarray(abs(graph).sum(axis=1)).ravel()
    low, high = (head.closest_scalp(ends).distance.astype(np.float64) for ends in (strands.roots, strands.tips))
    hint = SCALP_HINT * np.clip((high - low) / np.maximum(strands.lengths(), 1.0), -1.0, 1.0)
    by_roots = settled(graph, scale, fine, fine != 0, hint)
    if seen:
        return by_roots
    # whatever is cut near the scalp, as many more strands begin there than end as there are roots
    leaves = np.exp(-((low / PASSED) ** 2)) - np.exp(-((high / PASSED) ** 2))
    flow = contracted(graph, fine + leaves)
    kept = (fine != 0) & (fine * (graph @ flow) > -OPPOSED * scale)
    by_flow = settled(graph, scale, np.where(kept, fine, flow), kept, leaves / (scale + 1.0))
    clue = scale * (fine + leaves)
    return max(by_flow, by_roots, key=lambda value: _agreed(graph, np.sign(value), clue))


def _agreed(graph: csr_matrix, sign: np.ndarray, clue: np.ndarray) -> float:
    """How well signs (N,) agree with one another and with what each strand's own ends tell."""
    return float(sign @ (graph @ sign) + sign @ clue)


def _agreements(strands: Strands, reach: float, meeting) -> csr_matrix:
    """(N, N) symmetric: by how many votes two strands run the same way (above 0) or against each other."""
    samples = strands.resampled_by_step(VOTE_STEP)
    index, tangents = samples.strand_index, samples.tangents().astype(np.float64)
    tree = point_tree(samples.points)
    parts = [(np.zeros(0), np.zeros(0, index.dtype), np.zeros(0, index.dtype))]
    for start in range(0, len(samples.points), CHUNK):
        distance, near = nearest_points(tree, samples.points[start : start + CHUNK], VOTERS + 1, reach)
        votes = _votes(start, distance, near, index, tangents, reach).ravel()
        cast = np.flatnonzero(votes)
        parts.append((votes[cast], index[start + cast // near.shape[1]], index[near.ravel()[cast]]))
    votes, one, other = (np.concatenate(of) for of in zip(*parts, strict=True))
    count = len(strands)
    graph = coo_matrix((votes, (one, other)), shape=(count, count)).tocsr()
    if meeting is not None:
        pairs, sign, cost = meeting
        weight = MEETING * sign * np.exp(-cost / MEETING_COST)
        graph = graph + coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    return (graph + graph.T).tocsr()


@numba.njit(cache=True, parallel=True)
def _votes(start, distance, near, index, tangents, spread):
    """(P, K) float64: by how much each point, from the `start`-th on, runs the way of those `near` it, `distance` mm off: above
    0, or against it, below; 0 for those of its own strand and where there is none."""
    out = np.zeros(near.shape)
    for n in numba.prange(len(near)):
        own = start + n
        for k in range(near.shape[1]):
            if not np.isfinite(distance[n, k]) or index[near[n, k]] == index[own]:
                continue
            agreement = 0.0
            for axis in range(3):
                agreement += tangents[own, axis] * tangents[near[n, k], axis]
            out[n, k] = np.sign(agreement) * abs(agreement) ** SHARPNESS * np.exp(-0.5 * (distance[n, k] / spread) ** 2)
    return out
