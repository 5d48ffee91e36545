"""Orientation by oriented filters, the paper's ablation (3.2.1, 4.1.1, Fig. 5 a): the kernel that answers most gives it.

Kernel filtering of CT volumes after Zhao et al. 2011 ("Building volumetric appearance models of fabric using micro CT
imaging"): one elongated kernel per direction. Here a Gabor function of the distance from an axis (cosine under a Gaussian, as
Paris et al. 2004 use on photographs of hair), stretched along the axis by a Gaussian.
"""

from __future__ import annotations

import numba
import numpy as np

from ..volume.grid import BRICK, UNIT, gather
from .eigen import smallest_eigenvector

RADIUS = 4
"""voxel; the kernels' reach."""
ALONG = 3.0
"""voxel; Gaussian along the axis."""
ACROSS = 2.0
"""voxel; Gaussian across the axis."""
WAVELENGTH = 6.0
"""voxel; of the cosine across the axis: its positive lobe is as wide as a strand in a scan. The three numbers are the best of
a search over ALONG 1.5 to 3, ACROSS 1.2 to 2.4, WAVELENGTH 4 to 7 on bent strands of SNR 4, as the paper tuned its own."""
DIRECTIONS = 120
"""Directions on the half sphere, 12 degrees apart; what lies between is found from the best ones' answers."""
SHARE = 0.85
"""Directions that answer with this share of the best take part in that."""


def half_sphere(count: int) -> np.ndarray:
    """(count, 3) float64 unit vectors spread evenly over the half sphere z >= 0 (a Fibonacci lattice)."""
    n = np.arange(count) + 0.5
    z, turn = 1.0 - n / count, np.pi * (1.0 + 5.0**0.5) * n
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def kernels(
    directions: np.ndarray, radius: int = RADIUS, along: float = ALONG, across: float = ACROSS, wavelength: float = WAVELENGTH
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) int64 offsets within a ball of `radius` voxels and (D, K) float32 taps: a kernel a direction, deaf to constants,
    of unit square sum, so that noise answers in all alike."""
    cube = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = cube[(cube**2).sum(axis=1) <= radius * radius]
    s = offsets @ directions.T
    square = np.maximum((offsets**2).sum(axis=1)[:, None] - s * s, 0.0)
    envelope = np.exp(-0.5 * (s / along) ** 2 - 0.5 * square / across**2)
    taps = envelope * np.cos(2.0 * np.pi * np.sqrt(square) / wavelength)
    taps -= envelope * (taps.sum(axis=0) / envelope.sum(axis=0))
    taps /= np.linalg.norm(taps, axis=0)
    return offsets.astype(np.int64), np.ascontiguousarray(taps.T.astype(np.float32))


@numba.njit(cache=True, parallel=True)
def orient_by_filters(
    table, bricks, background, index, first, last, level, lowest, offsets, taps, directions, direction, confidence, counts
):  # fmt: skip
    """Fill direction and confidence (as in `OrientationField`) of the bricks [first, last) at voxels above `level`.

    Confidence: how far the best answer stands over the directions' mean positive one. counts (B, 2): hair, with a direction.
    """
    reach = offsets.max()
    size = BRICK + 2 * reach
    for b in numba.prange(first, last):
        block = np.empty((size, size, size), np.float32)
        gather(
            table, bricks, background, index[b, 0] * BRICK - reach, index[b, 1] * BRICK - reach, index[b, 2] * BRICK - reach,
            block,
        )  # fmt: skip
        flat = block.reshape(-1)
        steps = np.empty(len(offsets), np.int64)
        for t in range(len(offsets)):
            steps[t] = (offsets[t, 0] * size + offsets[t, 1]) * size + offsets[t, 2]
        around = np.empty(len(offsets), np.float32)
        answers = np.empty(len(taps), np.float32)
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    at = ((i + reach) * size + j + reach) * size + k + reach
                    if flat[at] <= level:
                        continue
                    counts[b, 0] += 1
                    for t in range(len(steps)):
                        around[t] = flat[at + steps[t]]
                    best, mean = _answers(taps, around, answers)
                    if best <= 0.0 or 1.0 - mean / best < lowest:
                        continue
                    xx = xy = xz = yy = yz = zz = 0.0
                    for d in range(len(answers)):
                        weight = answers[d] - SHARE * best
                        if weight > 0.0:
                            x, y, z = directions[d, 0], directions[d, 1], directions[d, 2]
                            xx, xy, xz = xx - weight * x * x, xy - weight * x * y, xz - weight * x * z
                            yy, yz, zz = yy - weight * y * y, yz - weight * y * z, zz - weight * z * z
                    x, y, z, _small, _middle, _large = smallest_eigenvector(xx, xy, xz, yy, yz, zz)
                    counts[b, 1] += 1
                    direction[b, i, j, k, 0] = np.int8(np.rint(UNIT * x))
                    direction[b, i, j, k, 1] = np.int8(np.rint(UNIT * y))
                    direction[b, i, j, k, 2] = np.int8(np.rint(UNIT * z))
                    confidence[b, i, j, k] = np.uint8(max(np.rint(255.0 * min(1.0 - mean / best, 1.0)), 1.0))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _answers(taps, around, answers):
    """Fill `answers` with the kernels' responses; returns the best and the mean of the positive parts."""
    best, total = np.float32(-1e30), np.float32(0.0)
    for d in range(len(taps)):
        value = np.float32(0.0)
        row = taps[d]
        for t in range(len(around)):
            value += row[t] * around[t]
        answers[d] = value
        best = max(best, value)
        total += max(value, np.float32(0.0))
    return best, total / len(taps)
