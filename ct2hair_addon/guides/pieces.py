"""Segments cut in pieces wherever they may have gone over to another strand, so that joints can put them together anew."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..strands import Strands, nearest_points, point_tree, points_around

CONTACT = 2.0
"""voxel; the trace nearest to another's end, and this close, is cut beside it: one of them may have changed strands there."""
SHORTEST = 12
"""voxel; no cut is made closer to an end or another cut."""
KINK = 0.06
KINK_SPAN = 10
"""1/voxel; a trace is cut where its bend changes by more from one span (voxel) to the next: it may have left its strand."""
STEP = 1.0
"""voxel between the points of a piece, and of a joint."""


@dataclass(frozen=True)
class Pieces:
    """Segments in pieces: strands (mm), points a voxel apart; onward (P,) int64: the piece that each went on in, or -1; parent
    (P,): the segment that each is of."""

    strands: Strands
    onward: np.ndarray
    parent: np.ndarray

    def turned(self, back: np.ndarray) -> Pieces:
        """The pieces with those of `back` (P,) bool turned; two that now run against each other don't go on in each other."""
        before = np.flatnonzero(self.onward >= 0)
        after = self.onward[before]
        ahead, behind = ~back[before] & ~back[after], back[before] & back[after]
        onward = np.full(len(self.onward), -1, np.int64)
        onward[before[ahead]] = after[ahead]
        onward[after[behind]] = before[behind]
        return Pieces(self.strands.reversed(back), onward, self.parent)

    def cut(self, places: np.ndarray) -> Pieces:
        """The pieces cut before some of their points (rising, none a piece's first); each goes on in what is cut off."""
        offsets = np.sort(np.concatenate([self.strands.offsets, places]))
        of = self.strands.strand_index[offsets[:-1]]
        first = np.flatnonzero(np.isin(offsets[:-1], self.strands.offsets[:-1]))
        onward = np.arange(1, len(of) + 1)
        last = np.append(first[1:], len(of)) - 1
        onward[last] = np.where(self.onward >= 0, first[self.onward], -1)
        return Pieces(Strands(self.strands.points, offsets), onward, self.parent[of])

    def ends(self, fine: np.ndarray) -> np.ndarray:
        """(P,) int8: `fine` (N,) of the segments (1: the first point is a root, -1: the last one is) for the pieces."""
        out = np.zeros(len(self.onward), np.int8)
        first = np.ones(len(out), bool)
        first[self.onward[self.onward >= 0]] = False
        last = self.onward < 0
        out[first & (fine[self.parent] > 0)] = 1
        out[last & (fine[self.parent] < 0)] = -1
        return out


def cut_segments(segments: Strands, voxel: float) -> Pieces:
    """Undirected segments (mm) in pieces, cut where they are nearest to another's end and where their bend changes at once."""
    lines = segments.resampled_by_step(STEP * voxel)
    if not len(lines):
        return Pieces(lines, np.zeros(0, np.int64), np.zeros(0, np.int64))
    tangents, index = lines.tangents(), lines.strand_index
    ends = np.concatenate([lines.offsets[:-1], lines.offsets[1:] - 1])
    some = points_around(lines.points, lines.points[ends], CONTACT * voxel)
    tree = point_tree(lines.points[some])
    near = nearest_points(tree, lines.points[ends], 24, CONTACT * voxel)[1]
    row, column = np.nonzero(near < len(some))
    place, end = some[near[row, column]], ends[row]
    beside = (index[place] != index[end]) & (np.abs(np.einsum("nc,nc->n", tangents[place], tangents[end])) > 0.7)
    # the nearest, which the tree gives first
    nearest = np.unique(row[beside], return_index=True)[1]
    kinks = np.flatnonzero(_kinks(lines.points, lines.offsets, voxel, _course_weights()))
    cuts = np.unique(np.concatenate([place[beside][nearest], kinks]))
    cuts = cuts[(cuts - lines.offsets[index[cuts]] >= SHORTEST) & (lines.offsets[index[cuts] + 1] - cuts > SHORTEST)]
    cuts = cuts[_apart(cuts, SHORTEST)]
    offsets = np.sort(np.concatenate([lines.offsets, cuts]))
    onward = np.where(np.isin(offsets[1:-1], cuts, assume_unique=True), np.arange(1, len(offsets) - 1), -1)
    return Pieces(Strands(lines.points, offsets), np.append(onward, -1).astype(np.int64), index[offsets[:-1]])


def _course_weights() -> np.ndarray:
    """(2, KINK_SPAN + 1): of the parabola through as many places, a voxel apart, the direction in their middle and the second
    derivative, as their weighted sums."""
    t = np.arange(KINK_SPAN + 1, dtype=np.float64) - 0.5 * KINK_SPAN
    fit = np.linalg.pinv(np.stack([np.ones_like(t), t, t * t], axis=1))
    return np.stack([fit[1], 2.0 * fit[2]])


@numba.njit(cache=True, parallel=True)
def _kinks(points, offsets, voxel, weights):
    """(M,) bool: where the bend before and the bend behind a point, turned on to it as a circle's, differ by more than KINK,
    and most for SHORTEST around."""
    out = np.zeros(len(points), np.bool_)
    span = weights.shape[1] - 1
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        if end - start <= 2 * span:
            continue
        jump = np.zeros(end - start)
        way, bend = np.empty((2, 3)), np.empty((2, 3))
        for m in range(start + span, end - span):
            for side in range(2):
                square = 0.0
                for axis in range(3):
                    way[side, axis] = bend[side, axis] = 0.0
                    for k in range(span + 1):
                        value = points[m + k, axis] if side else points[m - k, axis]
                        way[side, axis] += weights[0, k] * value
                        bend[side, axis] += weights[1, k] * value
                    square += bend[side, axis] ** 2
                curvature = np.sqrt(square) / voxel
                turn = 0.5 * span * curvature
                for axis in range(3):
                    bend[side, axis] = (np.cos(turn) * bend[side, axis] + np.sin(turn) * curvature * way[side, axis]) / voxel
            jump[m - start] = np.sqrt(np.square(bend[1] - bend[0]).sum())
        for m in range(span, end - start - span):
            if jump[m] > KINK:
                most = True
                for k in range(max(m - SHORTEST, 0), min(m + SHORTEST + 1, end - start)):
                    if jump[k] > jump[m]:
                        most = False
                        break
                out[start + m] = most
    return out


@numba.njit(cache=True)
def _apart(places, least):
    """(C,) bool: of rising places those that lie `least` behind the last one taken."""
    taken = np.zeros(len(places), np.bool_)
    last = -least
    for n in range(len(places)):
        if places[n] - last >= least:
            taken[n] = True
            last = places[n]
    return taken
