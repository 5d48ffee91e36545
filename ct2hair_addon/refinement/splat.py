"""Strands rendered into bricks through the scanner's blur, and what a misfit there asks of them (supplement 3; 3.3.2).

Control points of a strand are joined by Catmull-Rom cubics. A segment leaves its length in the eight voxels around each
of its samples (two a voxel), and a separable Gaussian spreads it. Every brick collects the segments that reach it, in
strand order, so that the result is the same bits on any number of threads; no two threads write to one voxel.
Points are in voxels of the volume at hand throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..progress import Progress, silent
from ..volume import BRICK, BrickVolume

SAMPLES_PER_VOXEL = 2.0
REACH = 3
"""Voxels that the Gaussian is cut at: 3.5 standard deviations of the usual 0.85."""
SPLAT_VARIANCE = 1.0 / 6.0
"""Variance, voxels^2, of the trilinear splat: it counts as part of the blur."""
CHUNK = 256
"""Bricks a kernel call: short enough to be cancelled at once."""


def gaussian_taps(blur: float, reach: int = REACH) -> np.ndarray:
    """(2 reach + 1,) float32: normalised Gaussian weights; a blur near 0 leaves the middle one."""
    offsets = np.arange(-reach, reach + 1)
    taps = np.exp(-0.5 * (offsets / max(blur, 1e-3)) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def splat_taps(blur: float) -> np.ndarray:
    """The taps that, after the trilinear splat, make a blur of standard deviation `blur` voxels."""
    return gaussian_taps(np.sqrt(max(blur**2 - SPLAT_VARIANCE, 0.0)))


@dataclass(frozen=True)
class Segments:
    """Which segments reach which brick: those of brick b are `segment[start[b]:start[b + 1]]`, as first control points."""

    start: np.ndarray
    segment: np.ndarray


def bin_segments(points: np.ndarray, offsets: np.ndarray, visible: np.ndarray, table: np.ndarray, rows: int) -> Segments:
    """The segments that reach each brick, halo included. points (M, 3) voxels; visible (M,): segments at 0 are left out."""
    counts = np.zeros(len(points), np.int64)
    _count_pairs(points, offsets, visible, table, counts)
    begin = np.concatenate([[0], np.cumsum(counts)])
    brick = np.empty(begin[-1], np.int32)
    _list_pairs(points, offsets, visible, table, begin, brick)
    start = np.zeros(rows + 1, np.int64)
    segment = np.empty(begin[-1], np.int64)
    _sort_pairs(begin, brick, start, segment)
    return Segments(start, segment)


def render(
    points: np.ndarray,
    offsets: np.ndarray,
    visible: np.ndarray,
    volume: BrickVolume,
    blur: float,
    progress: Progress = silent,
) -> np.ndarray:
    """(B, 16, 16, 16) float32: length of strand per voxel, in voxels, blurred, over the bricks of `volume`.

    points (M, 3) voxels of `volume`, offsets (N + 1,), visible (M,) 0..1: how much of the strand shows there.
    A lone straight strand peaks at `1 / (2 pi blur^2)`.
    """
    out = np.empty(volume.bricks.shape, np.float32)
    _fit_bricks(points, offsets, visible, volume, blur, 1.0, 0.0, out, progress)
    return out


def misfit(
    points: np.ndarray,
    offsets: np.ndarray,
    visible: np.ndarray,
    target: BrickVolume,
    blur: float,
    gain: float,
    out: np.ndarray,
    progress: Progress = silent,
) -> float:
    """Fill `out` (B, 16, 16, 16) with the weighted misfit `w (gain * rendered - target)`; return half its weighted square sum.

    `gain`: density of one voxel of strand length in a voxel. `w = 1 / (1 + gain * rendered / peak)`, peak being a lone
    strand's: noise and model error grow with the hair in a voxel, and one hair more weighs less in a thick bundle.
    """
    peak = gain / (2.0 * np.pi * blur**2)
    return _fit_bricks(points, offsets, visible, target, blur, gain, peak, out, progress)


def _fit_bricks(points, offsets, visible, volume, blur, gain, peak, out, progress) -> float:
    segments = bin_segments(points, offsets, visible, volume.table, len(volume.bricks))
    index, taps = volume.brick_index, splat_taps(blur)
    errors = np.zeros(len(out))
    for start in range(0, len(out), CHUNK):
        progress(start, len(out))
        stop = min(start + CHUNK, len(out))
        _splat_bricks(
            points, offsets, visible, segments.start, segments.segment, index, volume.bricks, np.float32(gain),
            np.float32(peak), taps, start, stop, out, errors,
        )  # fmt: skip
    return float(errors.sum())


def blurred(volume: BrickVolume, blur: float, out: np.ndarray | None = None, progress: Progress = silent) -> np.ndarray:
    """(B, 16, 16, 16) float32: the bricks under a Gaussian of `blur` voxels, `background` taken outside them."""
    out = np.empty(volume.bricks.shape, np.float32) if out is None else out
    index, taps = volume.brick_index, gaussian_taps(blur)
    for start in range(0, len(out), CHUNK):
        progress(start, len(out))
        stop = min(start + CHUNK, len(out))
        _blur_bricks(volume.table, volume.bricks, np.float32(volume.background), index, taps, start, stop, out)
    return out


def halved(volume: BrickVolume) -> BrickVolume:
    """The volume at twice the voxel size: means of 2^3 voxels (an average of density keeps its mass)."""
    size = tuple(-(-n // 2) for n in volume.table.shape)
    kept = np.zeros(size, bool)
    index = volume.brick_index
    kept[tuple((index // 2).T)] = True
    table = np.full(size, -1, np.int32)
    table[kept] = np.arange(np.count_nonzero(kept), dtype=np.int32)
    bricks = np.full((np.count_nonzero(kept), BRICK, BRICK, BRICK), volume.background, np.float32)
    rows = table[tuple((index // 2).T)]
    _halve(volume.bricks, rows, (index % 2).astype(np.int64), bricks)
    return BrickVolume(table, bricks, 2.0 * volume.spacing, volume.origin + 0.5 * volume.spacing, volume.background)


@numba.njit(cache=True, inline="always")
def cubic(t, first, last):
    """Weights of the four control points around a segment at t in [0, 1]; at a strand's end the missing one is mirrored."""
    a = ((-0.5 * t + 1.0) * t - 0.5) * t
    b = (1.5 * t - 2.5) * t * t + 1.0
    c = ((-1.5 * t + 2.0) * t + 0.5) * t
    d = (0.5 * t - 0.5) * t * t
    if first:
        b, c, a = b + 2.0 * a, c - a, 0.0
    if last:
        c, b, d = c + 2.0 * d, b - d, 0.0
    return a, b, c, d


