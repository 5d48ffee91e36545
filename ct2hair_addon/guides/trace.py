"""Following strands through the density and taking each found one out, so that its neighbour shows.

In place of the paper's mean shift and Euler steps (3.2.2): segments come straight from the density. A batch of seeds is
followed in parallel through the same residual; then, in the batch's order, each path is held against what the earlier ones
have left, and what stands is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numba
import numpy as np

from ..progress import Progress, silent
from ..settings import GuideSettings
from ..strands import offsets_from_counts
from ..volume.grid import BrickVolume
from ..volume.strand_signal import StrandProfile, add_strand
from .sampling import centred, course_at, density_at, line_mean, plane

MOST_STEPS = 3000
"""Steps to one side of a seed at most: over a metre of hair at 0.4 mm."""
BATCH = 256
"""Seeds followed at once: few enough that two of them seldom meet the same strand, many enough for any number of threads."""
WINDOW = 128
"""Times as many seeds are looked at for those at a time, at most."""
ALIVE, FAINT = 0.55, 0.2
"""Shares of a strand's density that must be left along a seed's line for it to be followed: at its peak, and where it lies, or
the peak is not looked for."""
LOOK = 10
"""voxel; how far ahead the density is summed."""
RINGS = ((0.12, 6), (0.26, 8), (0.45, 10))
"""Directions tried around the present one: (tangent of the angle, how many)."""
TURN_COST = 0.8
"""Share of a strand's density that a turn by one radian in one step must win to be taken."""
BEND_SPAN = 8
"""Steps between the three points of a path that its bend is taken from."""
LEAST_SPAN = 4
"""And near its beginning at least."""
SECANT, INERTIA = 4, 0.3
"""Steps whose secant the direction leans on, and by which share."""
HISTORY = 2 * BEND_SPAN + 1
"""Points that tell the bend."""
LEAST_BEND = 0.015
"""1/voxel; less is noise: a bend of this size and below is not looked ahead along."""
OFF_COURSE = 4.0
"""Share of a strand's density that a step square to the hair's course must win to be taken, where the course is sure."""
OTHER_HAIR = 0.8
"""Cosine to the course below which it is that of other hair."""
DRAWN = (0.3, 0.08)
"""Share of a step by which a path is drawn to the density's ridge with each, where the course is unsure, a curl, say, and where
it is sure: there more than this would draw it over to a neighbour."""
SURE = 1 / 3
"""The course's trust from which on it is sure: that of a confidence of 0.93."""
BESIDE, EVEN = 1.0, 16
"""voxel to both sides of a path, in the plane of its bend, where the density is compared, and points before and behind over
which that is summed: how far a path runs inside of its curl."""
WIDENINGS, WIDEST = 2, 0.25
"""How often that is done, since neighbours make it look less; and how far a path is moved out each time at most, voxel."""
SUPPORT = 0.4
"""Share of a lone strand's density, averaged over the look-ahead, below which a path ends."""
SHARPNESS, ASIDE = 0.06, 4.0
"""Share of a strand's density by which one direction must beat another to count e times as much, and how many times that it
may be behind to count at all."""
MOST = 1.3
"""What a place counts at most, lone strands' densities: no hair is followed for its neighbours' sake."""


class End(IntEnum):
    """Why a path ended."""

    FAINT = 0
    TURN = 1
    LONG = 2
    LOOP = 3
    TAKEN = 4


END_NAMES = {
    End.FAINT: "ended: density too low ahead",
    End.TURN: "ended: turn too sharp",
    End.LONG: "ended: longest path",
    End.LOOP: "ended: ran in a circle",
    End.TAKEN: "ended: met a strand already found",
}


def _fan() -> np.ndarray:
    """(D, 2): offsets in the normal plane of the directions tried, the straight one first."""
    fan = [(0.0, 0.0)]
    for n, (tangent, count) in enumerate(RINGS):
        for a in range(count):
            angle = 2.0 * np.pi * (a + 0.5 * n) / count
            fan.append((tangent * np.cos(angle), tangent * np.sin(angle)))
    return np.array(fan)


FAN = _fan()
WEIGHTS = np.linspace(1.0, 0.4, LOOK)
"""Weights of the look-ahead's samples: what is near says more, since hair curves."""


