"""A scan whose voxels are no cubes, read as one whose voxels are: linear between slices, rows and columns."""

from __future__ import annotations

import numpy as np

from .readers import ScanReader

ALIKE = 1e-3
"""Spacings that differ by less than this share are one spacing."""


class CubicScan:
    """A `ScanReader`'s scan on cubes of its smallest spacing; the same frame, the same calls as far as imports need them."""

    def __init__(self, reader: ScanReader) -> None:
        self._reader = reader
        self.path, self.name, self.order, self.origin = reader.path, reader.name, reader.order, reader.origin
        self.dtype = reader.dtype
        edge = float(reader.spacing.min())
        self.spacing = np.full(3, edge)
        extent = (np.array(reader.shape) - 1) * reader.spacing
        self.shape = tuple(int(n) for n in np.floor(extent / edge + 1e-6) + 1)
        self.warnings = [
            *reader.warnings,
            f"voxels of {' x '.join(f'{s:g}' for s in reader.spacing)} mm are resampled to cubes of {edge:g} mm",
        ]

    @property
    def not_numbers(self) -> int:
        return self._reader.not_numbers

    def prepare(self, progress) -> None:
        self._reader.prepare(progress)

    def native(self, low: int, high: int) -> np.ndarray:
        """float32 (high - low, mid, fast): the slices [low, high) along `order[0]`, as `ScanReader.native`."""
        slow = self.order[0]
        step = self.spacing[0] / self._reader.spacing[slow]
        at = np.arange(low, high) * step
        last = self._reader.shape[slow] - 1
        first = int(min(np.floor(at[0] + 1e-9), last)) if high > low else 0
        end = int(min(np.floor(at[-1] + 1e-9) + 2, last + 1)) if high > low else 0
        values = self._reader.native(first, end)
        values = _between(values, at - first, 0)
        for axis in (1, 2):
            world = self.order[axis]
            places = np.arange(self.shape[world]) * (self.spacing[0] / self._reader.spacing[world])
            values = _between(values, places, axis)
        return values


def cubic(reader: ScanReader) -> ScanReader | CubicScan:
    """The reader itself where its voxels are cubes, else a view of it that has cubes."""
    if isinstance(reader, CubicScan) or reader.spacing.max() <= reader.spacing.min() * (1.0 + ALIKE):
        return reader
    return CubicScan(reader)


def _between(values: np.ndarray, places: np.ndarray, axis: int) -> np.ndarray:
    """`values` at fractional `places` along an axis, linear between neighbours, contiguous."""
    size = values.shape[axis]
    low = np.minimum(np.floor(places + 1e-9).astype(np.int64), size - 1)
    share = np.clip(places - low, 0.0, 1.0).astype(np.float32)
    if len(low) == size and not share.any() and (low == np.arange(size)).all():
        return np.ascontiguousarray(values)
    high = np.minimum(low + 1, size - 1)
    shape = [1, 1, 1]
    shape[axis] = len(places)
    share = share.reshape(shape)
    out = np.take(values, low, axis=axis)
    out += share * (np.take(values, high, axis=axis) - out)
    return np.ascontiguousarray(out)
