"""BrickVolume: a sparse scalar volume in memory, as bricks of 16^3 voxels under a dense table, made for numba kernels.

The frame is OpenVDB's and ITK's: the centre of voxel (i, j, k) is `origin + (i, j, k) * spacing`, in mm, arrays [x, y, z].
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

BRICK = 16
"""Voxels along one edge of a brick."""
LEAST = 1e-30
"""What stands for 0 in a density that is not whole: exactly 0 is what was cleared, of which nothing is known."""
UNIT = 127.0
"""A direction's unit length where it is stored in int8."""


@dataclass(frozen=True)
class BrickVolume:
    """A sparse volume: dense bricks where something is, `background` elsewhere.

    table: (bx, by, bz) int32; the row of `bricks` that holds brick (I, J, K), or -1 where nothing is stored.
        Brick (I, J, K) covers voxels [16 I, 16 I + 16) and so on.
    bricks: (B, 16, 16, 16) float32, int16 for the density of most scans (or another dtype for masks and labels), indexed
        [x, y, z] inside a brick.
    spacing: mm, the same along the three axes. origin: (3,) float64 mm, the centre of voxel (0, 0, 0).
    """

    table: np.ndarray
    bricks: np.ndarray
    spacing: float
    origin: np.ndarray
    background: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", np.asarray(self.origin, np.float64).reshape(3))
        if self.table.ndim != 3 or self.bricks.shape[1:4] != (BRICK, BRICK, BRICK):
            raise ValueError(f"table must be 3D and bricks (B, 16, 16, 16), got {self.table.shape}, {self.bricks.shape}")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y, z that the table spans (a multiple of 16 each)."""
        return tuple(BRICK * n for n in self.table.shape)

    @property
    def brick_index(self) -> np.ndarray:
        """(B, 3) int32: the position (I, J, K) of each stored brick, in the order of `bricks`."""
        index = np.empty((len(self.bricks), 3), np.int32)
        where = np.argwhere(self.table >= 0)
        index[self.table[tuple(where.T)]] = where
        return index

    @property
    def nbytes(self) -> int:
        return self.table.nbytes + self.bricks.nbytes

    @classmethod
    def from_dense(cls, array: np.ndarray, spacing: float, origin=(0.0, 0.0, 0.0), background: float = 0.0) -> BrickVolume:
        """A volume from a dense [x, y, z] array; bricks that hold nothing but `background` are left out."""
        size = tuple(-(-n // BRICK) for n in array.shape)
        padded = np.full(tuple(BRICK * n for n in size), background, array.dtype)
        padded[: array.shape[0], : array.shape[1], : array.shape[2]] = array
        blocks = padded.reshape(size[0], BRICK, size[1], BRICK, size[2], BRICK).transpose(0, 2, 4, 1, 3, 5)
        kept = (blocks != background).any(axis=(3, 4, 5))
        table = np.full(size, -1, np.int32)
        table[kept] = np.arange(np.count_nonzero(kept), dtype=np.int32)
        return cls(table, np.ascontiguousarray(blocks[kept]), spacing, np.asarray(origin), background)

    def like(self, dtype=np.float32, channels: tuple[int, ...] = ()) -> BrickVolume:
        """A volume of zeros with the same bricks; `channels` adds trailing axes, (3,) for directions, say."""
        bricks = np.zeros((*self.bricks.shape[:4], *channels), dtype)
        return BrickVolume(self.table, bricks, self.spacing, self.origin, 0.0)

    def block(self, low, high) -> np.ndarray:
        """The dense array of the voxels [low, high), `background` where nothing is stored; may reach past the table."""
        low, high = np.asarray(low, np.int64), np.asarray(high, np.int64)
        out = np.empty(tuple(high - low), self.bricks.dtype)
        gather(self.table, self.bricks, self.bricks.dtype.type(self.background), low[0], low[1], low[2], out)
        return out

    def to_voxel(self, points: np.ndarray) -> np.ndarray:
        """Scan frame (mm) -> continuous voxel indices."""
        return (np.asarray(points, np.float64) - self.origin) / self.spacing

    def to_scan(self, voxels: np.ndarray) -> np.ndarray:
        """Continuous voxel indices -> scan frame (mm)."""
        return np.asarray(voxels, np.float64) * self.spacing + self.origin

    def count_above(self, level: float) -> np.ndarray:
        """(B,) int64: how many voxels of each brick exceed `level`."""
        counts = np.empty(len(self.bricks), np.int64)
        _count_above(self.bricks, float(level), counts)
        return counts

    def sample(self, points: np.ndarray) -> np.ndarray:
        """(M,) float32: trilinear values at points (M, 3) of the scan frame, mm."""
        return _sample(self.table, self.bricks, np.float32(self.background), self.to_voxel(points))


@numba.njit(cache=True, inline="always")
def voxel(table, bricks, background, i, j, k):
    """The value of voxel (i, j, k); `background` outside the bricks. For kernels."""
    if i < 0 or j < 0 or k < 0:
        return background
    I, J, K = i >> 4, j >> 4, k >> 4
    if I >= table.shape[0] or J >= table.shape[1] or K >= table.shape[2]:
        return background
    row = table[I, J, K]
    if row < 0:
        return background
    return bricks[row, i & 15, j & 15, k & 15]


@numba.njit(cache=True, nogil=True, inline="always")
def trilinear(table, bricks, background, x, y, z):
    """The trilinear value at continuous voxel indices. For kernels: several times faster where all eight voxels lie in one
    brick, as they do around most points."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = i & 15, j & 15, k & 15
    I, J, K = i >> 4, j >> 4, k >> 4
    if a < 15 and b < 15 and c < 15 and 0 <= I < table.shape[0] and 0 <= J < table.shape[1] and 0 <= K < table.shape[2]:
        row = table[I, J, K]
        value = float(background)
        if row >= 0:
            low = bricks[row, a, b, c], bricks[row, a, b, c + 1], bricks[row, a, b + 1, c], bricks[row, a, b + 1, c + 1]
            a += 1
            high = bricks[row, a, b, c], bricks[row, a, b, c + 1], bricks[row, a, b + 1, c], bricks[row, a, b + 1, c + 1]
            value = _amid(low, high, x - i, y - j, z - k)
    else:
        value = _across(table, bricks, background, x, y, z)
    return value