@numba.njit(cache=True, nogil=True)
def _bend(path, count, dx, dy, dz):
    """The bend (1/voxel) at the end of a path of `count` points that goes on along d: the circle's through three of its points,
    square to d, less what noise may make; 0 where the path is too short to tell."""
    span = min(BEND_SPAN, (count - 1) // 2)
    if span < LEAST_SPAN:
        return 0.0, 0.0, 0.0
    p, q, r = path[count - 1], path[count - 1 - span], path[count - 1 - 2 * span]
    ux, uy, uz = float(p[0] - q[0]), float(p[1] - q[1]), float(p[2] - q[2])
    vx, vy, vz = float(q[0] - r[0]), float(q[1] - r[1]), float(q[2] - r[2])
    nx, ny, nz = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
    sides = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz)
    third = (ux + vx) ** 2 + (uy + vy) ** 2 + (uz + vz) ** 2
    curvature = 2.0 * np.sqrt((nx * nx + ny * ny + nz * nz) / max(sides * third, 1e-12))
    bx, by, bz = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
    noise = LEAST_BEND * BEND_SPAN**2 / max(curvature * span**2, 1e-9)
    scale = curvature * max(1.0 - noise**2, 0.0) / max(np.sqrt(bx * bx + by * by + bz * bz), 1e-9)
    return scale * bx, scale * by, scale * bz


@numba.njit(cache=True, nogil=True)
def _arc(curvature, step, far, aside):
    """Fill `far` and `aside` with how far ahead, and to the side for each unit of bend, an arc is after 1, 2, ... steps."""
    if curvature * step < 1e-3:
        for k in range(len(far)):
            far[k], aside[k] = (k + 1.0) * step, 0.5 * ((k + 1.0) * step) ** 2
        return
    cosine, sine = np.cos(curvature * step), np.sin(curvature * step)
    c, s = 1.0, 0.0
    for k in range(len(far)):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        far[k], aside[k] = s / curvature, (1.0 - c) / curvature**2


