"""Which segments touch the scalp (Algorithm 1), and which end of every other one is its root (paper 3.2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from ..head import Head
from ..settings import GuideSettings
from ..strands import Strands, nearest_points, normalized, offsets_from_counts, point_tree
from .coherence import contracted, settled
from .pieces import SHORTEST, Pieces

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
MEETING, MEETING_COST = 10.0, 2.0
"""What a joint of cost 0 between two ends says, in neighbouring points' votes, and the cost by which that falls e-fold. With a
third of it more length runs the right way in curls, but strands are torn."""
GAINS = (1.1, 1.3, 1.6, 2.0, 3.0)
"""What signs are settled at one after the other, so that they grow certain together and no wall stays where two fronts met."""
CLIMB = 0.06
"""How much a strand's climb says by itself, against neighbours that say up to 1, for each unit of `_worth`."""
WORTH = 20.0
"""The most a climb is worth: it is always right."""
TURNED = 10.0
"""Votes that two parts of a piece must hear more of, each for its own sign, than the piece does for one: it is cut there."""
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


@dataclass(frozen=True)
class Votes:
    """What the points of strands, a few mm apart, hear from the nearest ones of others.

    strand: (M,) int64, the strand of each point, in their order. near: (M, K) int32 its neighbours. votes: (M, K) float32, by
    how much it runs their way: above 0, or against it, below; 0 where there is none. bonds: (N, N) symmetric, the votes of two
    strands' points for each other, summed.
    """

    strand: np.ndarray
    near: np.ndarray
    votes: np.ndarray
    bonds: csr_matrix


def neighbour_votes(strands: Strands, reach: float) -> Votes:
    """The votes of points within `reach` mm of each other."""
    samples = strands.resampled_by_step(VOTE_STEP)
    index, tangents = samples.strand_index, samples.tangents().astype(np.float64)
    near, votes = np.empty((len(index), VOTERS + 1), np.int32), np.empty((len(index), VOTERS + 1), np.float32)
    tree = point_tree(samples.points)
    for start in range(0, len(index), CHUNK):
        some = slice(start, start + CHUNK)
        distance, near[some] = nearest_points(tree, samples.points[some], VOTERS + 1, reach)
        votes[some] = _votes(start, distance, near[some], index, tangents, reach)
    return Votes(index, near, votes, _bonds(samples.offsets, index, near, votes))


