"""Which pieces of strands leave something in which brick of a volume."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

from ..volume import BRICK

RIM = 1
"""Bricks around the stored ones that are looked at as well: what strands leave there spreads into them."""
FIRST, LAST = np.uint8(1), np.uint8(2)
"""Marks of a segment at which a strand begins, ends."""


@dataclass(frozen=True)
class Segments:
    """Segments of strands, from a control point to the next, by the brick that their samples leave something in.

    A segment in a brick is a pair. Bricks are counted from the rim around a volume's: index (R, 3) int32, those of the volume
    and all beside them, by x, y, z; table (x, y, z) int32: their row there, -1 where there is none. Those in brick b are
    `pair[start[b]:start[b + 1]]` and begin at the control points `segment[...]` (P,) int32; the pairs of segment m are
    `begin[m]` to `begin[m + 1]`. ends (M,) uint8: FIRST and LAST, by segment.
    """

    index: np.ndarray
    table: np.ndarray
    start: np.ndarray
    segment: np.ndarray
    pair: np.ndarray
    begin: np.ndarray
    ends: np.ndarray


def bin_segments(points: np.ndarray, offsets: np.ndarray, visible: np.ndarray, table: np.ndarray) -> Segments:
    """The segments by brick of a volume's `table`. points (M, 3) voxels; visible (M,): segments at 0 are left out."""
    around = ndimage.binary_dilation(np.pad(table >= 0, RIM), np.ones((3, 3, 3)))
    index = np.argwhere(around).astype(np.int32)
    rows = np.full(around.shape, -1, np.int32)
    rows[around] = np.arange(len(index), dtype=np.int32)
    ends = np.zeros(len(points), np.uint8)
    long = np.diff(offsets) > 1
    ends[offsets[:-1][long]] |= FIRST
    ends[offsets[1:][long] - 2] |= LAST
    counts = np.zeros(len(points), np.int64)
    _count_pairs(points, offsets, visible, rows, counts)
    begin = np.concatenate([[0], np.cumsum(counts)])
    brick = np.empty(begin[-1], np.int32)
    _list_pairs(points, offsets, visible, rows, begin, brick)
    start = np.zeros(len(index) + 1, np.int64)
    segment, pair = (np.empty(begin[-1], np.int32) for _ in range(2))
    _sort_pairs(begin, brick, start, segment, pair)
    return Segments(index, rows, start, segment, pair, begin, ends)


@numba.njit(cache=True, parallel=True)
def _count_pairs(points, offsets, visible, table, counts):
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        for m in range(start, end - 1):
            if visible[m] <= 0.0 and visible[m + 1] <= 0.0:
                continue
            ax, bx = _brick_range(points, m, start, end, 0, table.shape[0])
            ay, by = _brick_range(points, m, start, end, 1, table.shape[1])
            az, bz = _brick_range(points, m, start, end, 2, table.shape[2])
            found = 0
            for i in range(ax, bx + 1):
                for j in range(ay, by + 1):
                    for k in range(az, bz + 1):
                        found += table[i, j, k] >= 0
            counts[m] = found


@numba.njit(cache=True, parallel=True)
def _list_pairs(points, offsets, visible, table, begin, brick):
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        for m in range(start, end - 1):
            place = begin[m]
            if begin[m + 1] == place:
                continue
            ax, bx = _brick_range(points, m, start, end, 0, table.shape[0])
            ay, by = _brick_range(points, m, start, end, 1, table.shape[1])
            az, bz = _brick_range(points, m, start, end, 2, table.shape[2])
            for i in range(ax, bx + 1):
                for j in range(ay, by + 1):
                    for k in range(az, bz + 1):
                        if table[i, j, k] >= 0:
                            brick[place] = table[i, j, k]
                            place += 1


@numba.njit(cache=True)
def _sort_pairs(begin, brick, start, segment, pair):
    """Counting sort of pairs by brick, segments in order."""
    for n in range(len(brick)):
        start[brick[n] + 1] += 1
    for b in range(len(start) - 1):
        start[b + 1] += start[b]
    place = start.copy()
    for m in range(len(begin) - 1):
        for n in range(begin[m], begin[m + 1]):
            at = place[brick[n]]
            segment[at], pair[at] = m, n
            place[brick[n]] += 1


@numba.njit(cache=True, inline="always")
def _brick_range(points, m, start, end, axis, size):
    """The bricks along one axis, counted from the rim, that samples of the cubic from m to m + 1 can leave something in (by the
    hull of its Bezier points)."""
    p, q = points[m, axis], points[m + 1, axis]
    before = points[m - 1, axis] if m > start else 2.0 * p - q
    after = points[m + 2, axis] if m + 2 < end else 2.0 * q - p
    r, s = p + (q - before) / 6.0, q - (after - p) / 6.0
    low = min(min(p, q), min(r, s)) - 1e-6
    high = max(max(p, q), max(r, s)) + 1.0 + 1e-6
    return max(int(np.floor(low / BRICK)) + RIM, 0), min(int(np.floor(high / BRICK)) + RIM, size - 1)