@numba.njit(cache=True, nogil=True)
def _follow(table, bricks, course, x, y, z, dx, dy, dz, step, turn, seen, fan, weights, path, known):
    """Follow one way from (x, y, z) along d into `path` (n, 3) voxels, whose first `known` points, if any, led there; returns
    (points, reason)."""
    whole, strands = weights.sum(), 1.0 / seen
    count = known
    start_x, start_y, start_z = x, y, z
    scores, far, aside = np.empty(len(fan)), np.empty(len(weights)), np.empty(len(weights))
    while True:
        if count == len(path):
            return count, End.LONG
        ux, uy, uz, vx, vy, vz = plane(dx, dy, dz)
        # Hair goes on bending as it did: the look-ahead bends along, or in a curl it would see the neighbours.
        bx, by, bz = _bend(path, count, dx, dy, dz)
        _arc(np.sqrt(bx * bx + by * by + bz * bz), 1.0, far, aside)
        best, chosen, backed = -1e30, 0, 0.0
        cx, cy, cz, trust = course_at(table, course, x, y, z)
        if abs(cx * dx + cy * dy + cz * dz) < OTHER_HAIR:
            trust = 0.0
        off, drawn = OFF_COURSE * trust, DRAWN[0] + (DRAWN[1] - DRAWN[0]) * min(trust / SURE, 1.0)
        for n in range(len(fan)):
            a, b = fan[n, 0], fan[n, 1]
            ex, ey, ez = dx + a * ux + b * vx, dy + a * uy + b * vy, dz + a * uz + b * vz
            square = 1.0 + a * a + b * b
            norm = 1.0 / np.sqrt(square)
            ex, ey, ez = ex * norm, ey * norm, ez * norm
            cost = TURN_COST * (square - 1.0) + off * (1.0 - (ex * cx + ey * cy + ez * cz) ** 2)
            # from afar, where directions part: most are soon known not to come near the best, whatever lies between
            total, left, wanted = 0.0, MOST * whole, (best - ASIDE * SHARPNESS + cost) * whole
            for k in range(len(weights) - 1, -1, -1):
                px, py, pz = x + far[k] * ex + aside[k] * bx, y + far[k] * ey + aside[k] * by, z + far[k] * ez + aside[k] * bz
                total += weights[k] * min(density_at(table, bricks, px, py, pz) * strands, MOST)
                left -= weights[k] * MOST
                if total + left < wanted:
                    break
            scores[n] = (total + left) / whole - cost
            if scores[n] > best:
                best, chosen, backed = scores[n], n, total / whole
        if backed < SUPPORT:
            # The look-ahead sees the end before it is there: the last stretch, along the same arc.
            px, py, pz = x, y, z
            _arc(np.sqrt(bx * bx + by * by + bz * bz), step, far, aside)
            for k in range(len(weights) // 2):
                x, y, z = px + far[k] * dx + aside[k] * bx, py + far[k] * dy + aside[k] * by, pz + far[k] * dz + aside[k] * bz
                u, v, w = px + far[k + 1] * dx, py + far[k + 1] * dy, pz + far[k + 1] * dz
                u, v, w = u + aside[k + 1] * bx, v + aside[k + 1] * by, w + aside[k + 1] * bz
                value = density_at(table, bricks, x, y, z) + density_at(table, bricks, u, v, w)
                if value < seen or count == len(path):
                    break
                path[count, 0], path[count, 1], path[count, 2] = x, y, z
                count += 1
            return count, End.FAINT
        a = b = weight = 0.0
        for n in range(len(fan)):
            if (
                scores[n] > best - ASIDE * SHARPNESS
                and (fan[n, 0] - fan[chosen, 0]) ** 2 + (fan[n, 1] - fan[chosen, 1]) ** 2 < 0.12
            ):
                w = np.exp((scores[n] - best) / SHARPNESS)
                a, b, weight = a + w * fan[n, 0], b + w * fan[n, 1], weight + w
        a, b = a / weight, b / weight
        ex, ey, ez = dx + a * ux + b * vx, dy + a * uy + b * vy, dz + a * uz + b * vz
        norm = 1.0 / np.sqrt(ex * ex + ey * ey + ez * ez)
        ex, ey, ez = ex * norm, ey * norm, ez * norm
        qx, qy, qz, _value = centred(table, bricks, x + step * ex, y + step * ey, z + step * ez, ex, ey, ez, 2, drawn * step)
        # Inertia: the new direction leans on the last few steps' secant, turned on by half of their bend.
        if count >= SECANT:
            sx, sy, sz = qx - path[count - SECANT, 0], qy - path[count - SECANT, 1], qz - path[count - SECANT, 2]
        else:
            sx, sy, sz = qx - start_x, qy - start_y, qz - start_z
        norm, since = 1.0 / max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-9), 0.5 * SECANT * step
        sx, sy, sz = sx * norm + since * bx, sy * norm + since * by, sz * norm + since * bz
        norm = INERTIA / max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-9)
        ex, ey, ez = (1.0 - INERTIA) * ex + norm * sx, (1.0 - INERTIA) * ey + norm * sy, (1.0 - INERTIA) * ez + norm * sz
        norm = 1.0 / np.sqrt(ex * ex + ey * ey + ez * ez)
        ex, ey, ez = ex * norm, ey * norm, ez * norm
        if ex * dx + ey * dy + ez * dz < turn:
            return count, End.TURN
        x, y, z, dx, dy, dz = qx, qy, qz, ex, ey, ez
        path[count, 0], path[count, 1], path[count, 2] = x, y, z
        count += 1
        if count > known + 30 and (x - start_x) ** 2 + (y - start_y) ** 2 + (z - start_z) ** 2 < 1.0:
            return count, End.LOOP


@numba.njit(cache=True, nogil=True)
def smoothed(path, widths, most):
    """The path under a local quadratic: at each point the widest of the windows (half-widths, rising) whose fit stays within
    `most` (root mean square, in the path's unit) of the points. Long windows for smooth hair, short ones for curls."""
    size = len(path)
    out = path.copy()
    m0, m1, m2, f0 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(size):
        s0 = s1 = s2 = s3 = s4 = square = 0.0
        m0[:], m1[:], m2[:] = 0.0, 0.0, 0.0
        low, high = n, n - 1
        for w in range(len(widths)):
            # Windows end with the path. Each holds the one before: only what is new is summed.
            first, last = max(n - widths[w], 0), min(n + widths[w], size - 1)
            if last - first < 4:
                continue
            for side in range(2):
                begin, end = (first, low) if side == 0 else (high + 1, last + 1)
                for m in range(begin, end):
                    t = float(m - n)
                    s0 += 1.0
                    s1 += t
                    s2 += t * t
                    s3 += t * t * t
                    s4 += t * t * t * t
                    for axis in range(3):
                        value = float(path[m, axis] - path[n, axis])
                        m0[axis] += value
                        m1[axis] += t * value
                        m2[axis] += t * t * value
                        square += value * value
            low, high = first, last
            # Cofactors of the first row of the normal matrix: the fit's value at n is a combination of the moments.
            c0, c1, c2 = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
            det = s0 * c0 + s1 * c1 + s2 * c2
            k11, k12, k22 = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1
            wrong = square
            for axis in range(3):
                f0[axis] = (c0 * m0[axis] + c1 * m1[axis] + c2 * m2[axis]) / det
                f1 = (c1 * m0[axis] + k11 * m1[axis] + k12 * m2[axis]) / det
                f2 = (c2 * m0[axis] + k12 * m1[axis] + k22 * m2[axis]) / det
                wrong -= f0[axis] * m0[axis] + f1 * m1[axis] + f2 * m2[axis]
            if w > 0 and wrong > most * most * s0:
                break
            for axis in range(3):
                out[n, axis] = path[n, axis] + f0[axis]
    return out


