"""Strands as smooth curves: cubic Hermite interpolation through their points, sampled by arc length (supplement, section 3).

Tangents at the points are Bessel's (the parabola through a point and its two neighbours, by chord length), which is
Catmull-Rom where the points are equally spaced and stays free of loops where they are not; the ends are natural.
"""

from __future__ import annotations

import numba
import numpy as np

from ..strands import Strands, offsets_from_counts

SUBDIVISIONS = 8
"""Chords per segment that its arc length is measured with: a quarter circle in one segment is right to 0.2 %."""


def curve_arcs(strands: Strands) -> np.ndarray:
    """(M,) float64: the length of the smooth curve from the root to each point, mm."""
    return _arcs(strands.points, strands.offsets)


def sample_curves(strands: Strands, step: float, phase: float = 0.0) -> Strands:
    """Points of the smooth curves at the arc lengths `(phase + 0, 1, 2, ...) * step` from the root, mm.

    Points lie exactly `step` apart along the curve, so that counting them measures length; the rest beyond the last whole
    step is left out. A strand shorter than the first of them keeps its root. The points' source strand is that of the
    offsets; strand attributes are kept.
    """
    if not step > 0.0:
        raise ValueError(f"the step along a strand must be over 0 mm, got {step}")
    arcs = _arcs(strands.points, strands.offsets)
    counts = _sample_counts(strands.offsets, arcs, step, phase)
    offsets = offsets_from_counts(counts)
    points = _sampled(strands.points, strands.offsets, arcs, step, phase, offsets)
    return Strands(points, offsets, strands.strand_attributes)


@numba.njit(cache=True, inline="always")
def _slope(points, m, axis, before, after):
    """Derivative by chord length at point m, `before` and `after` being the chords on its two sides (0 where none)."""
    rising = (points[m + 1, axis] - points[m, axis]) / after if after > 0.0 else 0.0
    falling = (points[m, axis] - points[m - 1, axis]) / before if before > 0.0 else 0.0
    if before > 0.0 and after > 0.0:
        return (falling * after + rising * before) / (before + after)
    return rising + falling


@numba.njit(cache=True, inline="always")
def _chord(points, m):
    """Length of the chord from point m to the next."""
    dx = np.float64(points[m + 1, 0]) - points[m, 0]
    dy = np.float64(points[m + 1, 1]) - points[m, 1]
    dz = np.float64(points[m + 1, 2]) - points[m, 2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@numba.njit(cache=True)
def segment_curve(points, first, last, m, curve):
    """Fill `curve` (4, 3) with the cubic c0 + c1 t + c2 t^2 + c3 t^3 from point m to m + 1 of the strand [first, last].

    Returns the chord. For kernels.
    """
    chord = _chord(points, m)
    before = _chord(points, m - 1) if m > first else 0.0
    after = _chord(points, m + 1) if m + 1 < last else 0.0
    for axis in range(3):
        p, q = np.float64(points[m, axis]), np.float64(points[m + 1, axis])
        straight = q - p
        start = _slope(points, m, axis, before, chord) * chord
        end = _slope(points, m + 1, axis, chord, after) * chord
        if m == first:
            start = 1.5 * straight - 0.5 * end
        if m + 1 == last:
            end = 1.5 * straight - 0.5 * start
        if m == first and m + 1 == last:
            start = straight
            end = straight
        curve[0, axis] = p
        curve[1, axis] = start
        curve[2, axis] = 3.0 * straight - 2.0 * start - end
        curve[3, axis] = start + end - 2.0 * straight
    return chord


@numba.njit(cache=True, inline="always")
def on_curve(curve, t, axis):
    """The coordinate of a segment's cubic at t in [0, 1]. For kernels."""
    return curve[0, axis] + t * (curve[1, axis] + t * (curve[2, axis] + t * curve[3, axis]))


@numba.njit(cache=True)
def segment_lengths(curve, lengths):
    """Fill `lengths` (SUBDIVISIONS + 1) with the arc length at t = 0, 1/8, ... 1. For kernels."""
    lengths[0] = 0.0
    x, y, z = curve[0, 0], curve[0, 1], curve[0, 2]
    for s in range(1, SUBDIVISIONS + 1):
        t = s / SUBDIVISIONS
        a, b, c = on_curve(curve, t, 0), on_curve(curve, t, 1), on_curve(curve, t, 2)
        lengths[s] = lengths[s - 1] + np.sqrt((a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2)
        x, y, z = a, b, c


@numba.njit(cache=True, inline="always")
def parameter_at(lengths, wanted):
    """The t in [0, 1] at arc length `wanted` of a segment. For kernels."""
    s = 0
    while s < SUBDIVISIONS - 1 and lengths[s + 1] < wanted:
        s += 1
    span = lengths[s + 1] - lengths[s]
    return (s + ((wanted - lengths[s]) / span if span > 0.0 else 0.0)) / SUBDIVISIONS


@numba.njit(cache=True, parallel=True)
def _arcs(points, offsets):
    arcs = np.zeros(len(points))
    for n in numba.prange(len(offsets) - 1):
        first, last = offsets[n], offsets[n + 1] - 1
        curve = np.empty((4, 3))
        lengths = np.empty(SUBDIVISIONS + 1)
        for m in range(first, last):
            segment_curve(points, first, last, m, curve)
            segment_lengths(curve, lengths)
            arcs[m + 1] = arcs[m] + lengths[SUBDIVISIONS]
    return arcs


@numba.njit(cache=True)
def first_sample(arc, step, phase):
    """The number of the first sample at or after an arc length. For kernels."""
    return max(int(np.ceil(arc / step - phase)), 0)


@numba.njit(cache=True, parallel=True)
def _sample_counts(offsets, arcs, step, phase):
    counts = np.zeros(len(offsets) - 1, np.int64)
    for n in numba.prange(len(counts)):
        if offsets[n + 1] > offsets[n]:
            # the end itself is no sample: a sample belongs to the segment [arc, next arc) that it lies in
            counts[n] = max(first_sample(arcs[offsets[n + 1] - 1], step, phase), 1)
    return counts


@numba.njit(cache=True, parallel=True)
def _sampled(points, offsets, arcs, step, phase, starts):
    out = np.empty((starts[-1], 3), np.float32)
    for n in numba.prange(len(offsets) - 1):
        if starts[n + 1] == starts[n]:
            continue
        first, last = offsets[n], offsets[n + 1] - 1
        for axis in range(3):
            out[starts[n], axis] = points[first, axis]
        curve = np.empty((4, 3))
        lengths = np.empty(SUBDIVISIONS + 1)
        for m in range(first, last):
            low, high = first_sample(arcs[m], step, phase), first_sample(arcs[m + 1], step, phase)
            if high <= low:
                continue
            segment_curve(points, first, last, m, curve)
            segment_lengths(curve, lengths)
            for s in range(low, high):
                t = parameter_at(lengths, (s + phase) * step - arcs[m])
                for axis in range(3):
                    out[starts[n] + s, axis] = on_curve(curve, t, axis)
    return out
