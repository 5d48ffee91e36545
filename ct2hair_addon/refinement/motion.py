"""How strands give way to a misfit: forces gathered along them, stiff steps, kept lengths, nothing inside the head (3.3.2).

The force is a Newton step: the gradient of the misfit over the curvature that a lone strand's misfit has. A step is the
solution of a small elastic problem per strand (data against the bending of the displacement, the role of eqs. 4 and 5):
long waves follow the data, short ones keep the shape that the strand had, so curls stay and hops between neighbours don't grow.
"""

from __future__ import annotations

import numba
import numpy as np

from ..volume.grid import voxel
from .splat import cubic, segment_samples


@numba.njit(cache=True, parallel=True)
def gather_forces(points, offsets, visible, table, potential, forces, weights):
    """The force on every control point: minus the gradient of `potential` across the strand, averaged over its samples.

    points (M, 3) voxels; potential (B, 16, 16, 16) over `table`. Writes forces (M, 3) and weights (M,) (share of visible
    length around the point, 0..1). The part along the strand is left out: it would only slide points.
    """
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        total = np.zeros(end - start)
        shown = np.zeros(end - start)
        for m in range(start, end):
            forces[m, 0] = forces[m, 1] = forces[m, 2] = 0.0
        for m in range(start, end - 1):
            first, last = m == start, m + 2 >= end
            p0 = m if first else m - 1
            p3 = m + 1 if last else m + 2
            count = segment_samples(points, m)
            px, py, pz = points[m, 0], points[m, 1], points[m, 2]
            for s in range(count):
                wa, wb, wc, wd = cubic((s + 1.0) / count, first, last)
                qx = wa * points[p0, 0] + wb * points[m, 0] + wc * points[m + 1, 0] + wd * points[p3, 0]
                qy = wa * points[p0, 1] + wb * points[m, 1] + wc * points[m + 1, 1] + wd * points[p3, 1]
                qz = wa * points[p0, 2] + wb * points[m, 2] + wc * points[m + 1, 2] + wd * points[p3, 2]
                tx, ty, tz = qx - px, qy - py, qz - pz
                length = np.sqrt(tx * tx + ty * ty + tz * tz)
                x, y, z = 0.5 * (px + qx), 0.5 * (py + qy), 0.5 * (pz + qz)
                px, py, pz = qx, qy, qz
                if length <= 0.0:
                    continue
                t = (s + 0.5) / count
                seen = (1.0 - t) * visible[m] + t * visible[m + 1]
                wm, wn = length * (1.0 - t), length * t
                total[m - start] += wm
                total[m + 1 - start] += wn
                if seen <= 0.0:
                    continue
                gx, gy, gz = _gradient(table, potential, x, y, z)
                along = (gx * tx + gy * ty + gz * tz) / (length * length)
                gx, gy, gz = gx - along * tx, gy - along * ty, gz - along * tz
                forces[m, 0] -= seen * wm * gx
                forces[m, 1] -= seen * wm * gy
                forces[m, 2] -= seen * wm * gz
                forces[m + 1, 0] -= seen * wn * gx
                forces[m + 1, 1] -= seen * wn * gy
                forces[m + 1, 2] -= seen * wn * gz
                shown[m - start] += seen * wm
                shown[m + 1 - start] += seen * wn
        for m in range(start, end):
            weights[m] = shown[m - start] / max(total[m - start], 1e-9)
            for axis in range(3):
                forces[m, axis] /= max(shown[m - start], 1e-9)


