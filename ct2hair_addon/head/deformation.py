"""A smooth deformation of space as a cubic B-spline lattice, fitted to points with a bending penalty (supplement 1).

Free-form deformation after Rueckert et al. 1999 ("Nonrigid registration using free-form deformations"). Everything here is
deterministic on any number of threads: the solver is conjugate gradients without BLAS.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags

PASSES = 100
"""Conjugate-gradient steps at most; warm starts need fewer."""
ACCURACY = 1e-3
"""Relative residual at which the solver stops: some micrometres, and the next round goes on from there."""


@dataclass(frozen=True)
class Lattice:
    """Control points every `spacing` mm over the box of `points`, with the rows that blend them at those points.

    rows: (V, N) sparse; the displacement at point v is rows[v] @ coefficients (N, 3). bending, slope: (N, N) sparse, the
    squared second and first differences of the coefficients over neighbouring control points that any point is blended from.
    """

    spacing: float
    rows: csr_matrix
    bending: csr_matrix
    slope: csr_matrix

    @classmethod
    def over(cls, points: np.ndarray, spacing: float) -> Lattice:
        points = np.asarray(points, np.float64)
        low = points.min(axis=0) - spacing
        at = (points - low) / spacing
        cell = np.floor(at).astype(np.int64)
        t = at - cell
        blend = (
            np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=2) / 6.0
        )  # (V, axis, 4)
        size = cell.max(axis=0) + 4
        columns, values = [], []
        for i in range(4):
            for j in range(4):
                for k in range(4):
                    node = ((cell[:, 0] + i) * size[1] + cell[:, 1] + j) * size[2] + cell[:, 2] + k
                    columns.append(node)
                    values.append(blend[:, 0, i] * blend[:, 1, j] * blend[:, 2, k])
        used, columns = np.unique(np.stack(columns, axis=1), return_inverse=True)
        row = np.repeat(np.arange(len(points)), 64)
        rows = coo_matrix((np.stack(values, axis=1).ravel(), (row, columns.ravel())), shape=(len(points), len(used))).tocsr()
        return cls(spacing, rows, *_penalties(used, size, spacing))

    def fitted(self, blend: csr_matrix, wanted, weight, bending, slope, start) -> np.ndarray:
        """(N, 3) coefficients: least squares of `blend @ rows @ c` (M, 3) to `wanted`, weights (M,), plus the penalties."""
        normal, right = _normal_equations(blend, wanted, weight)
        penalty = bending * self.bending + slope * self.slope
        return _conjugate_gradients(self.rows.T @ (normal @ self.rows) + penalty, self.rows.T @ right, start)


def least_squares(rows: csr_matrix, wanted, weight, penalty: csr_matrix, start) -> np.ndarray:
    """(N, 3) x that makes sum(weight |rows @ x - wanted|^2) + x' penalty x least, from `start` (N, 3)."""
    normal, right = _normal_equations(rows, wanted, weight)
    return _conjugate_gradients(normal + penalty, right, start)


def _normal_equations(rows, wanted, weight):
    """Matrix and right side of the least squares: there are far fewer unknowns than rows, so a step costs a tenth."""
    columns = (diags(weight) @ rows).T.tocsr()
    return columns @ rows, columns @ wanted


def _penalties(used, size, spacing):
    """Bending and slope energies over the control points `used` of a lattice, as integrals (per mm^3 of space)."""
    place = np.full(int(np.prod(size)), -1, np.int64)
    place[used] = np.arange(len(used))
    index = np.stack(np.unravel_index(used, size), axis=1)
    bending, slope = [], []

    def rows(offsets, factors, into, weight):
        nodes = []
        for offset in offsets:
            moved = index + offset
            inside = ((moved >= 0) & (moved < size)).all(axis=1)
            node = np.where(inside, place[np.ravel_multi_index(np.where(inside[:, None], moved, 0).T, size)], -1)
            nodes.append(node)
        nodes = np.stack(nodes, axis=1)
        nodes = nodes[(nodes >= 0).all(axis=1)]
        row = np.repeat(np.arange(len(nodes)), len(factors))
        difference = coo_matrix((np.tile(factors, len(nodes)), (row, nodes.ravel())), shape=(len(nodes), len(used))).tocsr()
        into.append(weight * (difference.T @ difference))

    unit = np.eye(3, dtype=np.int64)
    for a in range(3):
        rows([-unit[a], 0 * unit[a], unit[a]], [1.0, -2.0, 1.0], bending, 1.0 / spacing)
        rows([0 * unit[a], unit[a]], [-1.0, 1.0], slope, spacing)
        for b in range(a):
            rows([0 * unit[a], unit[a], unit[b], unit[a] + unit[b]], [1.0, -1.0, -1.0, 1.0], bending, 2.0 / spacing)
    return sum(bending).tocsr(), sum(slope).tocsr()


def _conjugate_gradients(matrix, right, start):
    """The three columns of a symmetric positive system at once, preconditioned by its diagonal."""
    matrix = matrix.tocsr()
    diagonal = matrix.diagonal()[:, None] + 1e-12
    x = start.copy()
    residual = right - matrix @ x
    scaled = residual / diagonal
    direction = scaled.copy()
    energy = (residual * scaled).sum(axis=0)
    enough = ACCURACY**2 * np.maximum((right * right / diagonal).sum(axis=0), 1e-20)
    for _ in range(PASSES):
        if (energy <= enough).all():
            break
        image = matrix @ direction
        step = energy / np.maximum((direction * image).sum(axis=0), 1e-30)
        x += step * direction
        residual -= step * image
        scaled = residual / diagonal
        before, energy = energy, (residual * scaled).sum(axis=0)
        direction = scaled + energy / np.maximum(before, 1e-30) * direction
    return x
