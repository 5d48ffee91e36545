"""Writes a scan slab by slab in any format that `open_scan` reads: what synthesis puts its volumes through (supplement 3)."""

from __future__ import annotations

import gzip
import os
import struct
import types
from pathlib import Path

import numpy as np

from ..errors import ScanError
from .openvdb_module import openvdb
from .vdb import linear_transform, write_grids

FORMATS = (".vdb", ".npy", ".raw", ".tif", ".tiff", ".nii", ".nii.gz", ".nrrd", ".mha", ".mhd")
BIG_TIFF = 2**31
"""Bytes from which a TIFF is written as BigTIFF: a plain one ends at 4 GiB, some readers at 2."""

_NIFTI_TYPES = {"u1": 2, "i2": 4, "i4": 8, "f4": 16, "f8": 64, "i1": 256, "u2": 512, "u4": 768}
_META_TYPES = {
    "u1": "MET_UCHAR",
    "i1": "MET_CHAR",
    "u2": "MET_USHORT",
    "i2": "MET_SHORT",
    "u4": "MET_UINT",
    "i4": "MET_INT",
    "f4": "MET_FLOAT",
    "f8": "MET_DOUBLE",
}
_NRRD_TYPES = {
    "u1": "uint8",
    "i1": "int8",
    "u2": "uint16",
    "i2": "int16",
    "u4": "uint32",
    "i4": "int32",
    "f4": "float",
    "f8": "double",
}


def scan_format(path: str | os.PathLike) -> str:
    """The file ending that names the format, lower case, ".nii.gz" as a whole."""
    name = Path(path).name.lower()
    return ".nii.gz" if name.endswith(".nii.gz") else Path(name).suffix


