"""What the misfit of strands to a scan asks of each of their control points (3.3.2).

The misfit, blurred as the scanner blurs, is a potential whose slope draws strands. It is needed where they run alone, so it is
made brick by brick while the segments there read it, and kept nowhere; nor is more of the misfit than three layers of bricks.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numba
import numpy as np

from ..volume import BRICK
from .binning import FIRST, LAST, RIM, Segments
from .blur import REACH, blur_block, chunks, gaussian_taps, with_rim
from .curves import segment_samples, spline, spline_at

SIDE = BRICK + 1
"""Voxels along an edge of a brick with all that lies around a point in it."""


def gather_forces(
    points: np.ndarray,
    offsets: np.ndarray,
    visible: np.ndarray,
    segments: Segments,
    bricks: np.ndarray,
    places: np.ndarray,
    layers: Iterable[int],
    blur: float,
    forces: np.ndarray,
    weights: np.ndarray,
) -> None:
    """The force on every control point: minus the gradient of a potential across the strand, averaged over its samples.

    points (M, 3) voxels of a volume, segments: theirs in it. bricks: the volume's, which blurred by `blur` voxels are the
    potential, 0 outside them; places (x, y, z): where in `bricks` each is, counted from the rim, -1 for none. layers: numbers
    of the layers across x, in their order, each as it is there; one must stay until two more are. Writes forces (M, 3), and
    weights (M,): the share of visible length around the point, 0..1. The part along the strand is left out: it would only
    slide points. The same bits on any number of threads.
    """
    asked = np.empty((len(segments.pair), 8), np.float32)
    taps = gaussian_taps(blur)
    begin = np.searchsorted(segments.index[:, 0], np.arange(len(places) + 1))
    known = 0
    for layer in itertools.chain(layers, [len(places)]):
        # those of which the next one is there, too
        for start, stop in chunks(begin[known], begin[layer]):
            _gather_bricks(
                points, visible, segments.start, segments.segment, segments.pair, segments.ends, segments.index, places,
                bricks, taps, start, stop, asked,
            )  # fmt: skip
        known = layer
    _collect(offsets, segments.begin, asked, forces)
    shares_seen(points, offsets, visible, weights)


@numba.njit(cache=True, parallel=True)
def _gather_bricks(points, visible, starts, segments, pair, ends, index, places, bricks, taps, low, high, asked):
    """Fill `asked` (P, 8) for pairs in bricks [low, high): at the segment's first and second control point, the force and the
    visible length by which it is weighed."""
    for b in numba.prange(low, high):
        if starts[b] == starts[b + 1]:
            continue
        i, j, k = index[b, 0], index[b, 1], index[b, 2]
        block, values = np.empty((SIDE + 2 * REACH) ** 3, np.float32), np.empty(SIDE**3, np.float32)
        with_rim(places, bricks, np.float32(0.0), i, j, k, SIDE, block)
        blur_block(block, taps, SIDE, values)
        _clear_outside(places, i, j, k, values)
        x, y, z = BRICK * (i - RIM), BRICK * (j - RIM), BRICK * (k - RIM)
        for at in range(starts[b], starts[b + 1]):
            m = segments[at]
            asked[pair[at]] = _asked(points, m, ends[m], visible, x, y, z, values)


@numba.njit(cache=True)
def _clear_outside(places, i, j, k, values):
    """Set `values` (SIDE^3,) of brick (i, j, k) to 0 in bricks that are not stored."""
    for a in range(2):
        for b in range(2):
            for c in range(2):
                x, y, z = i + a, j + b, k + c
                if x < places.shape[0] and y < places.shape[1] and z < places.shape[2] and places[x, y, z] >= 0:
                    continue
                for p in range(BRICK if a else 0, SIDE if a else BRICK):
                    for q in range(BRICK if b else 0, SIDE if b else BRICK):
                        for r in range(BRICK if c else 0, SIDE if c else BRICK):
                            values[(p * SIDE + q) * SIDE + r] = 0.0


@numba.njit(cache=True, inline="always")
def _asked(points, m, ends, visible, ox, oy, oz, values):
    """A segment's part of `asked`: of its samples whose first voxel lies in the brick at (ox, oy, oz)."""
    curve, count = spline(points, m, ends & FIRST != 0, ends & LAST != 0), segment_samples(points, m)
    share = 1.0 / count
    px, py, pz = points[m, 0], points[m, 1], points[m, 2]
    fx, fy, fz, gx, gy, gz, here, there = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(count):
        t = (s + 1.0) * share
        qx, qy, qz = spline_at(curve, t)
        x, y, z = 0.5 * (px + qx) - ox, 0.5 * (py + qy) - oy, 0.5 * (pz + qz) - oz
        tx, ty, tz = qx - px, qy - py, qz - pz
        px, py, pz = qx, qy, qz
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        if i < 0 or j < 0 or k < 0 or i >= BRICK or j >= BRICK or k >= BRICK:
            continue
        square = tx * tx + ty * ty + tz * tz
        t -= 0.5 * share
        shown = np.sqrt(square) * ((1.0 - t) * visible[m] + t * visible[m + 1])
        if shown <= 0.0:
            continue
        u, v, w = _gradient(values, (i * SIDE + j) * SIDE + k, x - i, y - j, z - k)
        along = (u * tx + v * ty + w * tz) / square
        u, v, w = u - along * tx, v - along * ty, w - along * tz
        near, far = shown * (1.0 - t), shown * t
        fx, fy, fz, here = fx - near * u, fy - near * v, fz - near * w, here + near
        gx, gy, gz, there = gx - far * u, gy - far * v, gz - far * w, there + far
    return fx, fy, fz, here, gx, gy, gz, there


