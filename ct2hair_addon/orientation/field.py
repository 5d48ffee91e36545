"""The 3D orientation field of the hair with a confidence per voxel (paper 3.2.1, eqs. 1 and 2), by blocks of bricks."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numba
import numpy as np

from ..progress import Progress, silent
from ..settings import OrientationSettings
from ..strands import Strands, normalized
from ..volume import as_grid, write_grids
from ..volume.grid import BRICK, UNIT, BrickVolume, gather
from .eigen import smallest_eigenvector
from .filters import box_taps, derivative_taps, gaussian_taps, gradients, noise_gain, tensor
from .gabor import DIRECTIONS, half_sphere, kernels, orient_by_filters
from .trust import trusted

BLOCK = 4
"""Bricks along one edge of a work block: 64 voxels keep a thread's scratch near 30 MB and the halo's share bearable."""
STRAND_BLUR = 0.85
"""voxel; how wide a strand lies in a scan (EVALUATION.md). Smoothing lowers its peak by STRAND_BLUR^2 / (STRAND_BLUR^2 +
sigma^2),
and the hair level with it, so that a lone strand stays hair whatever `sigma` is."""
LINES = 200_000
"""Lines that show a field, unless it is said how many."""


@dataclass(frozen=True)
class OrientationField:
    """A direction (sign without meaning) and a confidence at each hair voxel, in the bricks of the density.

    direction: BrickVolume int8 (B, 16, 16, 16, 3), unit * 127, 0 off the hair: steps of about half a degree.
    confidence: BrickVolume uint8 (B, 16, 16, 16), 0..255 for 0..1; at least 1 where there is a direction.
    tally: hair voxels, those left out for a low confidence, and the noise found.

    The paper's confidence is ||G o||, small where the gradients agree; here it is made free of the scan's scale:
    `1 - ||G o||^2 / ||G m||^2 = (middle - smallest) / middle` over the eigenvalues of G^T G less the noise's share, with m
    the middle eigenvector: 1 on a clean fibre, 0 where no axis stands out.
    """

    direction: BrickVolume
    confidence: BrickVolume
    tally: dict[str, int]

    def sample(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M, 3) float32 unit directions (0 where there is none) and (M,) float32 confidences, of the voxels nearest to
        the points (M, 3) of the scan frame, mm."""
        voxels = np.rint(self.direction.to_voxel(points)).astype(np.int64)
        direction, confidence = _nearest(self.direction.table, self.direction.bricks, self.confidence.bricks, voxels)
        norm = np.linalg.norm(direction, axis=1, keepdims=True)
        return direction / np.where(norm > 0, norm, 1.0).astype(np.float32), confidence

    def course(self) -> BrickVolume:
        """int8 (B, 16, 16, 16, 3): the directions, UNIT times as long as each is to be trusted: what a trace keeps to."""
        return trusted(self.direction, self.confidence)

    def voxels(self, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(M, 3) mm, (M, 3) unit float32, (M,) 0 to 1: place, direction and confidence of at most `most` voxels, drawn with a
        fixed seed."""
        held = np.flatnonzero(self.confidence.bricks)
        if len(held) > most:
            held = held[np.sort(np.random.default_rng(0).choice(len(held), most, replace=False, shuffle=False))]
        row, *at = np.unravel_index(held, self.confidence.bricks.shape)
        places = self.direction.to_scan(BRICK * self.direction.brick_index[row].astype(np.int64) + np.stack(at, axis=1))
        directions = normalized(self.direction.bricks[row, *at].astype(np.float32))
        return places, directions, self.confidence.bricks[row, *at] / np.float32(255.0)

    def lines(self, most: int = LINES) -> Strands:
        """The field to look at: lines of two points, one voxel long, mm, at at most `most` voxels; with the strand
        attribute `confidence` (N,)."""
        places, directions, confidence = self.voxels(most)
        half = (0.5 * self.direction.spacing) * directions
        points = np.stack([places - half, places + half], axis=1).reshape(-1, 3).astype(np.float32)
        offsets = np.arange(0, len(points) + 1, 2, dtype=np.int64)
        return Strands(points, offsets, {"confidence": confidence})

    def save(self, path: str | os.PathLike) -> None:
        """Write both as grids of a .vdb, `orientation` (vectors of about unit length) and `confidence` (0 to 1), active at hair
        voxels, placed in the scan frame (mm). Raises ScanError where the file can't be written."""
        grids = [
            as_grid(self.direction, "orientation", 1.0 / UNIT),
            as_grid(self.confidence, "confidence", 1.0 / 255.0),
        ]
        write_grids(path, grids)


def noise_level(density: BrickVolume) -> float:
    """The standard deviation of the noise, in density: air has been subtracted, so what lies below 0 is the lower half of
    air's distribution; its median magnitude / 0.6745. 0 for a volume without negative values."""
    stride = max(len(density.bricks) // 512, 1)
    values = density.bricks[::stride]
    below = values[values < 0]
    if not values.size or len(below) < 0.02 * values.size:
        return 0.0
    return float(np.median(-below) / 0.6745)


def orientation_field(
    density: BrickVolume, hair_level: float, settings: OrientationSettings | None = None, progress: Progress = silent
) -> OrientationField:
    """Directions of the hair at voxels whose (equally smoothed) density exceeds `hair_level`.

    density: air at 0. The gradient (eq. 1) is taken under a Gaussian of `settings.sigma` voxels and gathered over one of
    `settings.rho`; with sigma 0 it is the paper's own, raw central differences within a box of 2 rho voxels to each side,
    three in its preset. The direction is the smallest eigenvector of the sum of their outer products (eq. 2), reweighted
    `settings.reweighting` times. With `settings.method` "gabor" oriented filters on the raw density take their place (`gabor`).
    The same bits on any number of threads, whatever the blocks.
    """
    settings = settings or OrientationSettings()
    if settings.method == "gabor":
        return _by_filters(density, hair_level, settings, progress)
    slope = derivative_taps(settings.sigma)
    smooth = gaussian_taps(settings.sigma)
    smooth = np.pad(smooth, (len(slope) - len(smooth)) // 2)
    box = int(np.ceil(2.0 * settings.rho))
    window = gaussian_taps(settings.rho) if settings.sigma > 0 else box_taps(box)
    halo = len(slope) // 2 + len(window) // 2
    noise = noise_level(density) ** 2 * noise_gain(smooth, slope)
    level = hair_level * STRAND_BLUR**2 / (STRAND_BLUR**2 + settings.sigma**2)

    direction = density.like(np.int8, (3,))
    confidence = density.like(np.uint8)
    blocks = _blocks(density)
    at_once = max(2 * numba.get_num_threads(), 2)
    counts = np.zeros((len(blocks), 2), np.int64)
    progress(0, len(blocks))
    for start in range(0, len(blocks), at_once):
        part = slice(start, start + at_once)
        _orient(
            density.table, density.bricks, np.float32(density.background), blocks[part], halo, smooth, slope, window,
            np.float32(level), noise, settings.confidence, settings.reweighting,
            direction.bricks, confidence.bricks, counts[part],
        )  # fmt: skip
        progress(min(start + at_once, len(blocks)), len(blocks))
    hair, kept = (int(n) for n in counts.sum(axis=0))
    tally = {"hair voxels": hair, "with a direction": kept, "left out: low confidence": hair - kept}
    return OrientationField(direction, confidence, tally)


def _by_filters(density: BrickVolume, hair_level: float, settings: OrientationSettings, progress: Progress) -> OrientationField:
    """The field by the paper's ablation, oriented filters; its confidence is another, but the same threshold holds for it."""
    directions = half_sphere(DIRECTIONS)
    offsets, taps = kernels(directions)
    direction, confidence = density.like(np.int8, (3,)), density.like(np.uint8)
    counts = np.zeros((len(density.bricks), 2), np.int64)
    index = density.brick_index.astype(np.int64)
    at_once = 32 * max(numba.get_num_threads(), 1)
    for first in range(0, len(index), at_once):
        progress(first, len(index))
        orient_by_filters(
            density.table, density.bricks, np.float32(density.background), index, first, min(first + at_once, len(index)),
            np.float32(hair_level), settings.confidence, offsets, taps, directions, direction.bricks, confidence.bricks, counts,
        )  # fmt: skip
    progress(1.0, 1.0)
    hair, kept = (int(n) for n in counts.sum(axis=0))
    tally = {"hair voxels": hair, "with a direction": kept, "left out: low confidence": hair - kept}
    return OrientationField(direction, confidence, tally)


def _blocks(density: BrickVolume) -> np.ndarray:
    """(n, 6) int64: first and end brick of each work block, shrunk to the bricks that it holds; none where it holds none."""
    index = density.brick_index.astype(np.int64)
    if not len(index):
        return np.zeros((0, 6), np.int64)
    key = index // BLOCK
    _, group = np.unique(key, axis=0, return_inverse=True)
    group = group.reshape(-1)
    low = np.full((group.max() + 1, 3), np.iinfo(np.int64).max)
    high = np.zeros_like(low)
    np.minimum.at(low, group, index)
    np.maximum.at(high, group, index + 1)
    return np.concatenate([low, high], axis=1)


@numba.njit(cache=True, parallel=True)
def _orient(
    table, bricks, background, blocks, halo, smooth, slope, window, level, noise, lowest, reweighting, direction, confidence,
    counts
):  # fmt: skip
    for n in numba.prange(len(blocks)):
        low = blocks[n, :3] * BRICK
        size = blocks[n, 3:] * BRICK - low
        block = np.empty((size[0] + 2 * halo, size[1] + 2 * halo, size[2] + 2 * halo), np.float32)
        gather(table, bricks, background, low[0] - halo, low[1] - halo, low[2] - halo, block)
        gradient = gradients(block, smooth, slope)
        sums = tensor(gradient, window)
        reach = len(window) // 2
        for I in range(blocks[n, 0], blocks[n, 3]):
            for J in range(blocks[n, 1], blocks[n, 4]):
                for K in range(blocks[n, 2], blocks[n, 5]):
                    row = table[I, J, K]
                    if row < 0:
                        continue
                    _orient_brick(
                        sums, gradient, I * BRICK - low[0], J * BRICK - low[1], K * BRICK - low[2], reach, level,
                        noise, lowest, reweighting, direction[row], confidence[row], counts[n],
                    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _orient_brick(
    sums, gradient, x, y, z, reach, level, noise, lowest, reweighting, direction, confidence, count
):  # fmt: skip
    for i in range(BRICK):
        for j in range(BRICK):
            for k in range(BRICK):
                if gradient[3, x + i + reach, y + j + reach, z + k + reach] <= level:
                    continue
                count[0] += 1
                a, b, c = x + i, y + j, z + k
                ox, oy, oz, small, middle, _large = smallest_eigenvector(
                    float(sums[0, a, b, c]), float(sums[1, a, b, c]), float(sums[2, a, b, c]),
                    float(sums[3, a, b, c]), float(sums[4, a, b, c]), float(sums[5, a, b, c]),
                )  # fmt: skip
                for _ in range(reweighting):
                    ox, oy, oz, small, middle, _large = _reweighted(gradient, a, b, c, 2 * reach + 1, ox, oy, oz)
                certain = min(max((middle - small) / max(middle - noise, noise, 1e-30), 0.0), 1.0)
                if certain < lowest:
                    continue
                count[1] += 1
                direction[i, j, k, 0] = np.int8(np.rint(UNIT * ox))
                direction[i, j, k, 1] = np.int8(np.rint(UNIT * oy))
                direction[i, j, k, 2] = np.int8(np.rint(UNIT * oz))
                confidence[i, j, k] = np.uint8(max(np.rint(255.0 * certain), 1.0))


@numba.njit(cache=True, nogil=True)
def _reweighted(gradient, a, b, c, size, ox, oy, oz):
    """One step of iteratively reweighted least squares (L1) over the box of `size` voxels from (a, b, c): gradients that lie
    along
    the present direction are outliers and weigh less."""
    total = 0.0
    for i in range(a, a + size):
        for j in range(b, b + size):
            for k in range(c, c + size):
                total += abs(gradient[0, i, j, k] * ox + gradient[1, i, j, k] * oy + gradient[2, i, j, k] * oz)
    floor = 0.1 * total / size**3 + 1e-12
    xx = xy = xz = yy = yz = zz = weights = 0.0
    for i in range(a, a + size):
        for j in range(b, b + size):
            for k in range(c, c + size):
                x, y, z = float(gradient[0, i, j, k]), float(gradient[1, i, j, k]), float(gradient[2, i, j, k])
                weight = 1.0 / max(abs(x * ox + y * oy + z * oz), floor)
                weights += weight
                xx += weight * x * x
                xy += weight * x * y
                xz += weight * x * z
                yy += weight * y * y
                yz += weight * y * z
                zz += weight * z * z
    return smallest_eigenvector(xx / weights, xy / weights, xz / weights, yy / weights, yz / weights, zz / weights)


@numba.njit(cache=True, parallel=True)
def _nearest(table, direction, confidence, voxels):
    out = np.zeros((len(voxels), 3), np.float32)
    certain = np.zeros(len(voxels), np.float32)
    for n in numba.prange(len(voxels)):
        i, j, k = voxels[n]
        if min(i, j, k) < 0 or i >> 4 >= table.shape[0] or j >> 4 >= table.shape[1] or k >> 4 >= table.shape[2]:
            continue
        row = table[i >> 4, j >> 4, k >> 4]
        if row >= 0:
            for axis in range(3):
                out[n, axis] = direction[row, i & 15, j & 15, k & 15, axis]
            certain[n] = confidence[row, i & 15, j & 15, k & 15] / 255.0
    return out, certain