@numba.njit(cache=True, nogil=True)
def _widened(table, bricks, path, step, seen, blur):
    """Move a smoothed `path` (n, 3) in its bends out to where the ridge of the density runs, in place.

    Following lags and smoothing cuts corners: a path runs inside of its curl, by a fifth of a voxel at a radius of a dozen. How
    far is read from the density to the inner and to the outer side, summed along the path, since at one place alone it would
    be noise and neighbours.
    """
    size = len(path)
    if size <= 2 * BEND_SPAN:
        return
    inward = np.zeros((size, 3))
    inner, outer = np.zeros(size + 1), np.zeros(size + 1)  # summed from the first point on
    noise = LEAST_BEND * (BEND_SPAN * step) ** 2
    for m in range(size):
        at = min(max(m, BEND_SPAN), size - 1 - BEND_SPAN)
        before, behind = path[max(m - 2, 0)], path[min(m + 2, size - 1)]
        along = length = square = 0.0
        for axis in range(3):
            t = behind[axis] - before[axis]
            inward[m, axis] = path[at - BEND_SPAN, axis] - 2.0 * path[at, axis] + path[at + BEND_SPAN, axis]
            along, length = along + t * inward[m, axis], length + t * t
        for axis in range(3):
            inward[m, axis] -= along / max(length, 1e-12) * (behind[axis] - before[axis])
            square += inward[m, axis] ** 2
        bent = max(np.sqrt(square), 1e-12)
        x, y, z = float(path[m, 0]), float(path[m, 1]), float(path[m, 2])
        u, v, w = (BESIDE / bent) * inward[m, 0], (BESIDE / bent) * inward[m, 1], (BESIDE / bent) * inward[m, 2]
        inner[m + 1] = inner[m] + min(density_at(table, bricks, x + u, y + v, z + w) / seen, MOST)
        outer[m + 1] = outer[m] + min(density_at(table, bricks, x - u, y - v, z - w) / seen, MOST)
        for axis in range(3):
            inward[m, axis] *= max(1.0 - (noise / bent) ** 2, 0.0) / bent
    for m in range(size):
        low, high = max(m - EVEN, 0), min(m + EVEN + 1, size)
        a, b = inner[high] - inner[low], outer[high] - outer[low]
        # of a Gaussian that lies d to one side, values at -s and s differ by their sum times tanh(s d / variance)
        far = (blur * blur + 1.0 / 6.0) / BESIDE * (b - a) / max(a + b, 1e-6)
        far = min(max(far, 0.0), WIDEST)
        for axis in range(3):
            path[m, axis] -= far * inward[m, axis]


@numba.njit(cache=True, parallel=True)
def _alive(table, bricks, voxels, directions, seen):
    """(S,) bool: the seeds that still have a strand."""
    alive = np.zeros(len(voxels), np.bool_)
    for n in numba.prange(len(voxels)):
        dx, dy, dz = float(directions[n, 0]), float(directions[n, 1]), float(directions[n, 2])
        norm = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * norm, dy * norm, dz * norm
        x, y, z = float(voxels[n, 0]), float(voxels[n, 1]), float(voxels[n, 2])
        if line_mean(table, bricks, x, y, z, dx, dy, dz, 4) > FAINT * seen:
            x, y, z, _value = centred(table, bricks, x, y, z, dx, dy, dz, 2, 0.8)
            alive[n] = line_mean(table, bricks, x, y, z, dx, dy, dz, 4) > ALIVE * seen
    return alive