@numba.njit(cache=True, inline="always")
def segment_samples(points, m):
    """How many samples the segment from control point m to m + 1 gets."""
    dx = points[m + 1, 0] - points[m, 0]
    dy = points[m + 1, 1] - points[m, 1]
    dz = points[m + 1, 2] - points[m, 2]
    return max(1, int(np.ceil(SAMPLES_PER_VOXEL * np.sqrt(dx * dx + dy * dy + dz * dz))))


@numba.njit(cache=True, inline="always")
def _brick_range(points, m, start, end, axis, size):
    """The bricks along one axis that the cubic from m to m + 1, blurred, can reach (by the hull of its Bezier points)."""
    p, q = points[m, axis], points[m + 1, axis]
    before = points[m - 1, axis] if m > start else 2.0 * p - q
    after = points[m + 2, axis] if m + 2 < end else 2.0 * q - p
    r, s = p + (q - before) / 6.0, q - (after - p) / 6.0
    low = min(min(p, q), min(r, s)) - REACH - 1.0
    high = max(max(p, q), max(r, s)) + REACH + 1.0
    return max(int(np.floor(low / BRICK)), 0), min(int(np.floor(high / BRICK)), size - 1)


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
def _sort_pairs(begin, brick, start, segment):
    """Counting sort of (brick, segment) pairs by brick, segments in order."""
    for pair in range(len(brick)):
        start[brick[pair] + 1] += 1
    for b in range(len(start) - 1):
        start[b + 1] += start[b]
    place = start.copy()
    for m in range(len(begin) - 1):
        for pair in range(begin[m], begin[m + 1]):
            b = brick[pair]
            segment[place[b]] = m
            place[b] += 1


