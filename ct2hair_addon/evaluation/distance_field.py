"""Signed distance to a head on a lattice, for kernels that ask it at every voxel or at every point of every strand."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..head import Head
from ..progress import Progress, silent

COARSE = 8
"""Lattice steps between the points that are asked for everywhere; near the surface all are."""

_PER_CALL = 1 << 17


@dataclass(frozen=True)
class DistanceField:
    """Signed distance (mm, negative inside) on a lattice.

    values: dense float32 [x, y, z]; step: mm; origin: (3,) mm of (0, 0, 0).
    """

    values: np.ndarray
    step: float
    origin: np.ndarray

    @classmethod
    def around(cls, head: Head, low: np.ndarray, high: np.ndarray, step: float, progress: Progress = silent) -> DistanceField:
        """The box from `low` to `high` (3,) mm at least: exact lattice points near the surface, a coarse lattice elsewhere."""
        low = np.asarray(low, np.float64)
        cells = np.maximum(np.ceil((np.asarray(high, np.float64) - low) / (step * COARSE)).astype(int), 1)
        corners = cells + 1
        index = np.stack(np.meshgrid(*[np.arange(n) for n in corners], indexing="ij"), axis=-1).reshape(-1, 3)
        coarse = head.signed_distance(low + index * (step * COARSE)).reshape(corners)
        values = np.empty(cells * COARSE + 1, np.float32)
        _upsample(coarse, COARSE, values)
        # within a coarse cell of the surface the lattice is asked exactly; beyond, only the sign and the order matter
        near = np.flatnonzero(np.abs(values.ravel()) < step * COARSE)
        for start in range(0, len(near), _PER_CALL):
            progress(start, len(near))
            which = near[start : start + _PER_CALL]
            place = np.stack(np.unravel_index(which, values.shape), axis=1)
            values.ravel()[which] = head.signed_distance(low + place * step)
        return cls(values, float(step), low)

    def sample(self, points: np.ndarray) -> np.ndarray:
        """(M,) float32 mm at points (M, 3)."""
        return _sample(self.values, (np.asarray(points, np.float64) - self.origin) / self.step)


@numba.njit(cache=True, inline="always")
def lattice_value(values, x, y, z):
    """Trilinear value of a dense array at continuous indices; the outer cells go on beyond its faces. For kernels."""
    i = min(max(int(x), 0), values.shape[0] - 2)
    j = min(max(int(y), 0), values.shape[1] - 2)
    k = min(max(int(z), 0), values.shape[2] - 2)
    fx, fy, fz = x - i, y - j, z - k
    low = (values[i, j, k] * (1 - fz) + values[i, j, k + 1] * fz) * (1 - fy) + (
        values[i, j + 1, k] * (1 - fz) + values[i, j + 1, k + 1] * fz
    ) * fy
    high = (values[i + 1, j, k] * (1 - fz) + values[i + 1, j, k + 1] * fz) * (1 - fy) + (
        values[i + 1, j + 1, k] * (1 - fz) + values[i + 1, j + 1, k + 1] * fz
    ) * fy
    return low * (1 - fx) + high * fx


@numba.njit(cache=True)
def distance_and_normal(values, step, origin, x, y, z, normal):
    """Distance (mm) at a point (mm); fills `normal` (3,) with the unit direction away from the surface. For kernels."""
    u, v, w = (x - origin[0]) / step, (y - origin[1]) / step, (z - origin[2]) / step
    normal[0] = lattice_value(values, u + 0.5, v, w) - lattice_value(values, u - 0.5, v, w)
    normal[1] = lattice_value(values, u, v + 0.5, w) - lattice_value(values, u, v - 0.5, w)
    normal[2] = lattice_value(values, u, v, w + 0.5) - lattice_value(values, u, v, w - 0.5)
    norm = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if norm > 0.0:
        normal /= norm
    return lattice_value(values, u, v, w)


@numba.njit(cache=True, parallel=True)
def _upsample(coarse, factor, out):
    for i in numba.prange(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                out[i, j, k] = lattice_value(coarse, i / factor, j / factor, k / factor)


@numba.njit(cache=True, parallel=True)
def _sample(values, lattice):
    out = np.empty(len(lattice), np.float32)
    for n in numba.prange(len(lattice)):
        out[n] = lattice_value(values, lattice[n, 0], lattice[n, 1], lattice[n, 2])
    return out
