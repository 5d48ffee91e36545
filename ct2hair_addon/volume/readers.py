"""Opens a CT scan of any usual format and reads it by slabs, in the scan frame (paper 3.1).

Formats: OpenVDB, .npy, raw with a shape, multi-page TIFF and BigTIFF, a folder of TIFF slices, NIfTI, NRRD, MetaImage, DICOM.
"""

from __future__ import annotations

import os
import re
import threading
import types
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import ScanError
from ..progress import Progress, silent
from ..settings import ScanSettings
from .sources import DicomSlices, FileArray, FlatFile, PackedFile, Source, TiffFiles, TiffPages, VdbGrid
from .vdb import grid_geometry, read_grid
from .writers import scan_format

MAX_TILT = 5.0
"""Degrees that a scan's axes may be off x, y and z: less is snapped with a warning, more is refused."""

READ_BYTES = 64 * 2**20
"""About what is read at once where a slab has to be gathered across the file's own order."""

AS_FOUND = ScanSettings()
"""Everything taken from the file or found."""

KNOWN = ".vdb, .npy, .raw, .tif(f), .nii(.gz), .nrrd/.nhdr, .mha/.mhd, .dcm, or a folder of DICOM or TIFF slices"

_NUMPY_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
_ALIASES = {"u8": "uint8", "u16": "uint16", "i16": "int16", "f32": "float32", "float": "float32", "ushort": "uint16"}
_NIFTI_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
_NRRD_TYPES = {
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i1": ("signed char", "int8", "int8_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_META_TYPES = {
    "MET_UCHAR": "u1",
    "MET_CHAR": "i1",
    "MET_USHORT": "u2",
    "MET_SHORT": "i2",
    "MET_UINT": "u4",
    "MET_INT": "i4",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
_MM = {"m": 1000.0, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "nm": 1e-6}
_MM |= {"meter": 1000.0, "centimeter": 10.0, "millimeter": 1.0, "micrometer": 1e-3, "micron": 1e-3, "nanometer": 1e-6}
_MM |= {"inch": 25.4, "in": 25.4, "\\u00b5m": 1e-3, "\\u00B5m": 1e-3}


@dataclass(frozen=True)
class _Layout:
    """How a file's array lies in the world: its axes slow, mid, fast by index (2, 1, 0 where x is fastest), and per
    file axis i, j, k (ITK's order) the spacing (mm, 0 where unknown), direction cosines (columns) and origin."""

    source: Source
    axes: tuple[int, int, int] = (2, 1, 0)
    spacing: tuple[float, ...] = (0.0, 0.0, 0.0)
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    direction: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: tuple[float, float] = (1.0, 0.0)
    warnings: tuple[str, ...] = ()


class ScanReader:
    """An open scan. The frame: the centre of voxel (i, j, k) is `origin + (i, j, k) * spacing`, mm, LPS for medical files.

    shape: (nx, ny, nz). spacing, origin: (3,) float64, mm. dtype: of the values in the file. name: the file's.
    warnings: what was assumed or mended, in plain sentences. order: the scan axes by which the file is stored, slowest
    first, (2, 1, 0) where z is slowest: `native` reads along order[0], which is the quick way through the file.
    """

    def __init__(self, path: Path, layout: _Layout, settings: ScanSettings) -> None:
        self.path = path
        self.name = path.name
        self.dtype = layout.source.dtype
        self.warnings = list(layout.warnings)
        self.not_numbers = 0
        self._source = layout.source
        self._slope, self._intercept = layout.scale
        self._lock = threading.Lock()
        self._air: float | None = None
        count = np.array([layout.source.shape[layout.axes.index(axis)] for axis in range(3)], np.int64)
        if count.min() < 1:
            raise ScanError(f"{path}: the scan is empty, {_times(count)} voxels; export it again")
        spacing = np.array([float(f"{s:.7g}") for s in layout.spacing])
        if settings.spacing > 0.0:
            if spacing.all() and np.abs(spacing / settings.spacing - 1.0).max() > 0.01:
                self.warnings.append(
                    f"the file says {_times(spacing)} mm a voxel, the setting {settings.spacing:g} mm is taken"
                )
            spacing[:] = settings.spacing
        if not (spacing > 0.0).all() or not np.isfinite(spacing).all():
            raise ScanError(f"{path}: the file doesn't say how large a voxel is; give the spacing in mm (setting scan.spacing)")
        target, sign, direction = self._snapped(layout.direction)
        centre = np.array(layout.origin, np.float64) + layout.direction @ (spacing * (count - 1) / 2.0)
        first = centre - direction @ (spacing * (count - 1) / 2.0)
        last = first + direction @ (spacing * (count - 1))
        self.order = tuple(int(target[axis]) for axis in layout.axes)
        self._flip = tuple(slice(None, None, -1) if sign[axis] < 0 else slice(None) for axis in layout.axes)
        self.shape = tuple(int(n) for n in count[np.argsort(target)])
        self.spacing = spacing[np.argsort(target)]
        self.origin = np.minimum(first, last)

    def _snapped(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per file axis the scan axis it lies along, its sign, and the matrix of both; ScanError where it is too oblique."""
        target = np.abs(direction).argmax(axis=0)
        cosines = np.abs(direction[target, np.arange(3)]) / np.linalg.norm(direction, axis=0)
        tilt = float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())
        if tilt > MAX_TILT or len(set(target.tolist())) < 3 or not np.isfinite(tilt):
            raise ScanError(
                f"{self.path}: the scan lies {tilt:.1f} degrees off the x, y and z axes, at most {MAX_TILT:g} can be taken; "
                "resample it along the axes (or write it without its orientation)"
            )
        sign = np.sign(direction[target, np.arange(3)])
        if tilt > 0.05:
            self.warnings.append(f"the scan lies {tilt:.1f} degrees off the x, y and z axes and is taken as lying along them")
        snapped = np.zeros((3, 3))
        snapped[target, np.arange(3)] = sign
        return target, sign, snapped

    def prepare(self, progress: Progress = silent) -> None:
        """Unpack a compressed file to a temporary one, which later reads go to; nothing to do for others."""
        self._source.prepare(progress)

    def native(self, low: int, high: int) -> np.ndarray:
        """float32 (high - low, mid, fast): the slices [low, high) along `order[0]`, axes as `order`; contiguous.

        Slope and intercept are applied; what is no number (NaN, infinite) becomes air and is counted in `not_numbers`.
        """
        values = self._raw(low, high)
        if self.dtype.kind == "f":
            with np.errstate(invalid="ignore"):  # infinities of both signs
                total = float(values.sum(dtype=np.float64))
            if not np.isfinite(total):
                bad = ~np.isfinite(values)
                found = int(np.count_nonzero(bad))
                if found:
                    self.not_numbers += found
                    values[bad] = self._air_value()
        return values

    def _raw(self, low: int, high: int) -> np.ndarray:
        size = self._source.shape[0]
        if not 0 <= low <= high <= size:
            raise ValueError(f"slices {low} to {high} are not within the {size} of the scan")
        backward = self._flip[0].step == -1
        first, last = (size - high, size - low) if backward else (low, high)
        with self._lock:
            values = self._source.read(first, last)
        out = np.empty(values.shape, np.float32)
        np.copyto(out, values[self._flip], casting="unsafe")
        if (self._slope, self._intercept) != (1.0, 0.0):
            out *= np.float32(self._slope)
            out += np.float32(self._intercept)
        return out

    def _air_value(self) -> float:
        """The most common value of some slices: what stands in for NaN."""
        if self._air is None:
            size = self._source.shape[0]
            some = np.concatenate(
                [self._raw(n, n + 1).ravel()[::7] for n in np.unique(np.linspace(0, size - 1, 9).astype(int))]
            )
            some = some[np.isfinite(some)]
            if not len(some):
                raise ScanError(f"{self.path}: the scan holds no numbers (NaN only); export it again")
            low, high = np.percentile(some, [0.5, 99.5])
            counts, edges = np.histogram(some, 256, (low, high if high > low else low + 1.0))
            near = counts.argmax()
            inside = some[(some >= edges[near]) & (some <= edges[near + 1])]
            self._air = float(np.median(inside))
            self.warnings.append(f"some voxels hold no number (NaN or infinite); they are taken as air, {self._air:g}")
        return self._air

    def slab(self, low: int, high: int) -> np.ndarray:
        """float32 (nx, ny, high - low): the slices [low, high) along z, indexed [x, y, z]."""
        back = tuple(int(n) for n in np.argsort(self.order))
        if self.order[0] == 2:
            return self.native(low, high).transpose(back)
        if not 0 <= low <= high <= self.shape[2]:
            raise ValueError(f"slices {low} to {high} are not within the {self.shape[2]} of the scan")
        out = np.empty((*self.shape[:2], high - low), np.float32)
        slow, size = self.order[0], self.shape[self.order[0]]
        step = max(1, READ_BYTES // (4 * int(np.prod(self.shape)) // size))
        for start in range(0, size, step):
            stop = min(start + step, size)
            where = [slice(None)] * 3
            where[slow] = slice(start, stop)
            out[tuple(where)] = self.native(start, stop).transpose(back)[:, :, low:high]
        return out

    def close(self) -> None:
        """Let go of the file and of anything unpacked."""
        self._source.close()

    def __enter__(self) -> ScanReader:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: types.TracebackType | None) -> None:
        self.close()


def open_scan(
    path: str | os.PathLike, settings: ScanSettings = AS_FOUND, shape=None, dtype: str | np.dtype | None = None
) -> ScanReader:
    """Open a scan for reading by slabs.

    path: a file or a folder of slices. settings: `spacing` overrules the file's, `raw_shape` and `raw_type` describe a raw
    file. shape: (nx, ny, nz) and dtype of a raw file, before the settings, which come before its name
    (`wig_512x512x300_uint16.raw`); x is fastest. A bare array (.npy, .vdb) is indexed [x, y, z]; the pages of a TIFF are z,
    rows y, columns x. Medical files come in ITK's LPS world, their axes turned so that all spacings are positive.

    Raises ScanError: missing, truncated, of mixed sizes, of several channels, oblique by more than 5 degrees, without a
    spacing, empty or unknown.
    """
    path = Path(path)
    try:
        if path.is_dir():
            layout = _open_folder(path)
        elif not path.exists():
            raise ScanError(f"{path}: there is no such file or folder")
        elif path.stat().st_size == 0:
            raise ScanError(f"{path}: the file is empty; export or copy it again")
        else:
            kind = scan_format(path)
            if kind in (".raw", ".bin", ".img", ".dat") or (shape is not None and kind not in _OPENERS):
                layout = _open_raw(path, settings, shape, dtype)
            elif kind in _OPENERS:
                layout = _OPENERS[kind](path)
            elif _is_dicom(path):
                layout = _open_dicom(path.parent, path)
            else:
                raise ScanError(f"{path}: '{kind}' is not a format that can be read; there are {KNOWN}")
        return ScanReader(path, layout, settings)
    except OSError as error:
        raise ScanError(f"{path}: can't be read ({error.strerror or error}); check the file and your rights on it") from error


def _times(values) -> str:
    return " x ".join(f"{value:g}" for value in values)


def _open_vdb(path: Path) -> _Layout:
    grid = read_grid(path)
    spacing, origin = grid_geometry(path, grid)
    if not grid.activeVoxelCount():
        raise ScanError(f"{path}: grid '{grid.name}' is empty; export it again")
    source = VdbGrid(grid)
    return _Layout(source, (0, 1, 2), tuple(spacing), tuple(origin + source.low * spacing))


def _open_npy(path: Path) -> _Layout:
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, dtype = read(file)
            offset = file.tell()
    except ValueError as error:
        raise ScanError(f"{path}: not a .npy array ({error}); save it with numpy.save") from error
    if len(shape) != 3:
        several = " (several channels or times?)" if len(shape) > 3 else ""
        raise ScanError(f"{path}: an array of {len(shape)} axes {shape}{several}, expected three, [x, y, z]")
    axes = (2, 1, 0) if fortran else (0, 1, 2)
    source = FlatFile(path, offset, tuple(shape[axis] for axis in axes), _number_type(path, dtype))
    return _Layout(source, axes)


def _number_type(path: Path, dtype) -> np.dtype:
    dtype = np.dtype(dtype)
    if dtype.kind not in "iufb" or dtype.itemsize > 8:
        raise ScanError(f"{path}: values of type {dtype} are no densities; save it as uint16, int16 or float32")
    return np.dtype(np.uint8) if dtype.kind == "b" else dtype


def _raw_type(path: Path, text) -> np.dtype:
    if not isinstance(text, str):
        return _number_type(path, text)
    name = text.lower().strip()
    big = name.endswith(("be", "_big"))
    name = name.removesuffix("_big").removesuffix("be").removesuffix("le").rstrip("_-")
    try:
        dtype = _number_type(path, _ALIASES.get(name, name))
    except TypeError:
        raise ScanError(f"{path}: '{text}' is no type of number; choose one of {', '.join(_NUMPY_TYPES)}") from None
    return dtype.newbyteorder(">") if big else dtype


def _open_raw(path: Path, settings: ScanSettings, shape, dtype) -> _Layout:
    name = path.name.lower()
    warnings: tuple[str, ...] = ()
    if shape is None:
        found = re.search(r"(\d+)\s*[x, ]\s*(\d+)\s*[x, ]\s*(\d+)", settings.raw_shape.lower())
        if settings.raw_shape and not found:
            raise ScanError(f"{path}: the setting raw_shape is '{settings.raw_shape}', expected voxels as 512x512x300")
        found = found or re.search(r"(\d+)x(\d+)x(\d+)", name)
        if not found:
            raise ScanError(
                f"{path}: a raw file doesn't say its size; give the voxels along x, y, z (setting scan.raw_shape), "
                "or name it like wig_512x512x300_uint16.raw"
            )
        shape = tuple(int(n) for n in found.groups())
    shape = tuple(int(n) for n in shape)
    if len(shape) != 3 or min(shape) < 1:
        raise ScanError(f"{path}: the shape {shape} is not three sizes above 0, expected (nx, ny, nz)")
    size, voxels = path.stat().st_size, int(np.prod(shape, dtype=object))
    if dtype is None and settings.raw_type:
        dtype = settings.raw_type
    if dtype is None:
        words = "|".join(sorted((*_NUMPY_TYPES, *_ALIASES), key=len, reverse=True))
        found = re.search(rf"(?<![a-z0-9])({words})_?(be|le)?(?![a-z0-9])", name)
        dtype = "".join(group or "" for group in found.groups()) if found else None
    if dtype is None:
        dtype = {1: "uint8", 2: "uint16", 4: "float32"}.get(size // voxels if size % voxels == 0 else 0)
        if dtype is None:
            raise ScanError(f"{path}: {size} bytes are no whole number of bytes for {_times(shape)} voxels; check the shape")
        warnings = (f"the raw file doesn't say its type, its size fits {dtype}, which is taken",)
    dtype = _raw_type(path, dtype)
    expected = voxels * dtype.itemsize
    if size != expected:
        what = "cut short, or the shape or type is wrong" if size < expected else "longer than that: has it a header?"
        raise ScanError(f"{path}: {size} bytes, but {_times(shape)} voxels of {dtype} take {expected}; the file is {what}")
    return _Layout(FlatFile(path, 0, shape[::-1], dtype), warnings=warnings)


def _sitk_header(path: Path):
    """What SimpleITK says of a file without reading its voxels."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise ScanError(f"{path}: not readable, damaged or not what its name says ({reason}); export it again") from None
    return reader


def _medical(path: Path, source: Source | None, header, unit: float = 1.0, **more) -> _Layout:
    """The layout of an ITK-readable file; without a source its voxels are read whole by SimpleITK."""
    size = list(header.GetSize())
    if header.GetNumberOfComponents() > 1 or (len(size) > 3 and max(size[3:]) > 1):
        times = max(header.GetNumberOfComponents(), *size[3:], 1)
        raise ScanError(f"{path}: {times} channels or times a voxel, expected one; export a single density volume")
    if len(size) < 3 or min(size[:3]) < 2:
        raise ScanError(f"{path}: {_times(size)} voxels are no volume; open the folder of all its slices")
    n = len(size)
    direction = np.array(header.GetDirection()).reshape(n, n)[:3, :3]
    spacing, origin = (np.array(values[:3]) * unit for values in (header.GetSpacing(), header.GetOrigin()))
    warnings = ()
    if source is None:
        import SimpleITK as sitk

        try:
            image = header.Execute()
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ScanError(f"{path}: the voxels can't be read, the file may be cut short ({reason})") from None
        values = sitk.GetArrayFromImage(image)
        source = FileArray(values.reshape(values.shape[-3:]))
        warnings = ("the file's encoding can't be read by slabs; it was read whole",)
    elif source.shape != tuple(size[2::-1]):
        raise ScanError(f"{path}: header and data disagree, {_times(source.shape[::-1])} and {_times(size[:3])} voxels")
    if not more.pop("has_spacing", True):
        spacing = np.zeros(3)
    return _Layout(source, (2, 1, 0), tuple(spacing), tuple(origin), direction, warnings=warnings, **more)


def _open_nifti(path: Path) -> _Layout:
    import gzip

    packed = path.name.lower().endswith(".gz")
    try:
        with gzip.open(path) if packed else path.open("rb") as file:
            head = file.read(544)
    except (EOFError, gzip.BadGzipFile) as error:
        raise ScanError(f"{path}: not a whole gzip file ({error}); copy it again") from None
    one = {head[:4] == np.array(348, e + "i4").tobytes(): e for e in "<>"}.get(True)
    two = {head[:4] == np.array(540, e + "i4").tobytes(): e for e in "<>"}.get(True)
    end = one or two
    if end is None or len(head) < 348:
        raise ScanError(f"{path}: not a NIfTI file (its header doesn't say 348 or 540); check what it is")

    def number(kind: str, at: int, count: int = 1) -> np.ndarray:
        return np.frombuffer(head, end + kind, count, at)

    dim = number("i2", 40, 8) if one else number("i8", 16, 8)
    code = int(number("i2", 70 if one else 12)[0])
    offset = int(number("f4", 108)[0]) if one else int(number("i8", 168)[0])
    slope, intercept = (number("f4", 112, 2) if one else number("f8", 176, 2)).astype(float)
    pixdim = (number("f4", 76, 8) if one else number("f8", 104, 8))[1:4]
    if dim[0] < 3 or (dim[0] > 3 and (dim[4 : dim[0] + 1] > 1).any()):
        sizes = dim[1 : max(1, min(int(dim[0]), 7)) + 1]
        raise ScanError(f"{path}: {_times(sizes)} values, expected one volume of x, y and z (several channels or times?)")
    if code not in _NIFTI_TYPES:
        raise ScanError(f"{path}: NIfTI values of type {code} (colour or complex?) are no densities; export it as int16")
    shape = tuple(int(n) for n in dim[3:0:-1])
    dtype = np.dtype(end + _NIFTI_TYPES[code])
    source = (PackedFile if packed else FlatFile)(path, offset, shape, dtype)
    scaled = slope not in (0.0, 1.0) or (slope == 1.0 and intercept != 0.0)
    scale = (slope, intercept) if scaled and np.isfinite([slope, intercept]).all() else (1.0, 0.0)
    return _medical(path, source, _sitk_header(path), scale=scale, has_spacing=bool((pixdim > 0).all()))


def _open_nrrd(path: Path) -> _Layout:
    with path.open("rb") as file:
        fields: dict[str, str] = {}
        magic = file.readline(64)
        if not magic.startswith(b"NRRD"):
            raise ScanError(f"{path}: not an NRRD file; check what it is")
        for _ in range(1000):
            line = file.readline(65536)
            text = line.decode("utf-8", "replace").strip()
            if not line or not text:
                break
            key, colon, value = text.partition(":")
            if not text.startswith("#") and colon and not value.startswith("="):
                fields[key.strip().lower()] = value.strip()
        offset = file.tell()
    data = fields.get("data file", fields.get("datafile"))
    listed = data is not None and (data.upper().startswith("LIST") or "%" in data)
    if data is not None and not listed and not (path.parent / data).is_file():
        raise ScanError(f"{path}: its data file {data} is missing; put it beside the header")
    header = _sitk_header(path)
    names = [n for n in (fields.get("space units", "") + " " + fields.get("units", "")).replace('"', " ").split() if n]
    units = {_MM[name.lower().rstrip("s")] for name in names if name.lower().rstrip("s") in _MM} | set()
    unit = units.pop() if len(units) == 1 else 1.0
    spaced = "space directions" in fields or "spacings" in fields
    kind = next((code for code, words in _NRRD_TYPES.items() if fields.get("type", "").lower() in words), None)
    encoding = fields.get("encoding", "raw").lower()
    skips = int(fields.get("line skip", fields.get("lineskip", 0))) or int(fields.get("byte skip", fields.get("byteskip", 0)))
    if fields.get("dimension") != "3" or kind is None or encoding not in ("raw", "gzip", "gz") or listed or skips:
        return _medical(path, None, header, unit, has_spacing=spaced)
    where, offset = (path, offset) if data is None else (path.parent / data, 0)
    end = ">" if fields.get("endian", "little").lower() == "big" else "<"
    shape = tuple(int(n) for n in fields.get("sizes", "").split())[::-1]
    if encoding == "raw":
        source: Source = FlatFile(where, offset, shape, np.dtype(end + kind))
    else:
        source = PackedFile(where, 0, shape, np.dtype(end + kind), start=offset)
    return _medical(path, source, header, unit, has_spacing=spaced)


def _open_meta(path: Path) -> _Layout:
    with path.open("rb") as file:
        fields: dict[str, str] = {}
        for _ in range(1000):
            line = file.readline(65536)
            key, equals, value = line.decode("utf-8", "replace").partition("=")
            if not line or not equals:
                break
            fields[key.strip().lower()] = value.strip()
            if key.strip().lower() == "elementdatafile":
                break
        offset = file.tell()
    if "dimsize" not in fields or "elementdatafile" not in fields:
        raise ScanError(f"{path}: not a MetaImage header (DimSize or ElementDataFile is missing); check what it is")
    data = fields["elementdatafile"]
    local = data.upper() == "LOCAL"
    where = path if local else path.parent / data
    listed = data.upper().startswith("LIST") or "%" in data
    if not local and not listed and not where.is_file():
        raise ScanError(f"{path}: its data file {data} is missing; put it beside the header")
    header = _sitk_header(path)
    kind = _META_TYPES.get(fields.get("elementtype", ""))
    spaced = "elementspacing" in fields or "elementsize" in fields
    plain = fields.get("binarydata", "true").lower() == "true" and fields.get("headersize", "0") in ("0", "")
    if listed or kind is None or not plain or fields.get("ndims") != "3":
        return _medical(path, None, header, has_spacing=spaced)
    msb = fields.get("binarydatabyteordermsb", fields.get("elementbyteordermsb", "false")).lower() == "true"
    dtype = np.dtype((">" if msb else "<") + kind)
    shape = tuple(int(n) for n in fields["dimsize"].split())[::-1]
    start = offset if local else 0
    if header.GetNumberOfComponents() > 1:
        return _medical(path, None, header)
    if fields.get("compresseddata", "false").lower() == "true":
        return _medical(path, PackedFile(where, 0, shape, dtype, start=start), header, has_spacing=spaced)
    return _medical(path, FlatFile(where, start, shape, dtype), header, has_spacing=spaced)


def _open_tiff(path: Path) -> _Layout:
    import tifffile

    try:
        file = tifffile.TiffFile(path)
        series = file.series
    except (tifffile.TiffFileError, ValueError, IndexError, KeyError) as error:
        raise ScanError(f"{path}: not a readable TIFF, damaged or cut short ({error}); export it again") from error
    try:
        if not series:
            raise ScanError(f"{path}: the TIFF holds no pages; export it again")
        sizes = [(size, axis) for size, axis in zip(series[0].shape, series[0].axes, strict=True) if size > 1]
        shape, axes = tuple(size for size, _ in sizes), "".join(axis for _, axis in sizes)
        if "S" in axes or "C" in axes:
            raise ScanError(f"{path}: {shape} with several channels a voxel ({axes}); export it in greys")
        if len(series) > 1 and len(shape) < 3:
            listed = ", ".join(_times(one.shape[::-1]) for one in series[:3])
            raise ScanError(f"{path}: pages of different sizes ({listed} ...); export slices of one size and type")
        if len(shape) < 3:
            raise ScanError(f"{path}: a single page {_times(shape[::-1])}; open the folder of all slices instead")
        if len(shape) > 3 or axes[1:] != "YX":
            raise ScanError(f"{path}: {shape} with axes {axes}, expected pages of rows and columns; export one volume")
        _check_tiff_pages(path, file)
        spacing, origin, warnings = _tiff_spacing(file, series[0])
        dtype = _number_type(path, series[0].dtype.newbyteorder(file.byteorder))
        if series[0].dataoffset is not None:
            source: Source = FlatFile(path, series[0].dataoffset, shape, dtype)
            file.close()
        else:
            source = TiffPages(path, file, shape, dtype)
        return _Layout(source, (2, 1, 0), spacing, origin, warnings=warnings)
    except ScanError:
        file.close()
        raise


def _check_tiff_pages(path: Path, file) -> None:
    size = path.stat().st_size
    for number, page in enumerate(file.pages):
        ends = [offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False)]
        if not ends or max(ends) > size:
            raise ScanError(f"{path}: page {number + 1} of {len(file.pages)} reaches past the file's end; it was cut short")


def _tiff_spacing(file, series) -> tuple[tuple[float, ...], tuple[float, ...], tuple[str, ...]]:
    """Spacing and origin in mm from OME, ImageJ or resolution tags; zeros where there is none to be trusted."""
    page = file.pages[0]
    if file.ome_metadata:
        sizes = []
        for axis in "XYZ":
            size = re.search(rf'PhysicalSize{axis}="([^"]+)"', file.ome_metadata)
            unit = re.search(rf'PhysicalSize{axis}Unit="([^"]+)"', file.ome_metadata)
            sizes.append(float(size[1]) * _MM.get(unit[1] if unit else "um", 0.0) if size else 0.0)
        if sizes[0] > 0 and sizes[1] > 0:
            return _with_depth(sizes)
    try:
        across, down = (float(r) for r in page.resolution)
    except (AttributeError, TypeError, ValueError, ZeroDivisionError):
        across = down = 0.0
    if file.imagej_metadata:
        meta = file.imagej_metadata
        unit = _MM.get(str(meta.get("unit", "")).lower().rstrip("s"), 0.0)
        if unit and across > 0 and down > 0:
            spacing = [unit / across, unit / down, unit * abs(float(meta.get("spacing", 0.0)))]
            corner = [float(meta.get(f"{axis}origin", 0.0)) for axis in "xyz"]
            spacing, _, warnings = _with_depth(spacing)
            return spacing, tuple(-c * s if c else 0.0 for c, s in zip(corner, spacing, strict=True)), warnings
    unit = {2: 25.4, 3: 10.0}.get(int(page.resolutionunit or 0), 0.0) if across > 0 and down > 0 else 0.0
    if unit and not (unit == 25.4 and across in (72.0, 96.0, 100.0, 150.0, 200.0, 300.0, 600.0)):
        return _with_depth([unit / across, unit / down, 0.0])
    return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), ()


def _with_depth(spacing) -> tuple[tuple[float, ...], tuple[float, ...], tuple[str, ...]]:
    if spacing[2] > 0:
        return tuple(spacing), (0.0, 0.0, 0.0), ()
    note = f"the TIFF doesn't say how far apart its pages are; {spacing[0]:g} mm is taken, as within a page"
    return (spacing[0], spacing[1], spacing[0]), (0.0, 0.0, 0.0), (note,)


def _open_folder(folder: Path) -> _Layout:
    files = sorted((file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")), key=_natural)
    pages = [file for file in files if scan_format(file) in (".tif", ".tiff")]
    if len(pages) > 1:
        return _open_tiff_folder(folder, pages)
    if any(_is_dicom(file) for file in files[:50]):
        return _open_dicom(folder)
    raise ScanError(f"{folder}: the folder holds no series of DICOM or TIFF slices; open the scan's own file ({KNOWN})")


def _natural(file: Path) -> list:
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"(\d+)", file.name.lower()) if part]


def _open_tiff_folder(folder: Path, files: list[Path]) -> _Layout:
    import tifffile

    first = None
    for file in files:
        try:
            with tifffile.TiffFile(file) as tiff:
                page = tiff.pages[0]
                what = (page.shape, page.dtype.newbyteorder(tiff.byteorder) if page.dtype is not None else None)
                if len(tiff.pages) != 1 or len(page.shape) != 2 or page.dtype is None:
                    raise ScanError(f"{file}: {len(tiff.pages)} pages of {page.shape}, expected one page in greys a slice")
                _check_tiff_pages(file, tiff)
                if first is None:
                    first = what
                    spacing, _, warnings = _tiff_spacing(tiff, None)
        except (tifffile.TiffFileError, OSError, ValueError) as error:
            raise ScanError(f"{file}: not a readable TIFF, damaged or cut short ({error}); export it again") from error
        if (what[0], what[1].newbyteorder("=")) != (first[0], first[1].newbyteorder("=")):
            raise ScanError(
                f"{file}: a slice of {_times(what[0][::-1])} {what[1]}, but {files[0].name} has {_times(first[0][::-1])} "
                f"{first[1]}; put slices of one scan only into the folder"
            )
    numbers = [[part for part in _natural(file) if part[0]] for file in files]
    steps = np.diff([row[-1][1] for row in numbers]) if all(numbers) else np.ones(1)
    if (steps > 1).any():
        gap = files[int(np.argmax(steps > 1))].name
        warnings += (f"the slices' numbers jump after {gap}: slices may be missing",)
    source = TiffFiles(files, (len(files), *first[0]), _number_type(folder, first[1]))
    return _Layout(source, (2, 1, 0), spacing, warnings=warnings)


def _is_dicom(path: Path) -> bool:
    if path.suffix.lower() in (".dcm", ".ima", ".dicom"):
        return True
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _open_dicom(folder: Path, one: Path | None = None) -> _Layout:
    """The slices of a DICOM series, in the order of their positions along the normal, whatever their names."""
    import SimpleITK as sitk

    if one is not None:
        header = _sitk_header(one)
        if len(header.GetSize()) == 3 and header.GetSize()[2] > 1:
            return _medical(one, None, header)
    series: dict[str, list] = {}
    for file in sorted(file for file in folder.iterdir() if file.is_file()):
        if not _is_dicom(file):
            continue
        header = _sitk_header(file)
        keys = set(header.GetMetaDataKeys())
        if "0020|0032" not in keys or "0020|0037" not in keys:
            continue  # a scout image, a report, a DICOMDIR
        values = {
            key: header.GetMetaData(key).strip() for key in ("0020|0032", "0020|0037", "0020|000e", "0028|0030") if key in keys
        }
        place = np.array([float(v) for v in values["0020|0032"].split("\\")])
        cosines = np.array([float(v) for v in values["0020|0037"].split("\\")]).reshape(2, 3)
        pixel = [float(v) for v in values.get("0028|0030", "0\\0").split("\\")]
        item = (file, place, cosines, tuple(pixel), header.GetSize()[:2], header.GetNumberOfComponents(), header.GetPixelID())
        series.setdefault(values.get("0020|000e", ""), []).append(item)
    if one is not None:
        series = {uid: items for uid, items in series.items() if any(item[0] == one for item in items)}
    if not series:
        raise ScanError(f"{folder}: no DICOM slices with a position in them; export the CT series again")
    slices = max(series.values(), key=len)
    warnings = []
    if len(series) > 1:
        warnings.append(f"the folder holds {len(series)} series; the one with most slices, {len(slices)}, is taken")
    if len(slices) < 2:
        raise ScanError(f"{folder}: a single DICOM slice is no volume; open the folder with the whole series")
    first = slices[0]
    for item in slices:
        if item[4] != first[4] or item[5] != 1 or np.abs(item[2] - first[2]).max() > 1e-3 or item[3] != first[3]:
            raise ScanError(
                f"{item[0]}: its size, spacing or direction is not that of {first[0].name} "
                f"({_times(item[4])} and {_times(first[4])} pixels); put one series only into the folder"
            )
    across, down = first[2] / np.linalg.norm(first[2], axis=1, keepdims=True)
    normal = np.cross(across, down)
    heights = np.array([item[1] @ normal for item in slices])
    slices = [slices[n] for n in np.argsort(heights, kind="stable")]
    gaps = np.diff(np.sort(heights))
    gap = float(np.median(gaps))
    if gap <= 1e-6 or gaps.min() < 0.5 * gap:
        raise ScanError(f"{folder}: several slices at one position; put one series (one acquisition) only into the folder")
    if gaps.max() > 1.5 * gap:
        after = slices[int(gaps.argmax())][0].name
        raise ScanError(
            f"{folder}: slices are missing after {after} ({gaps.max():.3g} mm instead of {gap:.3g}); copy all of them"
        )
    if np.abs(gaps - gap).max() > 0.05 * gap:
        warnings.append(f"the slices are {gaps.min():.3g} to {gaps.max():.3g} mm apart; {gap:.3g} mm is taken throughout")
    gap = float(heights.max() - heights.min()) / len(gaps)
    along = (slices[-1][1] - slices[0][1]) / (gap * len(gaps))  # the gantry's tilt shows here, and is refused by ScanReader
    dtype = np.dtype({sitk.sitkUInt8: "u1", sitk.sitkInt16: "i2", sitk.sitkUInt16: "u2"}.get(first[6], "f4"))
    source = DicomSlices([item[0] for item in slices], (len(slices), first[4][1], first[4][0]), dtype)
    direction = np.stack([across, down, along], axis=1)
    return _Layout(source, (2, 1, 0), (first[3][1], first[3][0], gap), tuple(slices[0][1]), direction, warnings=tuple(warnings))


def _open_dicom_file(path: Path) -> _Layout:
    return _open_dicom(path.parent, path)


_OPENERS = {
    ".vdb": _open_vdb,
    ".npy": _open_npy,
    ".tif": _open_tiff,
    ".tiff": _open_tiff,
    ".nii": _open_nifti,
    ".nii.gz": _open_nifti,
    ".nrrd": _open_nrrd,
    ".nhdr": _open_nrrd,
    ".mha": _open_meta,
    ".mhd": _open_meta,
    ".dcm": _open_dicom_file,
    ".ima": _open_dicom_file,
    ".dicom": _open_dicom_file,
}