@numba.njit(cache=True)
def _gradient(table, bricks, x, y, z):
    """The gradient of the trilinear interpolant, per voxel; 0 is taken outside the bricks."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - i, y - j, z - k
    nothing = np.float32(0.0)
    v000 = voxel(table, bricks, nothing, i, j, k)
    v001 = voxel(table, bricks, nothing, i, j, k + 1)
    v010 = voxel(table, bricks, nothing, i, j + 1, k)
    v011 = voxel(table, bricks, nothing, i, j + 1, k + 1)
    v100 = voxel(table, bricks, nothing, i + 1, j, k)
    v101 = voxel(table, bricks, nothing, i + 1, j, k + 1)
    v110 = voxel(table, bricks, nothing, i + 1, j + 1, k)
    v111 = voxel(table, bricks, nothing, i + 1, j + 1, k + 1)
    ex, ey, ez = 1.0 - fx, 1.0 - fy, 1.0 - fz
    gx = ey * (ez * (v100 - v000) + fz * (v101 - v001)) + fy * (ez * (v110 - v010) + fz * (v111 - v011))
    gy = ex * (ez * (v010 - v000) + fz * (v011 - v001)) + fx * (ez * (v110 - v100) + fz * (v111 - v101))
    gz = ex * (ey * (v001 - v000) + fy * (v011 - v010)) + fx * (ey * (v101 - v100) + fy * (v111 - v110))
    return gx, gy, gz


@numba.njit(cache=True, parallel=True)
def stiff_step(points, rest, offsets, forces, weights, stiffness, rate, friction, limit, velocity):
    """One step of every strand towards the minimum of data + bending of the displacement from `rest`; roots stay.

    Solves, per strand and axis, (w + a K) d = rate * w * force - a K (points - rest), K = D2' D2 (second differences),
    a = (stiffness / segment length)^4 at each point; then velocity = friction * velocity + d, cut to `limit`, moves the points.
    stiffness (M,), limit and lengths in the unit of `points`.
    """
    for n in numba.prange(len(offsets) - 1):
        start, size = offsets[n], offsets[n + 1] - offsets[n]
        if size < 2:
            continue
        length = 0.0
        for m in range(start, start + size - 1):
            length += np.sqrt(
                (rest[m + 1, 0] - rest[m, 0]) ** 2 + (rest[m + 1, 1] - rest[m, 1]) ** 2 + (rest[m + 1, 2] - rest[m, 2]) ** 2
            )
        step = max(length / (size - 1), 1e-6)
        diagonal, one, two = np.zeros(size), np.zeros(size), np.zeros(size)
        right = np.zeros((size, 3))
        for i in range(size):
            w = weights[start + i]
            diagonal[i] = w + 1e-3
            for axis in range(3):
                right[i, axis] = rate * w * forces[start + i, axis]
        for i in range(1, size - 1):
            # A band at most so stiff that float64 still resolves the data beside it.
            a = min((stiffness[start + i] / step) ** 4, 1e8)
            diagonal[i - 1] += a
            diagonal[i] += 4.0 * a
            diagonal[i + 1] += a
            one[i - 1] -= 2.0 * a
            one[i] -= 2.0 * a
            two[i - 1] += a
            for axis in range(3):
                bend = 0.0
                bend += points[start + i - 1, axis] - rest[start + i - 1, axis]
                bend -= 2.0 * (points[start + i, axis] - rest[start + i, axis])
                bend += points[start + i + 1, axis] - rest[start + i + 1, axis]
                right[i - 1, axis] -= a * bend
                right[i, axis] += 2.0 * a * bend
                right[i + 1, axis] -= a * bend
        # The root: a row of its own.
        diagonal[0], one[0], two[0] = 1.0, 0.0, 0.0
        for axis in range(3):
            right[0, axis] = 0.0
        _solve_band(diagonal, one, two, right)
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


@numba.njit(cache=True)
def _solve_band(diagonal, one, two, right):
    """Solve a symmetric pentadiagonal system in place (L D L'); one[i] couples i and i + 1, two[i] couples i and i + 2."""
    size = len(diagonal)
    for i in range(size):
        if i + 1 < size:
            f = one[i] / diagonal[i]
            diagonal[i + 1] -= f * one[i]
            if i + 2 < size:
                one[i + 1] -= f * two[i]
                g = two[i] / diagonal[i]
                diagonal[i + 2] -= g * two[i]
                for axis in range(3):
                    right[i + 2, axis] -= g * right[i, axis]
            for axis in range(3):
                right[i + 1, axis] -= f * right[i, axis]
    for i in range(size - 1, -1, -1):
        for axis in range(3):
            value = right[i, axis]
            if i + 1 < size:
                value -= one[i] * right[i + 1, axis]
            if i + 2 < size:
                value -= two[i] * right[i + 2, axis]
            right[i, axis] = value / diagonal[i]


@numba.njit(cache=True, parallel=True)
def keep_lengths(points, offsets, lengths, sweeps):
    """Pull neighbouring points back to their segment's length (M,) (that of point m to m + 1), the root held."""
    for n in numba.prange(len(offsets) - 1):
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
