"""Bodies in a scan, the mannequin above all: which of the dense voxels are one, its surface, and a volume cleared of it.

Dense voxels come as bits, (C, 16, 16) uint16 rows in a table of bricks: bit k of row (i, j) is the brick's voxel (i, j, k).
Hair can be as dense: a ponytail of some thousand strands reaches a mannequin's values, but is never flat (`structure.ripple`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy import ndimage

from .grid import BRICK
from .thresholds import SOLID_VOLUME

FLAT_REACH = 3
"""Dense voxels up to so far from a flat one belong to the body: its rims, and the skin under knots."""
CLEAR = 2
"""Voxels around a body that are cleared with it: its blurred edge, of which a tenth of a lone strand is left there."""
CELL = 4
"""Voxels of a cell in which bodies are told apart."""
MOST_SOLID = 200_000
"""Points kept of the bodies' surface."""


@dataclass(frozen=True)
class Bodies:
    """Bodies of at least `SOLID_VOLUME`. table: brick -> row or -1. rows: (C, 16, 16) uint16, their voxels. volume: mm^3."""

    table: np.ndarray
    rows: np.ndarray
    volume: float

    @classmethod
    def of(cls, table: np.ndarray, dense: np.ndarray, flat: np.ndarray, spacing: float) -> Bodies:
        """The bodies among the voxels `dense`, some of which are `flat`; both (C, 16, 16) uint16. spacing: voxel size, mm.

        Dense voxels far from all flat ones are hair, save for pieces that touch a body and are smaller than one: ears, and the
        wall of coarse scans.
        """
        if not len(dense):
            return cls(table, dense, 0.0)
        rows = np.zeros_like(dense)
        _by_flat(table, np.argwhere(table >= 0), dense, flat, rows)
        cells = _Cells.of(table)
        label, volume = cells.pieces(rows, CELL**3 // 8, spacing)
        large = volume >= SOLID_VOLUME
        if not large.any():
            return cls(table, np.zeros_like(dense), 0.0)
        # with cells that hold only a rim of the body
        near = ndimage.binary_dilation(large[label], np.ones((3, 3, 3)))
        _only_cells(rows, cells.by_brick(near & ((label == 0) | large[label])))
        loose = dense & ~rows
        label, piece = cells.pieces(loose, 0, spacing)
        joins = np.zeros(len(piece), bool)
        joins[label[near]] = True
        joins &= piece < SOLID_VOLUME
        joins[0] = False
        _only_cells(loose, cells.by_brick(joins[label]))
        return cls(table, rows | loose, float(volume[large].sum() + piece[joins].sum()))

    def lie_in(self, index: np.ndarray) -> np.ndarray:
        """(B,) bool: does a body reach into the bricks (B, 3)?"""
        inside = self.table[tuple(index.T)]
        return (inside >= 0) & self.rows.any(axis=(1, 2))[inside]

    def near(self, voxels: np.ndarray) -> np.ndarray:
        """(K,) bool: which of the voxels (K, 3) are within CLEAR of a body, along each axis?"""
        near = np.zeros(len(voxels), bool)
        if len(self.rows):
            _near(self.table, self.rows, voxels, near)
        return near

    def clear(self, index: np.ndarray, bricks: np.ndarray) -> int:
        """Set the voxels within CLEAR of a body to 0 in the bricks (B, 16, 16, 16) at index (B, 3); returns how many."""
        counts = np.zeros(len(bricks), np.int64)
        _clear(self.table, self.rows, index, bricks, counts)
        return int(counts.sum())

    def surface(self, size) -> np.ndarray:
        """(S, 3) voxels on the bodies' outer surface, a shell's inner one and cuts by the scan's border left out. size: the
        scan's voxels along each axis."""
        where = np.argwhere(self.table >= 0).astype(np.int64)
        every = max(int(np.unpackbits(self.rows.view(np.uint8)).sum()) // (40 * MOST_SOLID), 1)
        points, normals, count = _border(self.table, self.rows, where, np.array(size, np.int64), every)
        points, normals = points[:count], normals[:count]
        if not count:
            return np.zeros((0, 3))
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        points = points[((points - centre) * normals).sum(axis=1) > 0.0]
        if len(points) > MOST_SOLID:
            points = points[np.linspace(0, len(points) - 1, MOST_SOLID).astype(np.int64)]
        return points.astype(np.float64)


@dataclass(frozen=True)
class _Cells:
    """Cells of CELL voxels in the box around a table's bricks. rows: (C,) of the bricks; at: (C, 3) their place in the box;
    shape: of the box, bricks."""

    rows: np.ndarray
    at: np.ndarray
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, table: np.ndarray) -> _Cells:
        where = np.argwhere(table >= 0)
        low = where.min(axis=0)
        return cls(table[tuple(where.T)], where - low, tuple(int(n) for n in where.max(axis=0) + 1 - low))

    def pieces(self, rows: np.ndarray, least: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """(labels of the box's cells, mm^3 of each piece): pieces of cells that touch and hold more than `least` voxels.

        Label 0 is what belongs to none, and counts as empty.
        """
        per_brick = BRICK // CELL
        counts = np.zeros((len(rows), per_brick, per_brick, per_brick), np.int16)
        _count_cells(rows, counts)
        grid = np.zeros([per_brick * n for n in self.shape], np.int16)
        x, y, z = self.at.T
        self._spread(grid)[x, :, y, :, z, :] = counts[self.rows]
        label, pieces = ndimage.label(grid > least, np.ones((3, 3, 3)))
        volume = np.bincount(label.ravel(), grid.ravel(), pieces + 1) * spacing**3
        volume[0] = 0.0
        return label, volume

    def by_brick(self, cells: np.ndarray) -> np.ndarray:
        """(C, 4, 4, 4) of the box's cells."""
        x, y, z = self.at.T
        found = np.empty((len(self.rows), *(3 * (BRICK // CELL,))), cells.dtype)
        found[self.rows] = self._spread(cells)[x, :, y, :, z, :]
        return found

    def _spread(self, cells: np.ndarray) -> np.ndarray:
        return cells.reshape([n for size in self.shape for n in (size, BRICK // CELL)])


@numba.njit(cache=True, parallel=True)
def _by_flat(table, where, rows, flats, kept):
    """Keep the voxels of `rows` within FLAT_REACH of one of `flats`, along each axis."""
    for n in numba.prange(len(where)):
        I, J, K = where[n]
        at = table[I, J, K]
        for i in range(BRICK):
            for j in range(BRICK):
                if rows[at, i, j] == 0:
                    continue
                near = np.uint64(0)
                for x in range(BRICK * I + i - FLAT_REACH, BRICK * I + i + FLAT_REACH + 1):
                    for y in range(BRICK * J + j - FLAT_REACH, BRICK * J + j + FLAT_REACH + 1):
                        near |= _line(table, flats, x, y, K, FLAT_REACH)
                wide = near
                for c in range(1, FLAT_REACH + 1):
                    wide |= (near << np.uint64(c)) | (near >> np.uint64(c))
                kept[at, i, j] = rows[at, i, j] & np.uint16((wide >> np.uint64(FLAT_REACH)) & np.uint64(0xFFFF))


@numba.njit(cache=True, parallel=True)
def _near(table, body, voxels, near):
    for n in numba.prange(len(voxels)):
        i, j, k = voxels[n]
        bits = np.uint64((1 << (2 * CLEAR + 1)) - 1) << np.uint64(k % BRICK)
        for x in range(i - CLEAR, i + CLEAR + 1):
            for y in range(j - CLEAR, j + CLEAR + 1):
                if _line(table, body, x, y, k // BRICK, CLEAR) & bits:
                    near[n] = True


@numba.njit(cache=True, parallel=True)
def _count_cells(rows, cells):
    for n in numba.prange(len(rows)):
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    if (rows[n, i, j] >> np.uint16(k)) & 1:
                        cells[n, i // CELL, j // CELL, k // CELL] += 1


@numba.njit(cache=True, parallel=True)
def _only_cells(rows, kept):
    for n in numba.prange(len(rows)):
        for i in range(BRICK):
            for j in range(BRICK):
                mask = 0
                for c in range(BRICK // CELL):
                    if kept[n, i // CELL, j // CELL, c]:
                        mask |= ((1 << CELL) - 1) << (CELL * c)
                rows[n, i, j] &= np.uint16(mask)


@numba.njit(cache=True, inline="always")
def _row(table, rows, i, j, K):
    """16 core bits of the voxels (i, j) of brick layer K; 0 where there are none."""
    if i < 0 or j < 0 or K < 0:
        return np.uint64(0)
    I, J = i // BRICK, j // BRICK
    if I >= table.shape[0] or J >= table.shape[1] or K >= table.shape[2]:
        return np.uint64(0)
    at = table[I, J, K]
    return np.uint64(rows[at, i % BRICK, j % BRICK]) if at >= 0 else np.uint64(0)


@numba.njit(cache=True, inline="always")
def _line(table, rows, i, j, K, reach):
    """The bits of the voxels (i, j) of brick layer K and `reach` more at both ends; bit `reach` is the layer's first voxel."""
    line = _row(table, rows, i, j, K) << np.uint64(reach)
    line |= _row(table, rows, i, j, K - 1) >> np.uint64(BRICK - reach)
    return line | (_row(table, rows, i, j, K + 1) & np.uint64((1 << reach) - 1)) << np.uint64(BRICK + reach)


@numba.njit(cache=True, parallel=True)
def _clear(table, rows, index, bricks, cleared):
    """Set the voxels within CLEAR of a body's core to 0; counts them per brick."""
    for n in numba.prange(len(bricks)):
        K = index[n, 2]
        for i in range(BRICK):
            for j in range(BRICK):
                near = np.uint64(0)
                for a in range(-CLEAR, CLEAR + 1):
                    for b in range(-CLEAR, CLEAR + 1):
                        left = CLEAR * CLEAR - a * a - b * b
                        if left < 0:
                            continue
                        x, y = BRICK * index[n, 0] + i + a, BRICK * index[n, 1] + j + b
                        line = _line(table, rows, x, y, K, CLEAR)
                        if line:
                            reach = int(np.sqrt(left))
                            near |= line
                            for c in range(1, reach + 1):
                                near |= (line << np.uint64(c)) | (line >> np.uint64(c))
                near >>= np.uint64(CLEAR)
                if near:
                    for k in range(BRICK):
                        if (near >> np.uint64(k)) & np.uint64(1):
                            bricks[n, i, j, k] = 0.0
                            cleared[n] += 1


@numba.njit(cache=True, inline="always")
def _is_core(table, rows, i, j, k):
    if k < 0 or k // BRICK >= table.shape[2]:
        return False
    return (_row(table, rows, i, j, k // BRICK) >> np.uint64(k % BRICK)) & np.uint64(1) > 0


@numba.njit(cache=True)
def _border(table, rows, where, size, every):
    """Core voxels with a free neighbour, thinned by `every`, and the direction in which the body ends there."""
    room = 4096
    points, normals = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
    count = seen = 0
    for n in range(len(where)):
        for i in range(BRICK):
            for j in range(BRICK):
                row = rows[table[where[n, 0], where[n, 1], where[n, 2]], i, j]
                if row == 0:
                    continue
                for k in range(BRICK):
                    if not (row >> np.uint16(k)) & 1:
                        continue
                    x, y, z = BRICK * where[n, 0] + i, BRICK * where[n, 1] + j, BRICK * where[n, 2] + k
                    if min(x, y, z) < 2 or x > size[0] - 3 or y > size[1] - 3 or z > size[2] - 3:
                        continue
                    free = (
                        not _is_core(table, rows, x - 1, y, z)
                        or not _is_core(table, rows, x + 1, y, z)
                        or not _is_core(table, rows, x, y - 1, z)
                        or not _is_core(table, rows, x, y + 1, z)
                        or not _is_core(table, rows, x, y, z - 1)
                        or not _is_core(table, rows, x, y, z + 1)
                    )
                    if not free:
                        continue
                    seen += 1
                    if seen % every:
                        continue
                    nx = ny = nz = 0.0
                    for a in range(-2, 3):
                        for b in range(-2, 3):
                            for c in range(-2, 3):
                                if not _is_core(table, rows, x + a, y + b, z + c):
                                    nx, ny, nz = nx + a, ny + b, nz + c
                    if count == room:
                        room *= 2
                        more_points, more_normals = np.empty((room, 3), np.float32), np.empty((room, 3), np.float32)
                        more_points[:count], more_normals[:count] = points, normals
                        points, normals = more_points, more_normals
                    points[count, 0], points[count, 1], points[count, 2] = x, y, z
                    normals[count, 0], normals[count, 1], normals[count, 2] = nx, ny, nz
                    count += 1
    return points, normals, count
