"""Strands as cubic curves of few control points, and back to polylines fine enough to draw (Cu in the paper's 3.3.2)."""

from __future__ import annotations

import numba
import numpy as np

from ..strands import Strands, _resample, offsets_from_counts
from .splat import cubic

TURN_PER_SEGMENT = 0.6
"""Radians that one cubic segment may turn: it then stays within 0.3 % of the radius of an arc."""
SEGMENT_LENGTH = 6.0
"""Longest segment of a straight strand, mm: bends shorter than a few of these are noise of the scan."""
LEAST_POINTS = 8
TURN_PER_EDGE = 0.25
LEAST_EDGES, MOST_EDGES = 15, 127
"""An output polyline turns at most 0.25 radian at a point where 16 to 128 points allow."""


def control_points(strands: Strands, most: int) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) float64 control points, equally spaced along each strand, and (N + 1,) offsets: more where a strand turns more."""
    even = strands.resampled_by_step(1.0)
    turning = _turning(even.points, even.offsets)
    wanted = np.maximum(strands.lengths() / SEGMENT_LENGTH, turning / TURN_PER_SEGMENT)
    counts = np.clip(np.ceil(wanted).astype(np.int64) + 1, min(LEAST_POINTS, most), most)
    return _resample(strands.points, strands.offsets, counts).astype(np.float64), offsets_from_counts(counts)


def polylines(points: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) float32 points on the cubics and (N + 1,) offsets: 16 to 128 points a strand, as it turns."""
    counts = np.diff(offsets)
    turning = _turning(points.astype(np.float32), offsets)
    edges = np.clip(np.ceil(turning / TURN_PER_EDGE).astype(np.int64), LEAST_EDGES, MOST_EDGES)
    edges = np.maximum(edges, np.minimum(counts - 1, MOST_EDGES))
    return _evaluate(points, offsets, offsets_from_counts(edges + 1))


def _evaluate(points: np.ndarray, offsets: np.ndarray, out_offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out = np.empty((out_offsets[-1], 3), np.float32)
    _evaluate_cubics(points, offsets, out_offsets, out)
    return out, out_offsets


@numba.njit(cache=True, parallel=True)
def _evaluate_cubics(points, offsets, out_offsets, out):
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        first, count = out_offsets[n], out_offsets[n + 1] - out_offsets[n]
        for s in range(count):
            place = s / (count - 1) * (end - start - 1)
            i = min(int(place), max(end - start - 2, 0))
            m = start + i
            if end - start < 2:
                for axis in range(3):
                    out[first + s, axis] = points[m, axis]
                continue
            at_start, at_end = m == start, m + 2 >= end
            p0 = m if at_start else m - 1
            p3 = m + 1 if at_end else m + 2
            a, b, c, d = cubic(place - i, at_start, at_end)
            for axis in range(3):
                out[first + s, axis] = (
                    a * points[p0, axis] + b * points[m, axis] + c * points[m + 1, axis] + d * points[p3, axis]
                )


@numba.njit(cache=True, parallel=True)
def _turning(points, offsets):
    """(N,) float64: the total angle, radians, that each polyline turns through."""
    turning = np.zeros(len(offsets) - 1)
    for n in numba.prange(len(offsets) - 1):
        for m in range(offsets[n] + 1, offsets[n + 1] - 1):
            dot, before, after = 0.0, 0.0, 0.0
            for axis in range(3):
                u = points[m, axis] - points[m - 1, axis]
                v = points[m + 1, axis] - points[m, axis]
                dot += u * v
                before += u * u
                after += v * v
            if before > 0.0 and after > 0.0:
                turning[n] += np.arccos(min(max(dot / np.sqrt(before * after), -1.0), 1.0))
    return turning