@numba.njit(cache=True, nogil=True)
def _turned(way, count, x, y, z, back):
    """Begin `back` with the first `count` points of a way from (x, y, z), the last first, and that point; how many they are."""
    for m in range(count):
        back[count - 1 - m] = way[m]
    back[count, 0], back[count, 1], back[count, 2] = x, y, z
    return count + 1


@numba.njit(cache=True, parallel=True)
def _trace(
    table, bricks, course, voxels, directions, step, turn, seen, blur, fan, weights, widths, most, paths, firsts, counts, ends
):
    """Follow each seed both ways; `paths[n, firsts[n]:firsts[n] + counts[n, 0] + counts[n, 1] + 1]` is its smoothed path."""
    for n in numba.prange(len(voxels)):
        dx, dy, dz = float(directions[n, 0]), float(directions[n, 1]), float(directions[n, 2])
        norm = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * norm, dy * norm, dz * norm
        x, y, z = float(voxels[n, 0]), float(voxels[n, 1]), float(voxels[n, 2])
        for _ in range(2):
            x, y, z, _value = centred(table, bricks, x, y, z, dx, dy, dz, 3, 0.7)
        middle = paths.shape[1] // 2
        # A look ahead tells the way back which way it bends, and that the way ahead: neither sets out straight in a curl.
        way, back_way = np.empty((middle + HISTORY, 3), np.float32), np.empty((middle + HISTORY, 3), np.float32)
        ahead, reason = _follow(
            table, bricks, course, x, y, z, dx, dy, dz, step, turn, seen, fan, weights, way[: HISTORY - 1], 0
        )
        # The way back sets out along the first steps' own direction, surer than the field's.
        if ahead >= 4:
            sx, sy, sz = way[3, 0] - x, way[3, 1] - y, way[3, 2] - z
            norm = 1.0 / max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-9)
            dx, dy, dz = sx * norm, sy * norm, sz * norm
        known = _turned(way, ahead, x, y, z, back_way)
        back, reason = _follow(
            table, bricks, course, x, y, z, -dx, -dy, -dz, step, turn, seen, fan, weights, back_way[: known + middle], known
        )
        back -= known
        back_way = back_way[known:]
        ends[n, 0] = reason
        if back >= 4:
            sx, sy, sz = x - back_way[3, 0], y - back_way[3, 1], z - back_way[3, 2]
            norm = 1.0 / max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-9)
            dx, dy, dz = sx * norm, sy * norm, sz * norm
        known = _turned(back_way, min(back, HISTORY - 1), x, y, z, way)
        ahead, reason = _follow(
            table, bricks, course, x, y, z, dx, dy, dz, step, turn, seen, fan, weights, way[: known + middle], known
        )
        ahead -= known
        way = way[known:]
        ends[n, 1] = reason
        paths[n, middle, 0], paths[n, middle, 1], paths[n, middle, 2] = x, y, z
        for m in range(back):
            paths[n, middle - 1 - m] = back_way[m]
        for m in range(ahead):
            paths[n, middle + 1 + m] = way[m]
        firsts[n] = middle - back
        counts[n, 0], counts[n, 1] = back, ahead
        path = smoothed(paths[n, middle - back : middle + ahead + 1], widths, most)
        for _ in range(WIDENINGS):
            _widened(table, bricks, path, step, seen, blur)
        paths[n, middle - back : middle + ahead + 1] = path


