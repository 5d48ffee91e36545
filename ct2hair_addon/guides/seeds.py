"""Where strands are picked up: hair voxels of the orientation field, the surest single strands first (paper 3.2.2)."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from ..progress import Progress, silent
from ..volume.grid import BRICK, BrickVolume
from ..volume.strand_signal import StrandProfile
from .sampling import centred, density_at, line_mean, plane

SEED_SHARE = 8
"""One hair voxel in so many is a seed: several a strand's cross-section and centimetre, far more than strands need."""
TIERS = 8
"""Steps of certainty: all seeds of a tier are tried before the next, in shuffled order within it."""
RING = 2.6
"""voxel; the ring around a seed that tells a lone strand from a bundle: three times the usual blur."""
AROUND = RING * np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1)
"""(6, 2): the points on it."""
LEAST, FAINT = 0.5, 0.15
"""Shares of a strand's density that a seed's line must have: at its peak, and where it lies, or the peak is not looked for."""
CHUNK = 65536
"""Seeds weighed in one call: a fraction of a second."""
REACH = 5
"""voxel; half the line over which a seed's density is averaged: noise of SNR 2 falls below a sixth of a strand."""


class Seeds(NamedTuple):
    """Voxels that strands are picked up at.

    voxels: (S, 3) int32. directions: (S, 3) int8, unit * 127. shuffle: (S,) uint32, keys of a fixed random order.
    """

    voxels: np.ndarray
    directions: np.ndarray
    shuffle: np.ndarray


@numba.njit(cache=True, nogil=True)
def _hash(x, seed):
    """A 32-bit mix (after Wellons' lowbias32) in 64-bit arithmetic: the same shuffle on every machine."""
    x = (x + 0x9E3779B9 * (seed + 1)) & 0xFFFFFFFF
    x ^= x >> 16
    x = (x * 0x7FEB352D) & 0xFFFFFFFF
    x ^= x >> 15
    x = (x * 0x846CA68B) & 0xFFFFFFFF
    return x ^ (x >> 16)


@numba.njit(cache=True, parallel=True)
def _count(confidence, rows, seed):
    counts = np.zeros(len(rows), np.int64)
    for n in numba.prange(len(rows)):
        row = rows[n]
        flat = confidence[row].reshape(-1)
        for v in range(len(flat)):
            if flat[v] > 0 and _hash(row * len(flat) + v, seed) % SEED_SHARE == 0:
                counts[n] += 1
    return counts


@numba.njit(cache=True, parallel=True)
def _collect(confidence, direction, corner, rows, starts, seed, voxels, directions, shuffle):
    for n in numba.prange(len(rows)):
        row = rows[n]
        at = starts[n]
        flat = confidence[row].reshape(-1)
        for v in range(len(flat)):
            mixed = _hash(row * len(flat) + v, seed)
            if flat[v] > 0 and mixed % SEED_SHARE == 0:
                i, j, k = v // (BRICK * BRICK), v // BRICK % BRICK, v % BRICK
                voxels[at, 0] = corner[row, 0] + i
                voxels[at, 1] = corner[row, 1] + j
                voxels[at, 2] = corner[row, 2] + k
                for axis in range(3):
                    directions[at, axis] = direction[row, i, j, k, axis]
                shuffle[at] = mixed // SEED_SHARE
                at += 1


def seed_voxels(confidence: BrickVolume, direction: BrickVolume, seed: int) -> Seeds:
    """A fixed random choice of the orientation field's voxels."""
    rows = np.arange(len(confidence.bricks), dtype=np.int64)
    counts = _count(confidence.bricks, rows, seed)
    starts = np.concatenate([[0], np.cumsum(counts)])
    voxels = np.empty((starts[-1], 3), np.int32)
    directions = np.empty((starts[-1], 3), np.int8)
    shuffle = np.empty(starts[-1], np.uint32)
    corner = confidence.brick_index * BRICK
    _collect(confidence.bricks, direction.bricks, corner, rows, starts[:-1], seed, voxels, directions, shuffle)
    return Seeds(voxels, directions, shuffle)


def seed_order(
    density: BrickVolume, voxels, directions, shuffle, profile: StrandProfile, progress: Progress = silent
) -> np.ndarray:
    """Indices of the seeds worth trying, surest first: a line of about one strand's density with empty surroundings."""
    certainty = np.zeros(len(voxels), np.float32)
    for start in range(0, len(voxels), CHUNK):
        part = slice(start, start + CHUNK)
        _certainty(density.table, density.bricks, voxels[part], directions[part], profile.seen, certainty[part])
        progress(min(start + CHUNK, len(voxels)), len(voxels))
    tier = np.clip((certainty * TIERS).astype(np.int64), 0, TIERS - 1)
    kept = np.flatnonzero(certainty > 0)
    return kept[np.lexsort((kept, shuffle[kept], -tier[kept]))]


@numba.njit(cache=True, parallel=True)
def _certainty(table, bricks, voxels, directions, seen, certainty):
    for n in numba.prange(len(voxels)):
        dx, dy, dz = float(directions[n, 0]), float(directions[n, 1]), float(directions[n, 2])
        norm = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * norm, dy * norm, dz * norm
        x, y, z = float(voxels[n, 0]), float(voxels[n, 1]), float(voxels[n, 2])
        if line_mean(table, bricks, x, y, z, dx, dy, dz, 2) <= FAINT * seen:
            continue
        x, y, z, _value = centred(table, bricks, x, y, z, dx, dy, dz, 2, 1.0)
        ux, uy, uz, vx, vy, vz = plane(dx, dy, dz)
        middle = ring = 0.0
        for k in range(-REACH, REACH + 1, 2):
            middle += density_at(table, bricks, x + k * dx, y + k * dy, z + k * dz)
        middle /= REACH + 1
        if middle <= LEAST * seen:
            continue
        for k in range(-REACH, REACH + 1, 2):
            px, py, pz = x + k * dx, y + k * dy, z + k * dz
            for c, s in AROUND:
                ring += density_at(table, bricks, px + c * ux + s * vx, py + c * uy + s * vy, pz + c * uz + s * vz)
        ring /= len(AROUND) * (REACH + 1)
        certainty[n] = max(1.0 - ring / middle, 0.01) * min(middle / seen, 1.2 * seen / middle, 1.0)