@numba.njit(cache=True, nogil=True, inline="always")
def _amid(low, high, u, v, w):
    """The trilinear value amid eight voxels: four at the lower x, along z and then y, four at the higher."""
    near = (low[0] * (1.0 - w) + low[1] * w) * (1.0 - v) + (low[2] * (1.0 - w) + low[3] * w) * v
    far = (high[0] * (1.0 - w) + high[1] * w) * (1.0 - v) + (high[2] * (1.0 - w) + high[3] * w) * v
    return near * (1.0 - u) + far * u


@numba.njit(cache=True, nogil=True)
def _across(table, bricks, background, x, y, z):
    """`trilinear` where the eight voxels lie in more than one brick, or in none."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - i, y - j, z - k
    total = 0.0
    for a in range(2):
        wx = fx if a else 1.0 - fx
        for b in range(2):
            wy = fy if b else 1.0 - fy
            for c in range(2):
                wz = fz if c else 1.0 - fz
                total += wx * wy * wz * voxel(table, bricks, background, i + a, j + b, k + c)
    return total


@numba.njit(cache=True)
def gather(table, bricks, background, low_x, low_y, low_z, out):
    """Fill the dense `out` with the voxels from (low_x, low_y, low_z) on."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                out[i, j, k] = voxel(table, bricks, background, low_x + i, low_y + j, low_z + k)


@numba.njit(cache=True, parallel=True)
def _count_above(bricks, level, counts):
    for b in numba.prange(len(bricks)):
        count = 0
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    count += bricks[b, i, j, k] > level
        counts[b] = count


@numba.njit(cache=True, parallel=True)
def _sample(table, bricks, background, voxels):
    values = np.empty(len(voxels), np.float32)
    for n in numba.prange(len(voxels)):
        values[n] = trilinear(table, bricks, background, voxels[n, 0], voxels[n, 1], voxels[n, 2])
    return values
