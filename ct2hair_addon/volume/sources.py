"""Where a scan's voxels come from: each source reads a run of slices along its file's slowest axis (paper 3.1)."""

from __future__ import annotations

import os
import tempfile
import weakref
import zlib
from pathlib import Path

import numpy as np

from ..errors import ScanError
from ..progress import Progress, silent

CHUNK = 4 * 2**20
"""Bytes of a packed file that are unpacked between two reports of progress."""


class Source:
    """Voxels in the file's own order: `shape` (slow, mid, fast) and `dtype`; `read(low, high)` gives slices of them."""

    shape: tuple[int, int, int]
    dtype: np.dtype

    def prepare(self, progress: Progress = silent) -> None:
        """Whatever must be done once before the first read and may take long."""

    def read(self, low: int, high: int) -> np.ndarray:
        raise NotImplementedError

    def close(self) -> None:
        """Let go of files."""


class FlatFile(Source):
    """Values one after another from a byte offset on: raw, .npy, uncompressed NIfTI, NRRD, MetaImage, contiguous TIFF."""

    def __init__(self, path: Path, offset: int, shape, dtype: np.dtype) -> None:
        self.path, self.offset, self.shape, self.dtype = path, int(offset), tuple(int(n) for n in shape), np.dtype(dtype)
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise ScanError(f"{path}: the header gives the sizes {self.shape[::-1]}, expected three above 0; export it again")
        self._check(path.stat().st_size)

    def _check(self, size: int) -> None:
        expected = self.offset + _size(self.shape) * self.dtype.itemsize
        if size < expected:
            raise ScanError(f"{self.path}: the file was cut short: {size} bytes, expected {expected}; copy or export it again")

    def read(self, low: int, high: int) -> np.ndarray:
        plane = self.shape[1] * self.shape[2]
        with self.path.open("rb") as file:
            file.seek(self.offset + low * plane * self.dtype.itemsize)
            values = np.fromfile(file, self.dtype, (high - low) * plane)
        if len(values) != (high - low) * plane:
            raise ScanError(f"{self.path}: the file ends before slice {high}; copy or export it again")
        return values.reshape(high - low, *self.shape[1:])


class PackedFile(FlatFile):
    """A gzip or zlib stream, unpacked once to a temporary file that goes when the source does.

    start: the byte of the file at which the stream starts. offset: the byte of the unpacked stream at which values start.
    """

    def __init__(self, path: Path, offset: int, shape, dtype: np.dtype, start: int = 0) -> None:
        self._packed, self._start = path, start
        self._ready = False
        super().__init__(path, offset, shape, dtype)

    def _check(self, size: int) -> None:
        if self._ready:
            super()._check(size)

    def prepare(self, progress: Progress = silent) -> None:
        if self._ready:
            return
        handle, name = tempfile.mkstemp(prefix="ct2hair-", suffix=".unpacked")
        finalizer = weakref.finalize(self, _remove, name)
        total = self._packed.stat().st_size
        try:
            with os.fdopen(handle, "wb") as out, self._packed.open("rb") as file:
                file.seek(self._start)
                unpack = zlib.decompressobj(32 + zlib.MAX_WBITS)
                while chunk := file.read(CHUNK):
                    while chunk:
                        if unpack.eof:
                            if not chunk.strip(b"\0"):
                                break
                            unpack = zlib.decompressobj(32 + zlib.MAX_WBITS)
                        # at most 16 chunks at a time, so that a bomb fills no memory and cancelling stays quick
                        out.write(unpack.decompress(chunk, 16 * CHUNK))
                        chunk = unpack.unused_data if unpack.eof else unpack.unconsumed_tail
                        if out.tell() > self.offset + _size(self.shape) * self.dtype.itemsize + 16 * CHUNK:
                            raise ScanError(f"{self._packed}: more data than its header says; export it again")
                    progress(file.tell(), total)
                if not unpack.eof:
                    raise ScanError(f"{self._packed}: the compressed data end too early, the file was cut short; copy it again")
        except zlib.error as error:
            finalizer()
            raise ScanError(f"{self._packed}: the compressed data are damaged ({error}); copy or export it again") from error
        except BaseException:
            finalizer()
            raise
        self._close = finalizer
        self.path = Path(name)
        self._ready = True
        size = self.path.stat().st_size
        expected = self.offset + _size(self.shape) * self.dtype.itemsize
        if size < expected:
            self.close()
            raise ScanError(f"{self._packed}: {size} bytes unpacked, expected {expected}; copy or export it again")

    def read(self, low: int, high: int) -> np.ndarray:
        self.prepare()
        return super().read(low, high)

    def close(self) -> None:
        if self._ready:
            self._close()
            self._ready = False
            self.path = self._packed