def signs(
    strands: Strands,
    fine: np.ndarray,
    head: Head,
    seen: bool,
    votes: Votes,
    meeting: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """(N,) float64 in [-1, 1]: above 0 where a strand runs root to tip as it is, below where it must be turned, magnitude
    for certainty.

    Each takes the sign that agrees best with its neighbours along the hair: in a signed graph of strands an edge is the summed
    agreement of their neighbouring points' tangents (`votes`). meeting: pairs of strands whose ends meet, with sign and cost
    (`joints.meeting_ends`): edges too, since hair goes on as it came. Where hair stands off the scalp its roots are `seen`, and
    are sure: all other signs follow from these `fine` strands. Where it lies flat few roots are, and of what seems one half is
    hair that passes close by: the signs by which all of the hair agrees are taken there, if they agree better.
    """
    graph = votes.bonds if meeting is None else votes.bonds + _meetings(meeting, len(strands))
    scale = np.asarray(abs(graph).sum(axis=1)).ravel()
    low, high = (head.closest_scalp(ends).distance.astype(np.float64) for ends in (strands.roots, strands.tips))
    lengths = strands.lengths().astype(np.float64)
    climb = np.clip((high - low) / np.maximum(lengths, 1.0), -1.0, 1.0)
    by_roots = _from_roots(graph, scale, fine, climb, lengths)
    if seen:
        return by_roots
    # whatever is cut near the scalp, as many more strands begin there than end as there are roots
    leaves = np.exp(-((low / PASSED) ** 2)) - np.exp(-((high / PASSED) ** 2))
    flow = contracted(graph, fine + leaves)
    kept = (fine != 0) & (fine * (graph @ flow) > -OPPOSED * scale)
    by_flow = settled(graph, scale, np.where(kept, fine, flow), kept, leaves / (scale + 1.0))
    clue = scale * (fine + leaves)
    return max(by_flow, by_roots, key=lambda value: _agreed(graph, np.sign(value), clue))


def _from_roots(graph, scale, fine, climb, lengths) -> np.ndarray:
    """Signs that follow from the `fine` strands and from each one's `climb` (N,), by how much its last point is farther from
    the scalp than its first for its length: what that is worth in this wig the signs tell as they are found."""
    value, poor = fine.astype(np.float64), fine == 0
    worth = 1.0
    for gain in GAINS:
        value = settled(graph, scale, value, ~poor, CLIMB * worth * climb, gain)
        worth = _worth(climb[poor], np.sign(value[poor]), lengths[poor])
    return value


def _worth(climb: np.ndarray, sign: np.ndarray, lengths: np.ndarray) -> float:
    """The slope of the log-odds of a sign over the climb (logistic regression through the origin, weighted by length)."""
    edges = np.linspace(-1.0, 1.0, 65)
    here = 0.5 * (edges[1:] + edges[:-1])
    bin_ = np.clip(np.searchsorted(edges, climb) - 1, 0, len(here) - 1)
    weight = np.bincount(bin_, lengths, len(here))
    right = np.bincount(bin_, 0.5 * lengths * (1.0 + sign), len(here))
    slope = 1.0
    for _ in range(30):
        odds = 1.0 / (1.0 + np.exp(-slope * here))
        bend = (weight * here**2 * odds * (1.0 - odds)).sum()
        step = (here * (right - weight * odds)).sum() / max(bend, 1e-9)
        slope = float(np.clip(slope + np.clip(step, -3.0, 3.0), 0.0, WORTH))
    return slope


def _agreed(graph: csr_matrix, sign: np.ndarray, clue: np.ndarray) -> float:
    """How well signs (N,) agree with one another and with what each strand's own ends tell."""
    return float(sign @ (graph @ sign) + sign @ clue)


def _meetings(meeting, count: int) -> csr_matrix:
    pairs, sign, cost = meeting
    weight = MEETING * sign * np.exp(-cost / MEETING_COST)
    graph = coo_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    return (graph + graph.T).tocsr()


def cut_where_turned(pieces: Pieces, value: np.ndarray, votes: Votes) -> tuple[Pieces, Votes]:
    """Pieces cut where neighbours that run by `value` (P,) say one thing of what lies before and the contrary of what lies
    behind: the trace has gone over to a strand that runs the other way, from tip to tip or head-on. And their votes."""
    strands, index = pieces.strands, votes.strand
    offsets = np.searchsorted(index, np.arange(len(strands) + 1))
    before = _turns(offsets, index, votes.near, votes.votes, np.sign(value))
    share = (before - 0.5) / np.maximum(np.diff(offsets) - 1, 1)
    place = strands.offsets[:-1] + np.rint(share * (strands.counts - 1)).astype(np.int64)
    room = np.minimum(place - strands.offsets[:-1], strands.offsets[1:] - place)
    cut = np.flatnonzero((before > 0) & (room >= SHORTEST // 2))
    after = np.zeros(len(index), np.int64)
    after[offsets[cut] + before[cut]] = 1
    # points of the next strand are as many pieces on as cuts have been made
    strand = index + np.cumsum(after)
    cut_pieces = pieces.cut(place[cut])
    offsets = np.searchsorted(strand, np.arange(len(cut_pieces.strands) + 1))
    return cut_pieces, Votes(strand, votes.near, votes.votes, _bonds(offsets, strand, votes.near, votes.votes))


def _bonds(offsets, strand, near, votes) -> csr_matrix:
    columns, bonds = np.empty(near.size, np.int32), np.empty(near.size)
    counts = np.zeros(len(offsets) - 1, np.int64)
    _merge(offsets, strand, near, votes, columns, bonds, counts)
    starts = offsets_from_counts(counts)
    kept = np.repeat(offsets[:-1] * near.shape[1] - starts[:-1], counts) + np.arange(starts[-1])
    graph = csr_matrix((bonds[kept], columns[kept], starts), shape=(len(counts), len(counts)))
    return (graph + graph.T).tocsr()


@numba.njit(cache=True, parallel=True)
def _merge(offsets, strand, near, votes, columns, bonds, counts):
    """Of each strand, from its first point's votes on: the strands that they come from, rising, and the sums of their votes."""
    width = near.shape[1]
    for n in numba.prange(len(counts)):
        start = offsets[n] * width
        found = 0
        for m in range(offsets[n], offsets[n + 1]):
            for k in range(width):
                if votes[m, k] != 0.0:
                    columns[start + found] = strand[near[m, k]]
                    bonds[start + found] = votes[m, k]
                    found += 1
        others, said = columns[start : start + found].copy(), bonds[start : start + found].copy()
        last = -1
        for k in np.argsort(others):
            if last < 0 or columns[start + last] != others[k]:
                last += 1
                columns[start + last] = others[k]
                bonds[start + last] = 0.0
            bonds[start + last] += said[k]
        counts[n] = last + 1


@numba.njit(cache=True, parallel=True)
def _turns(offsets, strand, near, votes, sign):
    """(N,) int64: how many of a strand's points hear, by the `sign` of those around, more than TURNED votes for another sign
    than those behind them; 0 where none do."""
    out = np.zeros(len(offsets) - 1, np.int64)
    for n in numba.prange(len(out)):
        first, count = offsets[n], offsets[n + 1] - offsets[n]
        heard = np.zeros(count + 1)
        for m in range(count):
            total = 0.0
            for k in range(near.shape[1]):
                if votes[first + m, k] != 0.0:
                    total += votes[first + m, k] * sign[strand[near[first + m, k]]]
            heard[m + 1] = heard[m] + total
        most = TURNED
        for m in range(1, count):
            apart = abs(heard[m]) + abs(heard[count] - heard[m]) - abs(heard[count])
            if apart > most:
                most = apart
                out[n] = m
    return out


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