@numba.njit(cache=True, parallel=True)
def _splat_bricks(points, offsets, visible, starts, segments, index, target, gain, peak, taps, low, high, out, errors):
    """Render bricks [low, high) into `out`; with peak > 0, turn that into the weighted misfit against `target`."""
    wide = BRICK + 2 * REACH
    for b in numba.prange(low, high):
        if starts[b] == starts[b + 1]:
            # Nothing reaches the brick: what the scan has there is unexplained.
            error = 0.0
            for x in range(BRICK):
                for y in range(BRICK):
                    for z in range(BRICK):
                        out[b, x, y, z] = -target[b, x, y, z] if peak > 0.0 else np.float32(0.0)
                        error += 0.5 * target[b, x, y, z] * target[b, x, y, z]
            errors[b] = error
            continue
        block = np.zeros((wide, wide, wide), np.float32)
        ox, oy, oz = BRICK * index[b, 0] - REACH, BRICK * index[b, 1] - REACH, BRICK * index[b, 2] - REACH
        for at in range(starts[b], starts[b + 1]):
            m = segments[at]
            n = np.searchsorted(offsets, m, side="right") - 1
            first, last = m == offsets[n], m + 2 >= offsets[n + 1]
            p0 = m if first else m - 1
            p3 = m + 1 if last else m + 2
            count = segment_samples(points, m)
            px, py, pz = points[m, 0], points[m, 1], points[m, 2]
            for s in range(count):
                # The piece from s to s + 1 leaves its length at its middle.
                wa, wb, wc, wd = cubic((s + 1.0) / count, first, last)
                qx = wa * points[p0, 0] + wb * points[m, 0] + wc * points[m + 1, 0] + wd * points[p3, 0]
                qy = wa * points[p0, 1] + wb * points[m, 1] + wc * points[m + 1, 1] + wd * points[p3, 1]
                qz = wa * points[p0, 2] + wb * points[m, 2] + wc * points[m + 1, 2] + wd * points[p3, 2]
                x, y, z = 0.5 * (px + qx) - ox, 0.5 * (py + qy) - oy, 0.5 * (pz + qz) - oz
                length = np.sqrt((qx - px) ** 2 + (qy - py) ** 2 + (qz - pz) ** 2)
                px, py, pz = qx, qy, qz
                i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
                if i < -1 or j < -1 or k < -1 or i >= wide or j >= wide or k >= wide:
                    continue
                t = (s + 0.5) / count
                length *= (1.0 - t) * visible[m] + t * visible[m + 1]
                fx, fy, fz = x - i, y - j, z - k
                for a in range(2):
                    if i + a < 0 or i + a >= wide:
                        continue
                    wx = length * (fx if a else 1.0 - fx)
                    for c in range(2):
                        if j + c < 0 or j + c >= wide:
                            continue
                        wy = wx * (fy if c else 1.0 - fy)
                        if k >= 0:
                            block[i + a, j + c, k] += wy * (1.0 - fz)
                        if k + 1 < wide:
                            block[i + a, j + c, k + 1] += wy * fz
        _blur_block(block, taps, out[b])
        if peak > 0.0:
            error = 0.0
            for x in range(BRICK):
                for y in range(BRICK):
                    for z in range(BRICK):
                        model = gain * out[b, x, y, z]
                        weight = np.float32(1.0) / (np.float32(1.0) + model / peak)
                        difference = model - target[b, x, y, z]
                        out[b, x, y, z] = weight * difference
                        error += 0.5 * weight * difference * difference
            errors[b] = error
        elif gain != 1.0:
            for x in range(BRICK):
                for y in range(BRICK):
                    for z in range(BRICK):
                        out[b, x, y, z] *= gain


