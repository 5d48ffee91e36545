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
