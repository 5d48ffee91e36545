"""Strands rendered into bricks through the scanner's blur, and what a misfit there asks of them (supplement 3; 3.3.2).

Control points of a strand are joined by Catmull-Rom cubics. A segment leaves its length in the eight voxels around each
of its samples (two a voxel), and a separable Gaussian spreads it. Every brick collects the segments that reach it, in
strand order, so that the result is the same bits on any number of threads; no two threads write to one voxel. What strands
leave is held for three layers of bricks across x at a time, which is what the blur of one layer reads.
Points are in voxels of the volume at hand throughout.
"""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np

from ..progress import Progress, silent
from ..volume import BRICK, BrickVolume
from ..volume.grid import LEAST
from .binning import FIRST, LAST, RIM, Segments, bin_segments
from .blur import WIDE, blur_block, chunks, gaussian_taps, ring, with_rim
from .curves import segment_samples, spline, spline_at

SPLAT_VARIANCE = 1.0 / 6.0
"""Variance, voxels^2, of the trilinear splat: it counts as part of the blur."""


def splat_taps(blur: float) -> np.ndarray:
    """The taps that, after the trilinear splat, make a blur of standard deviation `blur` voxels."""
    return gaussian_taps(np.sqrt(max(blur**2 - SPLAT_VARIANCE, 0.0)))


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
    segments = bin_segments(points, offsets, visible, volume.table)
    to, errors = np.arange(len(out)), np.empty(len(out))
    for _ in _layers(points, visible, segments, volume, blur, 1.0, 0.0, out, to, errors, progress):
        pass
    return out


def misfit(
    points: np.ndarray,
    visible: np.ndarray,
    segments: Segments,
    target: BrickVolume,
    blur: float,
    gain: float,
    out: np.ndarray,
    to: np.ndarray,
    errors: np.ndarray,
    progress: Progress = silent,
) -> Iterator[int]:
    """Write the weighted misfit `w (gain * rendered - target)` of each brick, layer by layer across x; yields the number of
    each layer, counted from the rim, as it is there.

    points, visible: as for `render`; segments: theirs in `target`. gain: density of one voxel of strand length in a voxel.
    `w = 1 / (1 + gain * rendered / peak)`, peak being a lone strand's: noise and model error grow with the hair in a voxel,
    and one hair more weighs less in a thick bundle. Where the target is exactly 0 it was cleared: nothing is known there, and
    nothing asked. out (., 16, 16, 16) float32, to (B,): where in it each brick goes (`ring`
    keeps three layers). errors (B,): half the weighted square sum of each.
    """
    peak = gain / (2.0 * np.pi * blur**2)
    return _layers(points, visible, segments, target, blur, gain, peak, out, to, errors, progress)


def _layers(points, visible, segments, volume, blur, gain, peak, out, to, errors, progress) -> Iterator[int]:
    index, own = segments.index, volume.brick_index + np.int32(RIM)
    _, begin, place, room = ring(index, len(segments.table))
    mass = np.empty((room, BRICK, BRICK, BRICK), np.float32)
    reached = segments.start[1:] > segments.start[:-1]
    places = np.full_like(segments.table, -1)
    places[tuple(index[reached].T)] = place[reached]
    order, filled, _, _ = ring(own, len(places))
    taps = splat_taps(blur)
    for x in range(len(places)):
        for start, stop in chunks(begin[x], begin[x + 1]):
            progress(start, len(index))
            _splat_bricks(
                points, visible, segments.start, segments.segment, segments.ends, index, place, start, stop, mass
            )  # fmt: skip
        if x == 0:
            continue
        # both neighbours of the layer before are there by now
        for start, stop in chunks(filled[x - 1], filled[x]):
            progress(begin[x + 1], len(index))
            rows, lone = order[start:stop], np.float32(peak)
            _spread_bricks(places, mass, own, rows, volume.bricks, np.float32(gain), lone, taps, out, to, errors)
        yield x - 1


def halved(volume: BrickVolume) -> BrickVolume:
    """The volume at twice the voxel size: means of those of 2^3 voxels that were not cleared (an average of density keeps its
    mass); 0 where all were."""
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