def _remove(name: str) -> None:
    Path(name).unlink(missing_ok=True)


def _size(shape) -> int:
    total = 1
    for n in shape:
        total *= int(n)
    return total


class FileArray(Source):
    """An array in memory: what can't be read by slabs."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.dtype = values, values.shape, values.dtype

    def read(self, low: int, high: int) -> np.ndarray:
        return self.values[low:high]


class VdbGrid(Source):
    """An OpenVDB grid over the box of its active voxels; x is its slowest axis. low: (3,) the box's first index."""

    def __init__(self, grid) -> None:
        first, last = (np.array(corner, np.int64) for corner in grid.evalActiveVoxelBoundingBox())
        self._grid, self.low = grid, first
        self.shape = tuple(int(n) for n in last + 1 - first)
        self.dtype = np.dtype(np.float64 if grid.valueTypeName == "double" else np.float32)

    def read(self, low: int, high: int) -> np.ndarray:
        values = np.empty((high - low, *self.shape[1:]), self.dtype)
        if high > low:
            self._grid.copyToArray(values, ijk=(int(self.low[0]) + low, int(self.low[1]), int(self.low[2])))
        return values


class TiffPages(Source):
    """The pages of a multi-page TIFF whose data are compressed or scattered."""

    def __init__(self, path: Path, file, shape, dtype: np.dtype) -> None:
        self.path, self._file, self.shape, self.dtype = path, file, tuple(shape), np.dtype(dtype)

    def read(self, low: int, high: int) -> np.ndarray:
        if high <= low:
            return np.empty((0, *self.shape[1:]), self.dtype)
        try:
            values = self._file.asarray(key=slice(low, high), series=0)
        except Exception as error:  # tifffile and its codecs raise of every kind
            raise ScanError(
                f"{self.path}: pages {low + 1} to {high} can't be decoded ({error}); save it uncompressed"
            ) from error
        return values.reshape(high - low, *self.shape[1:])

    def close(self) -> None:
        self._file.close()


class TiffFiles(Source):
    """A folder of single-page TIFFs, one a slice."""

    def __init__(self, files: list[Path], shape, dtype: np.dtype) -> None:
        self._files, self.shape, self.dtype = files, tuple(shape), np.dtype(dtype)

    def read(self, low: int, high: int) -> np.ndarray:
        import tifffile

        values = np.empty((high - low, *self.shape[1:]), self.dtype.newbyteorder("="))
        for n, file in enumerate(self._files[low:high]):
            try:
                values[n] = tifffile.imread(file)
            except Exception as error:
                raise ScanError(f"{file}: can't be decoded ({error}); save it uncompressed") from error
        return values


class DicomSlices(Source):
    """DICOM slices in the order of their positions; slope and intercept are applied slice by slice."""

    def __init__(self, files: list[Path], shape, dtype: np.dtype) -> None:
        self._files, self.shape, self.dtype = files, tuple(shape), np.dtype(dtype)

    def read(self, low: int, high: int) -> np.ndarray:
        import SimpleITK as sitk

        values = np.empty((high - low, *self.shape[1:]), np.float32)
        for n, file in enumerate(self._files[low:high]):
            try:
                # the image must outlive the view of its memory
                image = sitk.ReadImage(str(file))
                values[n] = sitk.GetArrayViewFromImage(image).reshape(self.shape[1:])
            except (RuntimeError, ValueError) as error:
                reason = str(error).strip().splitlines()[-1]
                raise ScanError(f"{file}: this slice can't be read, it may be cut short ({reason}); copy it again") from None
        return values
