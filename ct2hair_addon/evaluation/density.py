"""Strands made into a volume of blurred point counts, by sparse bricks (supplement, section 3).

Counts are whole numbers and the blur of a voxel is summed in one order, so that slabs and threads change no bit of it.
"""

from __future__ import annotations

import numba
import numpy as np

from ..progress import Progress, silent
from ..strands import Strands
from ..volume import BRICK, BrickVolume
from .curves import SUBDIVISIONS, curve_arcs, first_sample, on_curve, parameter_at, segment_curve, segment_lengths

BLUR = 0.85
"""Width of the blur (sigma, voxels) of a synthetic scan; the protocol asks for 0.8 to 0.9."""

POINTS_PER_VOXEL = 2.0
"""Points are counted every half voxel along a strand."""

TRUNCATE = 4.0
"""The blur ends at this many sigmas, as in `scipy.ndimage.gaussian_filter`."""

_CHUNKS = 16
"""Parts that strands are dealt into for counting; any number gives the same counts."""

_TABLE_LIMIT = 1 << 19
"""Bricks of the table that are counted at once, which bounds the counters' memory to 64 MB."""

_BATCH = 4096
"""Bricks blurred between two reports of progress: about half a second on two cores."""


def strand_peak(sigma: float) -> float:
    """The peak of one straight strand in a volume of blurred counts: two points a voxel under a Gaussian of `sigma` voxels."""
    return POINTS_PER_VOXEL / (2.0 * np.pi * sigma * sigma)


