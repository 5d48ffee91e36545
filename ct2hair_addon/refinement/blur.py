"""A Gaussian over bricks: each is taken with a rim of its neighbours, and blurred along one axis after the other."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np

from ..progress import Progress, silent
from ..volume import BRICK, BrickVolume

REACH = 3
"""Voxels that the Gaussian is cut at: 3.5 standard deviations of the usual 0.85."""
WIDE = BRICK + 2 * REACH
"""Voxels along an edge of a brick with its rim."""
LAYERS = 3
"""Layers of bricks across x that are held at a time: what the blur of one reads."""
CHUNK = 256
"""Bricks a kernel call: short enough to be cancelled at once."""


def gaussian_taps(blur: float) -> np.ndarray:
    """(2 REACH + 1,) float32: normalised Gaussian weights; a blur near 0 leaves the middle one."""
    offsets = np.arange(-REACH, REACH + 1)
    taps = np.exp(-0.5 * (offsets / max(blur, 1e-3)) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def blurred(volume: BrickVolume, blur: float, out: np.ndarray | None = None, progress: Progress = silent) -> np.ndarray:
    """(B, 16, 16, 16) float32: the bricks under a Gaussian of `blur` voxels, `background` taken outside them.

    out: written to and returned; it may be the volume's own bricks, and no more than three layers of them are held then.
    """
    out = np.empty(volume.bricks.shape, np.float32) if out is None else out
    index, taps, background = volume.brick_index, gaussian_taps(blur), volume.bricks.dtype.type(volume.background)
    order, begin, place, room = ring(index, len(volume.table))
    held = np.empty((room, BRICK, BRICK, BRICK), volume.bricks.dtype)
    places = np.full_like(volume.table, -1)
    places[tuple(index.T)] = place
    for x in range(len(places) + 1):
        for start, stop in chunks(begin[x], begin[min(x + 1, len(places))]):
            rows = order[start:stop]
            held[place[rows]] = volume.bricks[rows]
        # both neighbours of the layer before are there by now
        for start, stop in chunks(begin[max(x - 1, 0)], begin[x]):
            progress(start, len(out))
            _blur_bricks(places, held, background, index, taps, order[start:stop], out)
    return out


def chunks(low: int, high: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of CHUNK bricks each from `low` to `high`."""
    for start in range(low, high, CHUNK):
        yield start, min(start + CHUNK, high)


def ring(index: np.ndarray, layers: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Room for LAYERS layers of bricks across x, in which one overwrites the third before it.

    index (R, 3): the bricks. Returns (order (R,) by layer; begin (layers + 1,) of each there; place (R,) int32 of each brick in
    the room; how many bricks it must hold).
    """
    order = np.argsort(index[:, 0], kind="stable")
    layer = index[order, 0]
    begin = np.searchsorted(layer, np.arange(layers + 1))
    most = int(np.diff(begin).max(initial=0))
    place = np.empty(len(index), np.int32)
    place[order] = np.arange(len(index)) - begin[layer] + layer % LAYERS * most
    return order, begin, place, LAYERS * most


@numba.njit(cache=True, parallel=True)
def _blur_bricks(places, bricks, background, index, taps, rows, out):
    for n in numba.prange(len(rows)):
        b = rows[n]
        block = np.empty(WIDE**3, np.float32)
        with_rim(places, bricks, background, index[b, 0], index[b, 1], index[b, 2], BRICK, block)
        blur_block(block, taps, BRICK, out[b].reshape(BRICK**3))


@numba.njit(cache=True)
def with_rim(places, bricks, background, bi, bj, bk, size, block):
    """Fill `block` ((size + 2 REACH)^3,) with `size` voxels from the first of brick (bi, bj, bk) on and REACH to either side.

    places (x, y, z) tells where in `bricks` each brick lies, -1 for `background`. size: BRICK, or a little more.
    """
    wide, beyond = size + 2 * REACH, size - BRICK + REACH
    for di in range(-1, 2):
        x0, x1 = _span(di, beyond)
        for dj in range(-1, 2):
            y0, y1 = _span(dj, beyond)
            i, j = bi + di, bj + dj
            inside = 0 <= i < places.shape[0] and 0 <= j < places.shape[1]
            before = places[i, j, bk - 1] if inside and bk > 0 else -1
            here = places[i, j, bk] if inside else -1
            after = places[i, j, bk + 1] if inside and bk + 1 < places.shape[2] else -1
            for x in range(x0, x1):
                for y in range(y0, y1):
                    p, q = x - REACH - BRICK * di, y - REACH - BRICK * dj
                    at = (x * wide + y) * wide
                    for z in range(REACH):
                        block[at + z] = bricks[before, p, q, BRICK - REACH + z] if before >= 0 else background
                    at += REACH
                    for z in range(BRICK):
                        block[at + z] = bricks[here, p, q, z] if here >= 0 else background
                    at += BRICK
                    for z in range(beyond):
                        block[at + z] = bricks[after, p, q, z] if after >= 0 else background


@numba.njit(cache=True, inline="always")
def _span(d, beyond):
    """The slice of a block with its rim that neighbour d (-1, 0, 1) fills."""
    if d < 0:
        return 0, REACH
    if d > 0:
        return REACH + BRICK, REACH + BRICK + beyond
    return REACH, REACH + BRICK


@numba.njit(cache=True, inline="always")
def blur_block(block, taps, size, out):
    """A separable convolution of (size + 2 REACH)^3 into size^3, both flat; a `size` known when it is compiled vectorises."""
    a, b, c, d = taps[3], taps[2], taps[1], taps[0]
    wide = size + 2 * REACH
    across, along = np.empty(wide * wide, np.float32), np.empty(size * wide, np.float32)
    for x in range(size):
        for q in range(wide * wide):
            across[q] = _seven(block, x * wide * wide + q, wide * wide, a, b, c, d)
        for q in range(size * wide):
            along[q] = _seven(across, q, wide, a, b, c, d)
        for y in range(size):
            for z in range(size):
                out[(x * size + y) * size + z] = _seven(along, y * wide + z, 1, a, b, c, d)


@numba.njit(cache=True, inline="always")
def _seven(values, at, step, a, b, c, d):
    """The sum of seven values under symmetric taps, `d` at the ends."""
    return (
        a * values[at + 3 * step]
        + b * (values[at + 2 * step] + values[at + 4 * step])
        + c * (values[at + step] + values[at + 5 * step])
        + d * (values[at] + values[at + 6 * step])
    )
