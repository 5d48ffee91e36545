"""How strands give way to a misfit: forces gathered along them, stiff steps, kept lengths, nothing inside the head (3.3.2).

The force is a Newton step: the gradient of the misfit over the curvature that a lone strand's misfit has. A step is the
solution of a small elastic problem per strand (data against the change of bend, the role of eqs. 4 and 5). Long waves
follow the data. Short ones stay where a strand was made up; where it was traced they are noise and hops between neighbours,
and go.
"""

from __future__ import annotations

import numba
import numpy as np

BAND = 3
HIDDEN_WEIGHT = 1e-2
"""What holds points that the scan can't show where they are: they go with their neighbours, but by and by."""


@numba.njit(cache=True, parallel=True)
def smooth_step(points, rest, offsets, forces, weights, smooth, rate, friction, limit, velocity):
    """One step of every strand towards the least of data + change of bend along (points - rest); roots stay.

    Solves, per strand and axis, (w + a K) d = rate * w * force - a K (points - rest), K = D3' D3 (third differences),
    a = (smooth / segment length)^6 at each point; then velocity = friction * velocity + d, cut to `limit`, moves the points.
    rest (M, 3): the shape that is kept, or zeros where a strand has none to keep and is to be smooth itself. smooth (M,), limit
    and lengths in the unit of `points`. Strands of fewer than 4 points are moved without stiffness.
    """
    for n in numba.prange(len(offsets) - 1):
        start, size = offsets[n], offsets[n + 1] - offsets[n]
        if size < 2:
            continue
        length = 0.0
        for m in range(start, start + size - 1):
            length += np.sqrt(
                (points[m + 1, 0] - points[m, 0]) ** 2
                + (points[m + 1, 1] - points[m, 1]) ** 2
                + (points[m + 1, 2] - points[m, 2]) ** 2
            )
        step = max(length / (size - 1), 1e-6)
        band = np.zeros((size, BAND + 1))
        right = np.zeros((size, 3))
        for i in range(size):
            w = weights[start + i]
            band[i, 0] = w + HIDDEN_WEIGHT
            for axis in range(3):
                right[i, axis] = rate * w * forces[start + i, axis]
        for i in range(size - BAND):
            # A band at most so stiff that float64 still resolves the data beside it.
            a = min((0.5 * (smooth[start + i + 1] + smooth[start + i + 2]) / step) ** 6, 1e8)
            for p in range(BAND + 1):
                for q in range(p, BAND + 1):
                    band[i + p, q - p] += a * third(p) * third(q)
            for axis in range(3):
                change = 0.0
                for p in range(BAND + 1):
                    change += third(p) * (points[start + i + p, axis] - rest[start + i + p, axis])
                for p in range(BAND + 1):
                    right[i + p, axis] -= a * third(p) * change
        # The root: a row of its own.
        band[0, :] = 0.0
        band[0, 0] = 1.0
        right[0, :] = 0.0
        solve_bands(band, right)
        for i in range(1, size):
            m = start + i
            speed = 0.0
            for axis in range(3):
                velocity[m, axis] = friction * velocity[m, axis] + right[i, axis]
                speed += velocity[m, axis] ** 2
            speed = np.sqrt(speed)
            cut = limit / speed if speed > limit else 1.0
            for axis in range(3):
                velocity[m, axis] *= cut
                points[m, axis] += velocity[m, axis]


@numba.njit(cache=True, inline="always")
def third(i):
    """The weights of a third difference."""
    return (-1.0, 3.0, -3.0, 1.0)[i]


@numba.njit(cache=True)
def solve_bands(band, right):
    """Solve a symmetric positive system in place (L D L'); band[i, k] couples i and i + k; right (n, axes)."""
    size, width = band.shape
    axes = right.shape[1]
    for i in range(size):
        for k in range(1, min(width, size - i)):
            f = band[i, k] / band[i, 0]
            for q in range(k, min(width, size - i)):
                band[i + k, q - k] -= f * band[i, q]
            for axis in range(axes):
                right[i + k, axis] -= f * right[i, axis]
    for i in range(size - 1, -1, -1):
        for axis in range(axes):
            value = right[i, axis]
            for k in range(1, min(width, size - i)):
                value -= band[i, k] * right[i + k, axis]
            right[i, axis] = value / band[i, 0]


@numba.njit(cache=True, parallel=True)
def keep_lengths(points, offsets, held, lengths, sweeps):
    """Pull neighbouring points of strands that are `held` (N,) bool back to their segment's length (M,) (that of point m to
    m + 1), the root held."""
    for n in numba.prange(len(offsets) - 1):
        if not held[n]:
            continue
        start, end = offsets[n], offsets[n + 1]
        for _ in range(sweeps):
            for m in range(start, end - 1):
                dx = points[m + 1, 0] - points[m, 0]
                dy = points[m + 1, 1] - points[m, 1]
                dz = points[m + 1, 2] - points[m, 2]
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                if length <= 1e-9:
                    continue
                excess = (length - lengths[m]) / length
                head, tail = (0.0, 1.0) if m == start else (0.5, 0.5)
                points[m, 0] += head * excess * dx
                points[m, 1] += head * excess * dy
                points[m, 2] += head * excess * dz
                points[m + 1, 0] -= tail * excess * dx
                points[m + 1, 1] -= tail * excess * dy
                points[m + 1, 2] -= tail * excess * dz


@numba.njit(cache=True, parallel=True)
def keep_outside(points, offsets, near, plane, margin):
    """Push points off the head's tangent planes: plane (M, 4) holds normal n and c; inside is n . x < c. Roots stay."""
    for n in numba.prange(len(offsets) - 1):
        for m in range(offsets[n] + 1, offsets[n + 1]):
            if near[m]:
                depth = (
                    margin + plane[m, 3] - points[m, 0] * plane[m, 0] - points[m, 1] * plane[m, 1] - points[m, 2] * plane[m, 2]
                )
                if depth > 0.0:
                    for axis in range(3):
                        points[m, axis] += depth * plane[m, axis]