def frame_around(points: np.ndarray, spacing: float, margin: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """(origin (3,) mm, shape in voxels) of the box around points (M, 3) with `margin` mm on every side.

    The origin is a whole number of voxels, so that boxes of one spacing share one lattice.
    """
    if not len(points):
        raise ValueError("there are no points to lay a volume around")
    low = np.floor((points.min(axis=0).astype(np.float64) - margin) / spacing)
    high = np.ceil((points.max(axis=0).astype(np.float64) + margin) / spacing)
    return low * spacing, tuple(int(n) for n in high - low + 1)


def render_density(
    strands: Strands,
    spacing: float,
    sigma: float = BLUR,
    origin: np.ndarray | None = None,
    shape: tuple[int, int, int] | None = None,
    progress: Progress = silent,
) -> BrickVolume:
    """The volume of blurred point counts of strands: the paper's way from strands to a scan (supplement, section 3).

    strands: mm. spacing: voxel size, mm. sigma: width of the Gaussian blur, voxels (0: bare counts). origin, shape: the box
    in the scan frame (mm, voxels); by default the box around the strands with room for the blur. Points outside are left out.
    Returns float32 bricks; one straight strand peaks near `strand_peak(sigma)`.
    """
    if not spacing > 0.0:
        raise ValueError(f"the voxel size must be over 0 mm, got {spacing}")
    if origin is None or shape is None:
        own_origin, own_shape = frame_around(strands.points, spacing, spacing * (2 + int(TRUNCATE * sigma + 0.5)))
        origin, shape = (own_origin if origin is None else origin), (own_shape if shape is None else shape)
    origin = np.asarray(origin, np.float64)
    layers = -(-shape[2] // BRICK)
    per_layer = -(-shape[0] // BRICK) * -(-shape[1] // BRICK)
    thickness = max(1, min(layers, _TABLE_LIMIT // max(per_layer, 1)))
    arcs = curve_arcs(strands)
    table = np.full((-(-shape[0] // BRICK), -(-shape[1] // BRICK), layers), -1, np.int32)
    bricks, stored = [], 0
    for first in range(0, layers, thickness):
        progress(first, layers)
        last = min(first + thickness, layers)
        part = render_layers(strands, arcs, spacing, sigma, origin, shape, first, last)
        table[:, :, first:last] = np.where(part.table >= 0, part.table + stored, -1)
        bricks.append(part.bricks)
        stored += len(part.bricks)
    progress(layers, layers)
    return BrickVolume(table, bricks[0] if len(bricks) == 1 else np.concatenate(bricks), spacing, origin)


def render_layers(
    strands: Strands,
    arcs: np.ndarray,
    spacing: float,
    sigma: float,
    origin: np.ndarray,
    shape: tuple[int, int, int],
    first: int,
    last: int,
    progress: Progress = silent,
) -> BrickVolume:
    """The brick layers [first, last) along z of what `render_density` gives for the whole box, bit for bit.

    arcs: `curve_arcs(strands)`, made once for all layers.
    """
    reach = -(-int(TRUNCATE * sigma + 0.5) // BRICK)  # brick layers that the blur looks beyond
    layers = -(-shape[2] // BRICK)
    low, high = max(first - reach, 0), min(last + reach, layers)
    box = np.array([shape[0], shape[1], min(high * BRICK, shape[2]) - low * BRICK], np.int64)
    lowest = np.asarray(origin, np.float64) + [0.0, 0.0, low * BRICK * spacing]
    counts = _count(strands, arcs, spacing, lowest, box)
    blurred = _blur(counts, sigma, box, low - first, last - first, progress)
    return BrickVolume(blurred[0], blurred[1], spacing, lowest + [0.0, 0.0, (first - low) * BRICK * spacing])


def gaussian_weights(sigma: float) -> np.ndarray:
    """(2 r + 1,) float64: the normalised kernel of the blur, r = `int(TRUNCATE * sigma + 0.5)` as SciPy cuts it."""
    reach = int(TRUNCATE * sigma + 0.5)
    if reach == 0:
        return np.ones(1)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return weights / weights.sum()


def _count(strands: Strands, arcs: np.ndarray, spacing: float, origin: np.ndarray, box: np.ndarray) -> BrickVolume:
    """Points of the strands (every half voxel) per voxel of the box, uint16 bricks."""
    size = -(-box // BRICK)
    # strands are dealt out in runs of about equal numbers of points, which a prefix sum over arc lengths finds
    ends = np.maximum(strands.offsets[1:] - 1, 0)
    work = np.cumsum(np.where(strands.counts > 0, arcs[ends] if len(arcs) else 0.0, 0.0) + spacing)
    bounds = np.searchsorted(work, np.linspace(0.0, work[-1] if len(work) else 0.0, _CHUNKS + 1)[1:-1])
    bounds = np.concatenate([[0], bounds, [len(strands)]]).astype(np.int64)
    step = spacing / POINTS_PER_VOXEL
    tally = np.zeros((_CHUNKS, *size), np.int32)
    nowhere = np.zeros((_CHUNKS, 1, 1, 1), np.int64)
    _walk(
        strands.points, strands.offsets, arcs, bounds, step, origin, spacing, box, tally, nowhere, np.empty(0, np.uint16), False
    )
    total = tally.sum(axis=0, dtype=np.int64)
    used = total > 0
    table = np.full(tuple(size), -1, np.int32)
    table[used] = np.arange(np.count_nonzero(used), dtype=np.int32)
    starts = np.concatenate([[0], np.cumsum(total[used])]).astype(np.int64)
    # where each chunk writes in each brick's run
    cursor = np.zeros((_CHUNKS, *size), np.int64)
    before = np.cumsum(tally, axis=0, dtype=np.int64) - tally
    cursor[:, used] = starts[:-1][None] + before[:, used]
    codes = np.empty(starts[-1], np.uint16)
    _walk(strands.points, strands.offsets, arcs, bounds, step, origin, spacing, box, tally, cursor, codes, True)
    bricks = np.zeros((len(starts) - 1, BRICK, BRICK, BRICK), np.uint16)
    _fill(codes, starts, bricks)
    return BrickVolume(table, bricks, spacing, origin)


def _blur(counts: BrickVolume, sigma: float, box: np.ndarray, first: int, last: int, progress: Progress):
    """(table, float32 bricks) of the Gaussian blur in brick layers [first, last) counted from the first layer of `counts`.

    Layers may be asked for only where `counts` has them; `first` is minus the halo's layers below.
    """
    weights = gaussian_weights(sigma).astype(np.float32)
    reach = len(weights) // 2
    skip = -first
    used = counts.table >= 0
    near = used.copy()
    if reach:
        grown = np.zeros(tuple(n + 2 for n in used.shape), bool)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    grown[i : i + used.shape[0], j : j + used.shape[1], k : k + used.shape[2]] |= used
        near = grown[1:-1, 1:-1, 1:-1]
    near = near[:, :, skip : skip + last]
    where = np.argwhere(near).astype(np.int32)
    where[:, 2] += skip
    where = where[_within_reach(counts.table, counts.bricks, reach, where)]
    bricks = np.empty((len(where), BRICK, BRICK, BRICK), np.float32)
    for start in range(0, len(where), _BATCH):
        progress(start, len(where))
        end = min(start + _BATCH, len(where))
        _blur_bricks(counts.table, counts.bricks, weights, box, where[start:end], bricks[start:end])
    table = np.full(near.shape, -1, np.int32)
    table[where[:, 0], where[:, 1], where[:, 2] - skip] = np.arange(len(where), dtype=np.int32)
    return table, bricks


@numba.njit(cache=True, parallel=True)
def _walk(points, offsets, arcs, bounds, step, origin, spacing, box, tally, cursor, codes, write):
    """Visit every sample of every strand: count it in its brick (`tally`), or write its voxel's code at the `cursor`."""
    for c in numba.prange(len(bounds) - 1):
        curve = np.empty((4, 3))
        lengths = np.empty(SUBDIVISIONS + 1)
        index = np.empty(3, np.int64)
        for n in range(bounds[c], bounds[c + 1]):
            first, last = offsets[n], offsets[n + 1] - 1
            for m in range(first, last):
                low, high = first_sample(arcs[m], step, 0.5), first_sample(arcs[m + 1], step, 0.5)
                if high <= low:
                    continue
                # the curve leaves its chord by no more than its arc is long: reject what can't reach the box
                span = arcs[m + 1] - arcs[m]
                away = False
                for axis in range(3):
                    a, b = points[m, axis] - origin[axis], points[m + 1, axis] - origin[axis]
                    if max(a, b) + span < -spacing or min(a, b) - span > spacing * (box[axis] + 1):
                        away = True
                if away:
                    continue
                segment_curve(points, first, last, m, curve)
                segment_lengths(curve, lengths)
                for s in range(low, high):
                    t = parameter_at(lengths, (s + 0.5) * step - arcs[m])
                    inside = True
                    for axis in range(3):
                        index[axis] = int(np.floor((on_curve(curve, t, axis) - origin[axis]) / spacing + 0.5))
                        if index[axis] < 0 or index[axis] >= box[axis]:
                            inside = False
                    if inside:
                        I, J, K = index[0] >> 4, index[1] >> 4, index[2] >> 4
                        if write:
                            codes[cursor[c, I, J, K]] = ((index[0] & 15) << 8) | ((index[1] & 15) << 4) | (index[2] & 15)
                            cursor[c, I, J, K] += 1
                        else:
                            tally[c, I, J, K] += 1


@numba.njit(cache=True, parallel=True)
def _fill(codes, starts, bricks):
    for row in numba.prange(len(starts) - 1):
        for n in range(starts[row], starts[row + 1]):
            code = codes[n]
            i, j, k = code >> 8, (code >> 4) & 15, code & 15
            if bricks[row, i, j, k] < 65535:
                bricks[row, i, j, k] += 1


@numba.njit(cache=True)
def _gather_counts(table, counts, low_x, low_y, low_z, halo):
    """Add the counts from voxel `low` on to the cube `halo` of zeros; False where there are none."""
    size = halo.shape[0]
    some = False
    for I in range(max(low_x, 0) >> 4, min((low_x + size - 1) >> 4, table.shape[0] - 1) + 1):
        for J in range(max(low_y, 0) >> 4, min((low_y + size - 1) >> 4, table.shape[1] - 1) + 1):
            for K in range(max(low_z, 0) >> 4, min((low_z + size - 1) >> 4, table.shape[2] - 1) + 1):
                row = table[I, J, K]
                if row < 0:
                    continue
                for i in range(max(I * BRICK, low_x), min((I + 1) * BRICK, low_x + size)):
                    for j in range(max(J * BRICK, low_y), min((J + 1) * BRICK, low_y + size)):
                        for k in range(max(K * BRICK, low_z), min((K + 1) * BRICK, low_z + size)):
                            value = counts[row, i & 15, j & 15, k & 15]
                            if value:
                                halo[i - low_x, j - low_y, k - low_z] = value
                                some = True
    return some


@numba.njit(cache=True, parallel=True)
def _within_reach(table, counts, reach, where):
    """(B,) bool: whether any count lies within the blur's reach of the bricks at `where`."""
    size = BRICK + 2 * reach
    some = np.zeros(len(where), np.bool_)
    for b in numba.prange(len(where)):
        halo = np.zeros((size, size, size), np.float32)
        low = where[b] * BRICK - reach
        some[b] = _gather_counts(table, counts, low[0], low[1], low[2], halo)
    return some


@numba.njit(cache=True, parallel=True)
def _blur_bricks(table, counts, weights, box, where, out):
    """The separable blur of the bricks at `where`; voxels beyond the box are zero, as is everything not counted."""
    reach = len(weights) // 2
    size = BRICK + 2 * reach
    for b in numba.prange(len(where)):
        halo = np.zeros((size, size, size), np.float32)
        low = where[b] * BRICK - reach
        _gather_counts(table, counts, low[0], low[1], low[2], halo)
        along_x = np.zeros((BRICK, size, size), np.float32)
        for i in range(BRICK):
            for w in range(2 * reach + 1):
                for j in range(size):
                    for k in range(size):
                        along_x[i, j, k] += weights[w] * halo[i + w, j, k]
        along_y = np.zeros((BRICK, BRICK, size), np.float32)
        for i in range(BRICK):
            for j in range(BRICK):
                for w in range(2 * reach + 1):
                    for k in range(size):
                        along_y[i, j, k] += weights[w] * along_x[i, j + w, k]
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    out[b, i, j, k] = 0.0
                if where[b, 0] * BRICK + i < box[0] and where[b, 1] * BRICK + j < box[1]:
                    end = min(BRICK, box[2] - where[b, 2] * BRICK)
                    for w in range(2 * reach + 1):
                        for k in range(end):
                            out[b, i, j, k] += weights[w] * along_y[i, j, k + w]