@numba.njit(cache=True)
def _blur_block(block, taps, out):
    """A separable convolution of (16 + 2 * 3)^3 into 16^3; the seven symmetric taps are written out so that it vectorises."""
    wide, size = block.shape[0], out.shape[0]
    a, b, c, d = taps[3], taps[2], taps[1], taps[0]
    across = np.empty((size, wide, wide), np.float32)
    for x in range(size):
        for y in range(wide):
            for z in range(wide):
                across[x, y, z] = (
                    a * block[x + 3, y, z]
                    + b * (block[x + 2, y, z] + block[x + 4, y, z])
                    + c * (block[x + 1, y, z] + block[x + 5, y, z])
                    + d * (block[x, y, z] + block[x + 6, y, z])
                )
    along = np.empty((size, wide), np.float32)
    for x in range(size):
        for y in range(size):
            for z in range(wide):
                along[y, z] = (
                    a * across[x, y + 3, z]
                    + b * (across[x, y + 2, z] + across[x, y + 4, z])
                    + c * (across[x, y + 1, z] + across[x, y + 5, z])
                    + d * (across[x, y, z] + across[x, y + 6, z])
                )
        for y in range(size):
            for z in range(size):
                out[x, y, z] = (
                    a * along[y, z + 3]
                    + b * (along[y, z + 2] + along[y, z + 4])
                    + c * (along[y, z + 1] + along[y, z + 5])
                    + d * (along[y, z] + along[y, z + 6])
                )


@numba.njit(cache=True)
def _halo(table, bricks, background, bi, bj, bk, block):
    """Fill `block` (16 + 2 r)^3 with brick (bi, bj, bk) and r voxels of its neighbours."""
    reach = (block.shape[0] - BRICK) // 2
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                i, j, k = bi + di, bj + dj, bk + dk
                x0, x1 = _span(di, reach)
                y0, y1 = _span(dj, reach)
                z0, z1 = _span(dk, reach)
                row = -1
                if 0 <= i < table.shape[0] and 0 <= j < table.shape[1] and 0 <= k < table.shape[2]:
                    row = table[i, j, k]
                for x in range(x0, x1):
                    for y in range(y0, y1):
                        for z in range(z0, z1):
                            if row >= 0:
                                value = bricks[row, x - reach - BRICK * di, y - reach - BRICK * dj, z - reach - BRICK * dk]
                                block[x, y, z] = value
                            else:
                                block[x, y, z] = background


@numba.njit(cache=True, inline="always")
def _span(d, reach):
    """The slice of a haloed block that neighbour d (-1, 0, 1) fills."""
    if d < 0:
        return 0, reach
    if d > 0:
        return reach + BRICK, BRICK + 2 * reach
    return reach, reach + BRICK


@numba.njit(cache=True, parallel=True)
def _blur_bricks(table, bricks, background, index, taps, low, high, out):
    reach = (len(taps) - 1) // 2
    wide = BRICK + 2 * reach
    for b in numba.prange(low, high):
        block = np.empty((wide, wide, wide), np.float32)
        _halo(table, bricks, background, index[b, 0], index[b, 1], index[b, 2], block)
        _blur_block(block, taps, out[b])


@numba.njit(cache=True, parallel=True)
def _halve(bricks, rows, corner, out):
    half = BRICK // 2
    for b in numba.prange(len(bricks)):
        for x in range(half):
            for y in range(half):
                for z in range(half):
                    total = np.float32(0.0)
                    for a in range(2):
                        for c in range(2):
                            for d in range(2):
                                total += bricks[b, 2 * x + a, 2 * y + c, 2 * z + d]
                    out[rows[b], half * corner[b, 0] + x, half * corner[b, 1] + y, half * corner[b, 2] + z] = total / 8