@numba.njit(cache=True, nogil=True)
def _settle(table, bricks, paths, firsts, counts, ends, seen, peak, blur, shortest, first, last):
    """In order: cut each path to what the residual still backs around its seed and subtract it. firsts, counts and ends are
    updated; a path that is not kept has both counts at -1."""
    window = 4
    for n in range(first, last):
        middle = firsts[n] + counts[n, 0]
        if counts[n, 0] + counts[n, 1] + 1 < shortest:
            counts[n, 0] = counts[n, 1] = -1
            continue
        low, high = firsts[n], middle + counts[n, 1]
        size = high - low + 1
        values = np.empty(size)
        for m in range(size):
            p = paths[n, low + m]
            values[m] = min(density_at(table, bricks, float(p[0]), float(p[1]), float(p[2])) / seen, MOST)
        backed = np.empty(size)
        for m in range(size):
            total, many = 0.0, 0
            for w in range(max(m - window, 0), min(m + window, size - 1) + 1):
                total += values[w]
                many += 1
            backed[m] = total / many
        at = middle - low
        begin, end = at, at
        if backed[at] >= SUPPORT:
            while begin > 0 and backed[begin - 1] >= SUPPORT:
                begin -= 1
            while end < size - 1 and backed[end + 1] >= SUPPORT:
                end += 1
        if end - begin + 1 < shortest:
            counts[n, 0] = counts[n, 1] = -1
            continue
        if begin > 0:
            ends[n, 0] = End.TAKEN
        if end < size - 1:
            ends[n, 1] = End.TAKEN
        firsts[n] = low + begin
        counts[n, 0], counts[n, 1] = at - begin, end - at
        amplitudes = np.empty(end - begin + 1)
        for m in range(begin, end + 1):
            amplitudes[m - begin] = -peak * min(max(backed[m], 0.5), 1.0)
        add_strand(table, bricks, paths[n, low + begin : low + end + 1], amplitudes, blur)


@dataclass(frozen=True)
class Segments:
    """Pieces of strands as found, in voxels: points (M, 3) float32, offsets (N + 1,), without a direction yet."""

    points: np.ndarray
    offsets: np.ndarray
    tally: dict[str, int]


def trace_segments(
    residual: BrickVolume,
    course: BrickVolume,
    voxels: np.ndarray,
    directions: np.ndarray,
    order: np.ndarray,
    profile: StrandProfile,
    settings: GuideSettings,
    progress: Progress = silent,
) -> Segments:
    """Trace and subtract from the seeds in their order until none is left. `residual.bricks` is used up: pass a copy.

    course: which way hair goes, in the same bricks (`HairField.course`). voxels, directions: (S, 3) seeds; order: indices into
    them. The result is the same on any number of threads.
    """
    shortest = max(int(settings.min_length / (settings.step * residual.spacing)), 6)
    turn = np.cos(np.radians(settings.max_turn))
    widths = np.array([4, 7, 11, 16, 24], np.int64)
    pieces, sizes, reasons = [np.zeros((0, 3), np.float32)], [np.zeros(0, np.int64)], np.zeros(len(End), np.int64)
    tally = {"seeds": len(order), "seeds already taken": 0, "paths too short or already taken": 0}
    paths = np.empty((BATCH, 2 * MOST_STEPS + 1, 3), np.float32)
    at, share = 0, 1.0
    progress(0, len(order))
    while at < len(order):
        parts, wanted = [], BATCH
        while wanted and at < len(order):
            window = order[at : at + int(BATCH * min(1.5 / max(share, 1e-3), WINDOW))]
            alive = np.flatnonzero(_alive(residual.table, residual.bricks, voxels[window], directions[window], profile.seen))
            share = len(alive) / len(window)
            used = int(alive[wanted]) if len(alive) > wanted else len(window)
            parts.append(window[alive[:wanted]])
            tally["seeds already taken"] += used - len(parts[-1])
            wanted -= len(parts[-1])
            at += used
            progress(at, len(order))
        chosen = np.concatenate(parts)
        firsts = np.zeros(len(chosen), np.int64)
        counts = np.zeros((len(chosen), 2), np.int64)
        ends = np.zeros((len(chosen), 2), np.int64)
        _trace(
            residual.table, residual.bricks, course.bricks, voxels[chosen], directions[chosen], settings.step, turn,
            profile.seen, profile.blur, FAN, WEIGHTS, widths, settings.smoothing, paths, firsts, counts, ends,
        )  # fmt: skip
        _settle(
            residual.table, residual.bricks, paths, firsts, counts, ends, profile.seen, profile.peak, profile.blur, shortest, 0,
            len(chosen),
        )  # fmt: skip
        kept = np.flatnonzero(counts[:, 0] >= 0)
        size = counts[kept].sum(axis=1) + 1
        place = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size - firsts[kept], size)
        pieces.append(paths[np.repeat(kept, size), place])
        sizes.append(size)
        reasons += np.bincount(ends[kept].ravel(), minlength=len(End))
        tally["paths too short or already taken"] += len(chosen) - len(kept)
    offsets = offsets_from_counts(np.concatenate(sizes))
    tally |= {END_NAMES[End(reason)]: int(count) for reason, count in enumerate(reasons)} | {"segments": len(offsets) - 1}
    return Segments(np.concatenate(pieces), offsets, tally)