@numba.njit(cache=True, parallel=True)
def _splat_bricks(points, visible, starts, segments, ends, index, place, low, high, mass):
    """What strands leave, by trilinear weights, in bricks [low, high), written where `place` says; empty ones are passed."""
    for b in numba.prange(low, high):
        if starts[b] == starts[b + 1]:
            continue
        block = mass[place[b]].reshape(BRICK**3)
        block[:] = 0.0
        ox, oy, oz = BRICK * (index[b, 0] - RIM), BRICK * (index[b, 1] - RIM), BRICK * (index[b, 2] - RIM)
        for at in range(starts[b], starts[b + 1]):
            m = segments[at]
            curve, count = spline(points, m, ends[m] & FIRST != 0, ends[m] & LAST != 0), segment_samples(points, m)
            share = 1.0 / count
            px, py, pz = points[m, 0], points[m, 1], points[m, 2]
            for s in range(count):
                # The piece from s to s + 1 leaves its length at its middle.
                t = (s + 1.0) * share
                qx, qy, qz = spline_at(curve, t)
                x, y, z = 0.5 * (px + qx) - ox, 0.5 * (py + qy) - oy, 0.5 * (pz + qz) - oz
                dx, dy, dz = qx - px, qy - py, qz - pz
                px, py, pz = qx, qy, qz
                i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
                if i < -1 or j < -1 or k < -1 or i >= BRICK or j >= BRICK or k >= BRICK:
                    continue
                t -= 0.5 * share
                length = np.sqrt(dx * dx + dy * dy + dz * dz) * ((1.0 - t) * visible[m] + t * visible[m + 1])
                fx, fy, fz = x - i, y - j, z - k
                u, v = length * (1.0 - fx), length * fx
                uu, uv, vu, vv = u * (1.0 - fy), u * fy, v * (1.0 - fy), v * fy
                if 0 <= i < BRICK - 1 and 0 <= j < BRICK - 1 and 0 <= k < BRICK - 1:
                    corner = (i * BRICK + j) * BRICK + k
                    block[corner] += uu * (1.0 - fz)
                    block[corner + 1] += uu * fz
                    block[corner + BRICK] += uv * (1.0 - fz)
                    block[corner + BRICK + 1] += uv * fz
                    corner += BRICK * BRICK
                    block[corner] += vu * (1.0 - fz)
                    block[corner + 1] += vu * fz
                    block[corner + BRICK] += vv * (1.0 - fz)
                    block[corner + BRICK + 1] += vv * fz
                    continue
                for a in range(2):
                    for c in range(2):
                        if not (0 <= i + a < BRICK and 0 <= j + c < BRICK):
                            continue
                        w = (vv if c else vu) if a else (uv if c else uu)
                        corner = ((i + a) * BRICK + j + c) * BRICK + k
                        if k >= 0:
                            block[corner] += w * (1.0 - fz)
                        if k + 1 < BRICK:
                            block[corner + 1] += w * fz


@numba.njit(cache=True, parallel=True)
def _spread_bricks(places, mass, index, rows, target, gain, peak, taps, out, to, errors):
    """Fill `out`, where `to` says, at `rows` with what strands left there and beside it (`mass`, where `places` (x, y, z)
    says), blurred; with peak > 0, with the weighted misfit of that against `target`, and `errors`."""
    for n in numba.prange(len(rows)):
        b = rows[n]
        i, j, k = index[b, 0], index[b, 1], index[b, 2]
        reached = False
        for a in range(i - 1, i + 2):
            for c in range(j - 1, j + 2):
                for d in range(k - 1, k + 2):
                    reached = reached or places[a, c, d] >= 0
        shown, scan = out[to[b]].reshape(BRICK**3), target[b].reshape(BRICK**3)
        if not reached:
            # What the scan has there is unexplained.
            for v in range(BRICK**3):
                shown[v] = -scan[v] if peak > 0.0 else np.float32(0.0)
            errors[b] = 0.5 * _dot(shown, shown)
            continue
        block = np.empty(WIDE**3, np.float32)
        with_rim(places, mass, np.float32(0.0), i, j, k, BRICK, block)
        blur_block(block, taps, BRICK, shown)
        if peak > 0.0:
            for v in range(BRICK**3):
                model = gain * shown[v]
                block[v] = model - np.float32(scan[v]) if scan[v] != 0 else np.float32(0.0)
                shown[v] = block[v] / (np.float32(1.0) + model / peak)
            errors[b] = 0.5 * _dot(shown, block)
        elif gain != 1.0:
            for v in range(BRICK**3):
                shown[v] *= gain


@numba.njit(cache=True, fastmath={"reassoc"})
def _dot(one, other):
    """The sum of a brick's products, in the order that is fastest."""
    total = np.float32(0.0)
    for v in range(BRICK**3):
        total += one[v] * other[v]
    return total


@numba.njit(cache=True, parallel=True)
def _halve(bricks, rows, corner, out):
    half = BRICK // 2
    for b in numba.prange(len(bricks)):
        for x in range(half):
            for y in range(half):
                for z in range(half):
                    total, known = np.float32(0.0), 0
                    for a in range(2):
                        for c in range(2):
                            for d in range(2):
                                value = bricks[b, 2 * x + a, 2 * y + c, 2 * z + d]
                                total += value
                                known += value != 0
                    mean = total / max(known, 1)
                    if mean == 0.0 and known > 0:
                        mean = LEAST  # air that evens out is no less known
                    out[rows[b], half * corner[b, 0] + x, half * corner[b, 1] + y, half * corner[b, 2] + z] = mean