@numba.njit(cache=True, inline="always")
def _gradient(values, at, fx, fy, fz):
    """The gradient of the trilinear interpolant of SIDE^3 values in the cell that begins at `at`, per voxel."""
    v000, v001 = values[at], values[at + 1]
    v010, v011 = values[at + SIDE], values[at + SIDE + 1]
    at += SIDE * SIDE
    v100, v101 = values[at], values[at + 1]
    v110, v111 = values[at + SIDE], values[at + SIDE + 1]
    ex, ey, ez = 1.0 - fx, 1.0 - fy, 1.0 - fz
    gx = ey * (ez * (v100 - v000) + fz * (v101 - v001)) + fy * (ez * (v110 - v010) + fz * (v111 - v011))
    gy = ex * (ez * (v010 - v000) + fz * (v011 - v001)) + fx * (ez * (v110 - v100) + fz * (v111 - v101))
    gz = ex * (ey * (v001 - v000) + fy * (v011 - v010)) + fx * (ey * (v101 - v100) + fy * (v111 - v110))
    return gx, gy, gz


@numba.njit(cache=True, parallel=True)
def _collect(offsets, begin, asked, forces):
    """Forces on control points from those on their segments in bricks."""
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        felt = np.zeros(end - start)
        for m in range(start, end):
            forces[m, 0] = forces[m, 1] = forces[m, 2] = 0.0
        for m in range(start, end - 1):
            for p in range(begin[m], begin[m + 1]):
                for side in range(2):
                    for axis in range(3):
                        forces[m + side, axis] += asked[p, 4 * side + axis]
                    felt[m - start + side] += asked[p, 4 * side + 3]
        for m in range(start, end):
            for axis in range(3):
                forces[m, axis] /= max(felt[m - start], 1e-9)


@numba.njit(cache=True, parallel=True)
def shares_seen(points, offsets, visible, weights):
    """Fill `weights` (M,) with the share of the length around each control point that is visible: `visible` (M,) there, linear
    between two of them."""
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        whole, shown = np.zeros(end - start), np.zeros(end - start)
        for m in range(start, end - 1):
            square = 0.0
            for axis in range(3):
                square += (points[m + 1, axis] - points[m, axis]) ** 2
            length = np.sqrt(square)
            for side in range(2):
                whole[m - start + side] += 0.5 * length
                shown[m - start + side] += length * (visible[m + side] / 3.0 + visible[m + 1 - side] / 6.0)
        for m in range(start, end):
            weights[m] = shown[m - start] / max(whole[m - start], 1e-9)
