"""Strands as cubic curves of few control points, and back to polylines fine enough to draw (Cu in the paper's 3.3.2)."""

from __future__ import annotations

import numba
import numpy as np

from ..strands import Strands, _resample, offsets_from_counts

TURN_PER_SEGMENT = 0.6
"""Radians that one cubic segment may turn: it then stays within 0.3 % of the radius of an arc."""
SEGMENT_LENGTH = 2.0
"""Longest segment of a straight strand, mm: hair bends within less than three of these where it leaves the scalp."""
LEAST_POINTS = 8
TURN_PER_EDGE = 0.25
"""Radians that an output polyline turns at a point, where 16 to 128 points allow."""
LONGEST_EDGE = 8.0
"""mm between two points of an output polyline where hair is straight."""
LEAST_EDGES, MOST_EDGES = 15, 127
EVEN = 2.0
"""voxel between points of strands that are handed on within the engine: a curl's chord is then a twentieth of one off."""
SAMPLES_PER_VOXEL = 2.0
"""Along a segment that is rendered or reads a volume."""
SHARES = (1 / 64, 6 / 64, 15 / 64, 20 / 64, 15 / 64, 6 / 64, 1 / 64)
"""Of what its neighbours want each segment gets so much: edges then grow by degrees."""


def segment_lengths(points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(M,) the distance from each point to the next of its strand; 0 at tips."""
    lengths = np.zeros(len(points))
    lengths[:-1] = np.linalg.norm(np.diff(points, axis=0), axis=1)
    lengths[offsets[1:][np.diff(offsets) > 0] - 1] = 0.0
    return lengths


def control_points(strands: Strands, most: int, longest: float = SEGMENT_LENGTH) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) float64 control points, equally spaced along each strand, and (N + 1,) offsets: more where a strand turns more.

    most: points of a strand; longest: mm between two of them.
    """
    even = strands.resampled_by_step(1.0)
    turning = _turning(even.points, even.offsets)
    wanted = np.maximum(strands.lengths() / longest, turning / TURN_PER_SEGMENT)
    counts = np.clip(np.ceil(wanted).astype(np.int64) + 1, min(LEAST_POINTS, most), most)
    return _resample(strands.points, strands.offsets, counts).astype(np.float64), offsets_from_counts(counts)


def polylines(points: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) float32 points on the cubics and (N + 1,) offsets: 16 to 128 points a strand, closer where it turns."""
    wanted = _edges_wanted(points, offsets)
    counts = np.clip(np.ceil(wanted[offsets[1:] - 1]).astype(np.int64), LEAST_EDGES, MOST_EDGES) + 1
    out_offsets = offsets_from_counts(counts)
    out = np.empty((out_offsets[-1], 3), np.float32)
    _evaluate_cubics(points, offsets, wanted, out_offsets, out)
    return out, out_offsets


def even_lines(points: np.ndarray, offsets: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) float64 points on the cubics, about `step` apart (mm), and (N + 1,) offsets."""
    along = np.zeros(len(points))
    along[1:] = np.cumsum(segment_lengths(points, offsets)[:-1])
    along -= np.repeat(along[offsets[:-1]], np.diff(offsets))
    counts = np.maximum(np.ceil(along[offsets[1:] - 1] / step).astype(np.int64), 1) + 1
    out_offsets = offsets_from_counts(counts)
    out = np.empty((out_offsets[-1], 3))
    _evaluate_cubics(points, offsets, along, out_offsets, out)
    return out, out_offsets


@numba.njit(cache=True, parallel=True)
def _edges_wanted(points, offsets):
    """(M,) float64: how many edges a strand wants from its root to each control point, by length and by turning."""
    wanted = np.zeros(len(points))
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        segments = end - start - 1
        if segments < 1:
            continue
        own = np.zeros(segments)
        for m in range(start, end - 1):
            length = 0.0
            for axis in range(3):
                length += (points[m + 1, axis] - points[m, axis]) ** 2
            own[m - start] = np.sqrt(length) / LONGEST_EDGE + 1e-9
        for m in range(start + 1, end - 1):
            turn = _turn(points, m) / TURN_PER_EDGE
            own[m - start - 1] += 0.5 * turn
            own[m - start] += 0.5 * turn
        total = 0.0
        for i in range(segments):
            for k, share in enumerate(SHARES):
                total += share * own[min(max(i + k - len(SHARES) // 2, 0), segments - 1)]
            wanted[start + i + 1] = total
    return wanted


@numba.njit(cache=True, parallel=True)
def _evaluate_cubics(points, offsets, wanted, out_offsets, out):
    """Points of the cubics at even shares of `wanted` (M,), rising along each strand; its ends exactly."""
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        first, count = out_offsets[n], out_offsets[n + 1] - out_offsets[n]
        if end - start < 2:
            for s in range(count):
                for axis in range(3):
                    out[first + s, axis] = points[start, axis]
            continue
        m = start
        for s in range(count):
            place = s / (count - 1) * wanted[end - 1]
            while m + 2 < end and wanted[m + 1] < place:
                m += 1
            t = min(max((place - wanted[m]) / (wanted[m + 1] - wanted[m]), 0.0), 1.0)
            at_start, at_end = m == start, m + 2 == end
            curve = spline(points, m, at_start, at_end)
            for axis, value in enumerate(spline_at(curve, t)):
                out[first + s, axis] = value if t < 1.0 else points[m + 1, axis]


@numba.njit(cache=True, parallel=True)
def local_curvature(points, offsets):
    """(M,) float64, 1/mm: how much strands turn a length around each control point (mm), two to either side counted as well."""
    out = np.zeros(len(points))
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        if end - start < 3:
            continue
        turns = np.zeros(end - start)
        length = 0.0
        for m in range(start + 1, end):
            length += np.sqrt(
                (points[m, 0] - points[m - 1, 0]) ** 2
                + (points[m, 1] - points[m - 1, 1]) ** 2
                + (points[m, 2] - points[m - 1, 2]) ** 2
            )
            if m + 1 < end:
                turns[m - start] = _turn(points, m)
        step = max(length / (end - start - 1), 1e-9)
        for i in range(end - start):
            total = weight = 0.0
            for k in range(max(i - 2, 1), min(i + 3, end - start - 1)):
                w = 3.0 - abs(k - i)
                total, weight = total + w * turns[k], weight + w
            out[start + i] = total / weight / step
    return out


@numba.njit(cache=True, inline="always")
def _turn(points, m):
    """The angle, radians, that a polyline turns through at its inner point m."""
    dot, before, after = 0.0, 0.0, 0.0
    for axis in range(3):
        u = points[m, axis] - points[m - 1, axis]
        v = points[m + 1, axis] - points[m, axis]
        dot += u * v
        before += u * u
        after += v * v
    if before == 0.0 or after == 0.0:
        return 0.0
    return np.arccos(min(max(dot / np.sqrt(before * after), -1.0), 1.0))


@numba.njit(cache=True, parallel=True)
def _turning(points, offsets):
    """(N,) float64: the total angle, radians, that each polyline turns through."""
    turning = np.zeros(len(offsets) - 1)
    for n in numba.prange(len(offsets) - 1):
        for m in range(offsets[n] + 1, offsets[n + 1] - 1):
            turning[n] += _turn(points, m)
    return turning


@numba.njit(cache=True)
def spline(points, m, first, last):
    """The Catmull-Rom cubic from control point m (at t = 0) to m + 1 (at t = 1), for `spline_at`: along each axis its
    coefficients from the constant one on. first, last: whether the strand ends there; the missing point is mirrored."""
    return _powers(points, m, first, last, 0), _powers(points, m, first, last, 1), _powers(points, m, first, last, 2)


@numba.njit(cache=True, inline="always")
def _powers(points, m, first, last, axis):
    p, q = points[m, axis], points[m + 1, axis]
    before = 2.0 * p - q if first else points[m - 1, axis]
    after = 2.0 * q - p if last else points[m + 2, axis]
    return p, 0.5 * (q - before), before - 2.5 * p + 2.0 * q - 0.5 * after, 1.5 * (p - q) + 0.5 * (after - before)


@numba.njit(cache=True)
def spline_at(curve, t):
    """The point (x, y, z) of a cubic (`spline`) at t in [0, 1]."""
    x, y, z = curve
    return (
        x[0] + t * (x[1] + t * (x[2] + t * x[3])),
        y[0] + t * (y[1] + t * (y[2] + t * y[3])),
        z[0] + t * (z[1] + t * (z[2] + t * z[3])),
    )


@numba.njit(cache=True, inline="always")
def segment_samples(points, m):
    """How many samples the segment from control point m to m + 1 gets."""
    dx = points[m + 1, 0] - points[m, 0]
    dy = points[m + 1, 1] - points[m, 1]
    dz = points[m + 1, 2] - points[m, 2]
    return max(1, int(np.ceil(SAMPLES_PER_VOXEL * np.sqrt(dx * dx + dy * dy + dz * dz))))
