"""The nearest points of dense sets, exactly, by a grid of cells: what strand scores and the paper's fit ask millions of times.

Nearest first, equal distances by index: the same answer on any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

CELLS_LIMIT = 1 << 26
"""Cells of the table at most (256 MB): cells grow where a set is spread farther."""

OCCUPANCY = 3.0
"""Points wanted per occupied cell: few to look through, few cells to visit."""

SLACK = 1e-6
"""Share by which the square of a distance may be off, rounded: a cell that begins so little beyond it is looked into."""


@dataclass(frozen=True)
class PointGrid:
    """Points (M, 3) sorted into cells. start: (nx, ny, nz) + 1 flat int64, the first sorted row of each cell.

    points: float32, sorted by cell. order: (M,) int64, the original index of each sorted row. cell: mm. low: (3,) float64.
    """

    points: np.ndarray
    order: np.ndarray
    start: np.ndarray
    size: np.ndarray
    cell: float
    low: np.ndarray

    @classmethod
    def build(cls, points: np.ndarray) -> PointGrid:
        points = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        if not len(points):
            return cls(points, np.zeros(0, np.int64), np.zeros(2, np.int64), np.ones(3, np.int64), 1.0, np.zeros(3))
        low = points.min(axis=0).astype(np.float64)
        extent = points.max(axis=0).astype(np.float64) - low
        # occupied cells are counted on a coarse try, then the edge is set for the wanted points in each
        cell = max(extent.max() / 64.0, 1e-3)
        occupied = len(np.unique(_cells(points, low, cell, _sizes(extent, cell))))
        cell *= (OCCUPANCY * occupied / len(points)) ** (1.0 / 3.0)
        cell = max(cell, (np.prod(np.maximum(extent, 1e-3)) / CELLS_LIMIT) ** (1.0 / 3.0), 1e-3)
        while np.prod(_sizes(extent, cell).astype(np.float64)) > CELLS_LIMIT:
            cell *= 1.1
        size = _sizes(extent, cell)
        start, order = _sorted_by(_cells(points, low, cell, size), int(np.prod(size)))
        return cls(points[order], order, start, size, float(cell), low)

    def nearest(self, queries: np.ndarray, count: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """(Q, count) int64 original indices and (Q, count) float64 distances; -1 and inf where fewer lie within `reach` mm."""
        queries = np.ascontiguousarray(queries, np.float32).reshape(-1, 3)
        index, distance = np.empty((len(queries), count), np.int64), np.empty((len(queries), count))
        _nearest(self.points, self.order, self.start, self.size, self.cell, self.low, queries, reach, index, distance)
        return index, distance


def _sizes(extent: np.ndarray, cell: float) -> np.ndarray:
    return (np.floor(extent / cell) + 1).astype(np.int64)


@numba.njit(cache=True, parallel=True)
def _cells(points, low, cell, size):
    cells = np.empty(len(points), np.int64)
    for n in numba.prange(len(points)):
        i = min(max(int((points[n, 0] - low[0]) / cell), 0), size[0] - 1)
        j = min(max(int((points[n, 1] - low[1]) / cell), 0), size[1] - 1)
        k = min(max(int((points[n, 2] - low[2]) / cell), 0), size[2] - 1)
        cells[n] = (i * size[1] + j) * size[2] + k
    return cells


@numba.njit(cache=True)
def _sorted_by(cells, count):
    """Counting sort: (count + 1,) first row of each cell, (M,) original index of each row."""
    start = np.zeros(count + 1, np.int64)
    for c in cells:
        start[c + 1] += 1
    for c in range(count):
        start[c + 1] += start[c]
    cursor = start[:-1].copy()
    order = np.empty(len(cells), np.int64)
    for n in range(len(cells)):
        order[cursor[cells[n]]] = n
        cursor[cells[n]] += 1
    return start, order


@numba.njit(cache=True, inline="always")
def _beyond(place, index, cell):
    """Square of how far a place, counted from the first cell, lies outside a cell along an axis."""
    outside = max(index * cell - place, place - (index + 1) * cell, 0.0)
    return outside * outside


@numba.njit(cache=True)
def nearest_rows(points, order, start, size, cell, low, x, y, z, reach, rows, squared):
    """Fill `rows` (sorted rows) and `squared` distances with the nearest within `reach`; returns how many. For kernels."""
    wanted = len(rows)
    found = 0
    limit = reach * reach
    ci = int(np.floor((x - low[0]) / cell))
    cj = int(np.floor((y - low[1]) / cell))
    ck = int(np.floor((z - low[2]) / cell))
    # how far the query is from the nearest face of its own cell: every ring of cells adds a whole cell to that
    inner = min(
        min(x - low[0] - ci * cell, (ci + 1) * cell - (x - low[0])),
        min(y - low[1] - cj * cell, (cj + 1) * cell - (y - low[1])),
        min(z - low[2] - ck * cell, (ck + 1) * cell - (z - low[2])),
    )
    ring = 0
    while True:
        for i in range(max(ci - ring, 0), min(ci + ring, size[0] - 1) + 1):
            beyond_x = _beyond(x - low[0], i, cell)
            if beyond_x > limit:
                continue
            for j in range(max(cj - ring, 0), min(cj + ring, size[1] - 1) + 1):
                beyond_xy = beyond_x + _beyond(y - low[1], j, cell)
                if beyond_xy > limit:
                    continue
                on_face = abs(i - ci) == ring or abs(j - cj) == ring
                step = 1 if on_face else max(2 * ring, 1)
                for k in range(ck - ring, ck + ring + 1, step):
                    if k < 0 or k >= size[2] or beyond_xy + _beyond(z - low[2], k, cell) > limit:
                        continue
                    c = (i * size[1] + j) * size[2] + k
                    for row in range(start[c], start[c + 1]):
                        dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
                        d2 = dx * dx + dy * dy + dz * dz
                        if d2 > limit:
                            continue
                        if found == wanted:
                            last = found - 1
                            if d2 > squared[last] or (d2 == squared[last] and order[row] > order[rows[last]]):
                                continue
                        else:
                            found += 1
                        at = found - 1
                        while at > 0 and (d2 < squared[at - 1] or (d2 == squared[at - 1] and order[row] < order[rows[at - 1]])):
                            squared[at] = squared[at - 1]
                            rows[at] = rows[at - 1]
                            at -= 1
                        squared[at] = d2
                        rows[at] = row
                        if found == wanted:
                            limit = min(limit, squared[wanted - 1] * (1.0 + SLACK))
        clear = inner + ring * cell
        if clear > 0.0 and clear * clear > limit:
            break
        if max(ci, cj, ck) <= ring and size[0] - ci <= ring and size[1] - cj <= ring and size[2] - ck <= ring:
            break  # all cells were looked into
        ring += 1
    return found


@numba.njit(cache=True, parallel=True)
def _nearest(points, order, start, size, cell, low, queries, reach, index, distance):
    count = index.shape[1]
    for q in numba.prange(len(queries)):
        rows = np.empty(count, np.int64)
        squared = np.empty(count)
        found = 0
        if len(points):
            x, y, z = np.float64(queries[q, 0]), np.float64(queries[q, 1]), np.float64(queries[q, 2])
            found = nearest_rows(points, order, start, size, cell, low, x, y, z, reach, rows, squared)
        for n in range(count):
            index[q, n] = order[rows[n]] if n < found else -1
            distance[q, n] = np.sqrt(squared[n]) if n < found else np.inf