class ScanWriter:
    """A scan being written by slabs along z, beside its target and renamed by `close`: never half a file.

    path: the ending picks the format (see FORMATS). shape: (nx, ny, nz). spacing: mm, a number or three. origin: (3,) mm,
    the centre of voxel (0, 0, 0). dtype: of the file; values are rounded and clipped to it where it is an integer.
    Medical formats hold the LPS frame as it is; .npy is a Fortran-ordered array [x, y, z]; .raw is x fastest with nothing
    but the values; a TIFF's pages are z, rows y, columns x (ImageJ's header has spacing and origin). A .vdb takes the whole
    grid in memory, float, with 0 left out. Use it in a `with` block, which drops the file where something fails. Raises
    ScanError.
    """

    def __init__(self, path, shape, spacing, origin=(0.0, 0.0, 0.0), dtype=np.uint16) -> None:
        self.path = Path(path)
        self.shape = tuple(int(n) for n in shape)
        self.spacing = np.broadcast_to(np.asarray(spacing, np.float64), (3,)).copy()
        self.origin = np.asarray(origin, np.float64).reshape(3)
        self.dtype = np.dtype(dtype).newbyteorder("<")
        self.format = scan_format(path)
        if self.format not in FORMATS:
            raise ScanError(f"{path}: scans can't be written as '{self.format}'; choose one of {', '.join(FORMATS)}")
        if self.dtype.str[1:] not in _NIFTI_TYPES:
            raise ScanError(f"{path}: values of type {self.dtype} can't be written; choose uint8, uint16, int16 or float32")
        if len(self.shape) != 3 or min(self.shape) < 1 or (self.spacing <= 0).any():
            raise ScanError(f"{path}: a scan needs three sizes and a spacing above 0, got {self.shape}, {self.spacing}")
        self._next = 0
        self._beside = self.path.with_name(f".{self.path.name}.part{self.path.suffix}")
        self._file = self._tiff = self._grid = None
        try:
            self._open()
        except OSError as error:
            raise ScanError(f"{path}: can't be written ({error.strerror or error}); check the folder") from error

    def write_slab(self, z0: int, slab: np.ndarray) -> None:
        """Append the slices [z0, z0 + n) as an array (nx, ny, n); slabs come in order, without gaps."""
        if z0 != self._next or slab.shape[:2] != self.shape[:2] or z0 + slab.shape[2] > self.shape[2]:
            raise ValueError(f"expected a slab {self.shape[:2]} from z = {self._next} on, got {slab.shape} at {z0}")
        if self.dtype.kind in "iu" and slab.dtype != self.dtype:
            info = np.iinfo(self.dtype)
            slab = np.clip(np.rint(slab) if slab.dtype.kind == "f" else slab, info.min, info.max)
        try:
            if self._grid is not None:
                values = np.ascontiguousarray(slab, np.float32)
                self._grid.copyFromArray(values, ijk=(0, 0, int(z0)), tolerance=0.0)
            else:
                pages = np.ascontiguousarray(slab.transpose(2, 1, 0), self.dtype)
                if self._tiff is not None:
                    for n, page in enumerate(pages, start=z0):
                        self._write_page(page, first=n == 0)
                else:
                    self._file.write(memoryview(pages).cast("B"))
        except OSError as error:
            raise ScanError(f"{self.path}: writing failed ({error.strerror or error}); check the space left") from error
        self._next += slab.shape[2]

    def close(self) -> None:
        """Finish the file and give it its name. Raises ScanError where slices are missing."""
        if self._next != self.shape[2]:
            missing = f"{self.path}: only {self._next} of {self.shape[2]} slices were written"
            self.abort()
            raise ScanError(missing)
        if self._grid is not None:
            write_grids(self.path, [self._grid])
            self._grid = None
            return
        self._release()
        if self.format == ".mhd":
            self._beside.replace(self.path.with_suffix(".raw"))
            self._beside.write_text(self._meta_header(self.path.with_suffix(".raw").name), encoding="utf-8")
        self._beside.replace(self.path)

    def abort(self) -> None:
        """Drop what was written."""
        self._release()
        self._beside.unlink(missing_ok=True)

    def __enter__(self) -> ScanWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None):
        if kind is None:
            self.close()
        else:
            self.abort()

    def _release(self) -> None:
        for handle in (self._file, self._tiff):
            if handle is not None:
                handle.close()
        self._file = self._tiff = self._grid = None

    def _open(self) -> None:
        if self.format == ".vdb":
            vdb = openvdb()
            self._grid = vdb.FloatGrid(0.0)
            self._grid.name = "density"
            self._grid.transform = linear_transform(vdb, self.spacing, self.origin)
        elif self.format in (".tif", ".tiff"):
            import tifffile

            size = int(np.prod(self.shape, dtype=np.int64)) * self.dtype.itemsize
            self._tiff = tifffile.TiffWriter(self._beside, bigtiff=size > BIG_TIFF)
        elif self.format == ".nii.gz":
            self._file = gzip.GzipFile(self._beside, "wb", compresslevel=1, mtime=0)
            self._file.write(self._nifti_header())
        else:
            self._file = self._beside.open("wb")
            if self.format == ".npy":
                header = {"descr": self.dtype.str, "fortran_order": True, "shape": self.shape}
                np.lib.format.write_array_header_1_0(self._file, header)
            elif self.format == ".nii":
                self._file.write(self._nifti_header())
            elif self.format == ".nrrd":
                self._file.write(self._nrrd_header().encode())
            elif self.format == ".mha":
                self._file.write(self._meta_header("LOCAL").encode())

    def _write_page(self, page: np.ndarray, first: bool) -> None:
        description = None
        if first:
            corner = (f"{axis}origin={-o / s:.12g}" for axis, o, s in zip("xyz", self.origin, self.spacing, strict=True))
            lines = ("ImageJ=1.54f", f"images={self.shape[2]}", f"slices={self.shape[2]}", "unit=mm")
            lines += (f"spacing={self.spacing[2]:.9g}", "loop=false", *corner, "")
            description = "\n".join(lines)
        per_mm = tuple(1.0 / s for s in self.spacing[:2])
        self._tiff.write(
            page, photometric="minisblack", metadata=None, description=description, resolution=per_mm, resolutionunit=1
        )

    def _nifti_header(self) -> bytes:
        """NIfTI-1, single file, sform and no qform; NIfTI's world is RAS, so LPS x and y change sign."""
        header = bytearray(352)
        struct.pack_into("<i", header, 0, 348)
        struct.pack_into("<8h", header, 40, 3, *self.shape, 1, 1, 1, 1)
        struct.pack_into("<hh", header, 70, _NIFTI_TYPES[self.dtype.str[1:]], self.dtype.itemsize * 8)
        struct.pack_into("<8f", header, 76, 1.0, *self.spacing, 0, 0, 0, 0)
        struct.pack_into("<fff", header, 108, 352.0, 1.0, 0.0)
        header[123] = 2  # mm
        struct.pack_into("<hh", header, 252, 0, 1)
        (sx, sy, sz), (ox, oy, oz) = self.spacing, self.origin
        struct.pack_into("<12f", header, 280, -sx, 0, 0, -ox, 0, -sy, 0, -oy, 0, 0, sz, oz)
        header[344:348] = b"n+1\0"
        return bytes(header)

    def _nrrd_header(self) -> str:
        axes = " ".join("(" + ",".join(f"{x:.12g}" for x in row) + ")" for row in np.diag(self.spacing))
        return (
            f"NRRD0004\ntype: {_NRRD_TYPES[self.dtype.str[1:]]}\ndimension: 3\nspace: left-posterior-superior\n"
            f"sizes: {' '.join(map(str, self.shape))}\nspace directions: {axes}\nkinds: domain domain domain\n"
            f"endian: little\nencoding: raw\nspace origin: ({','.join(f'{x:.12g}' for x in self.origin)})\n\n"
        )

    def _meta_header(self, data: str) -> str:
        return (
            "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n"
            "TransformMatrix = 1 0 0 0 1 0 0 0 1\n"
            f"Offset = {' '.join(f'{x:.12g}' for x in self.origin)}\nCenterOfRotation = 0 0 0\n"
            f"ElementSpacing = {' '.join(f'{x:.12g}' for x in self.spacing)}\n"
            f"DimSize = {' '.join(map(str, self.shape))}\nElementType = {_META_TYPES[self.dtype.str[1:]]}\n"
            f"ElementDataFile = {data}\n"
        )


def write_scan(path, array: np.ndarray, spacing, origin=(0.0, 0.0, 0.0), dtype=np.uint16) -> None:
    """Write a dense array [x, y, z] as a scan in one go. Raises ScanError."""
    with ScanWriter(path, array.shape, spacing, origin, dtype) as writer:
        writer.write_slab(0, array)
