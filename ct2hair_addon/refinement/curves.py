"""Strands as cubic curves of few control points, and back to polylines fine enough to draw (Cu in the paper's 3.3.2)."""

from __future__ import annotations

import numba
import numpy as np

from ..strands import Strands, _resample, offsets_from_counts
from .splat import cubic

TURN_PER_SEGMENT = 0.6
"""Radians that one cubic segment may turn: it then stays within 0.3 % of the radius of an arc."""
SEGMENT_LENGTH = 3.0
"""Longest segment of a straight strand, mm: hair bends within less than two of these where it leaves the scalp."""
LEAST_POINTS = 8
TURN_PER_EDGE = 0.25
"""Radians that an output polyline turns at a point, where 16 to 128 points allow."""
LONGEST_EDGE = 8.0
"""mm between two points of an output polyline where hair is straight."""
LEAST_EDGES, MOST_EDGES = 15, 127

BEND_STEP = 8.0
"""voxel; turning is measured over so much: shorter waves are noise of the tracing."""
EASED_TURN = 0.1
"""Radians that a strand turns over the length up to which it is eased: an arc then moves by a millionth of its radius."""
EASED_LEAST, EASED_MOST = 4.0, 10.0
"""voxel; the longest such length, and the shortest: hair that turns within less is a curl, and left as it was traced."""
EASED_BY = 0.5
"""voxel; easing moves a strand by no more than this, root mean square: as far as traces are off."""


def mean_curvature(strands: Strands, voxel: float) -> np.ndarray:
    """(N,) float64, 1/mm: how much each strand (mm) turns a length, waves of a few voxels left out. voxel: mm."""
    even = strands.resampled_by_step(BEND_STEP * voxel)
    return _turning(even.points, even.offsets) / np.maximum(strands.lengths(), 1e-6)


def segment_lengths(points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(M,) the distance from each point to the next of its strand; 0 at tips."""
    lengths = np.zeros(len(points))
    lengths[:-1] = np.linalg.norm(np.diff(points, axis=0), axis=1)
    lengths[offsets[1:][np.diff(offsets) > 0] - 1] = 0.0
    return lengths


def easing_lengths(curvature: np.ndarray, voxel: float) -> np.ndarray:
    """(N,) float64, mm: below which waves of strands of `mean_curvature` (N,), 1/mm, are noise of tracing; 0 for curls. voxel:
    mm."""
    length = np.minimum(EASED_TURN / np.maximum(curvature, 1e-6), EASED_MOST * voxel)
    return np.where(length < EASED_LEAST * voxel, 0.0, length)


def eased(points: np.ndarray, offsets: np.ndarray, lengths: np.ndarray, voxel: float) -> np.ndarray:
    """(M, 3) float64: evenly spaced points of strands, mm, without waves shorter than `lengths` (N,) mm: the least change of
    bend along each strand (third differences) within `EASED_BY` of where it was; roots stay."""
    counts = np.diff(offsets)
    index = np.repeat(np.arange(len(counts)), counts)
    steps = np.bincount(index, segment_lengths(points, offsets), len(counts)) / np.maximum(counts - 1, 1)
    out = np.array(points, np.float64)
    _ease(np.asarray(points, np.float64), offsets, lengths / np.maximum(steps, 1e-6), EASED_BY * voxel, out)
    return out


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
        # Neighbours share, so that the spacing changes by degrees.
        total = 0.0
        for i in range(segments):
            total += 0.25 * own[max(i - 1, 0)] + 0.5 * own[i] + 0.25 * own[min(i + 1, segments - 1)]
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
            p0 = m if at_start else m - 1
            p3 = m + 1 if at_end else m + 2
            a, b, c, d = cubic(t, at_start, at_end)
            for axis in range(3):
                out[first + s, axis] = (
                    a * points[p0, axis] + b * points[m, axis] + c * points[m + 1, axis] + d * points[p3, axis]
                )


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


ROOT_WEIGHT = 1e6
BAND = 3


@numba.njit(cache=True, parallel=True)
def _ease(points, offsets, length, most, out):
    """Per strand the x of least |x - p|^2 + length^6 |third differences of x|^2, with `length` (N,), in points, shortened
    until the root mean square of x - p is at most `most`; into `out`, which holds p."""
    for n in numba.prange(len(offsets) - 1):
        start, size = offsets[n], offsets[n + 1] - offsets[n]
        reach = length[n]
        while size > 2 * BAND and reach > 0.1:
            band = np.zeros((size, BAND + 1))
            a = reach**6
            for i in range(size - BAND):
                for p in range(BAND + 1):
                    for q in range(p, BAND + 1):
                        band[i + p, q - p] += a * _third(p) * _third(q)
            right = points[start : start + size].copy()
            for i in range(size):
                band[i, 0] += 1.0 if i else ROOT_WEIGHT
            for axis in range(3):
                right[0, axis] *= ROOT_WEIGHT
            _solve_bands(band, right)
            square = 0.0
            for i in range(size):
                for axis in range(3):
                    square += (right[i, axis] - points[start + i, axis]) ** 2
            if square <= most * most * size:
                out[start + 1 : start + size] = right[1:]
                break
            reach *= 0.8


@numba.njit(cache=True, inline="always")
def _third(i):
    """The weights of a third difference."""
    return (-1.0, 3.0, -3.0, 1.0)[i]


@numba.njit(cache=True)
def _solve_bands(band, right):
    """Solve a symmetric positive system in place (L D L'); band[i, k] couples i and i + k."""
    size, width = band.shape
    for i in range(size):
        for k in range(1, min(width, size - i)):
            f = band[i, k] / band[i, 0]
            for q in range(k, min(width, size - i)):
                band[i + k, q - k] -= f * band[i, q]
            for axis in range(3):
                right[i + k, axis] -= f * right[i, axis]
    for i in range(size - 1, -1, -1):
        for axis in range(3):
            value = right[i, axis]
            for k in range(1, min(width, size - i)):
                value -= band[i, k] * right[i + k, axis]
            right[i, axis] = value / band[i, 0]
