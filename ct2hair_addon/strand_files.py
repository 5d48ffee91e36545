"""Strand files of other programs: CT2Hair `.bin`, USC-HairSalon `.data`, Cem Yuksel's `.hair`, and our own `.npz`.

All are read and written as they are: no unit or axis is changed. Layouts (little endian):

- `.data` (USC-HairSalon, Hu et al. 2015): int32 strands; per strand int32 n and n x 3 float32.
- `.bin` (CT2Hair): int32 strands; per strand int32 n and n x 7 float32: position, direction, label.
- `.hair` (cemyuksel.com/research/hairmodels): a header of 128 bytes, uint16 segments per strand, float32 points.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

from .errors import StrandFileError
from .strands import Strands, offsets_from_counts

HAIR_HEADER = struct.Struct("<4s4I5f88s")
"""Signature, strands, points, flags, default segments, default thickness, transparency and colour (3), information."""
HAIR_SEGMENTS, HAIR_POINTS, HAIR_THICKNESS, HAIR_TRANSPARENCY, HAIR_COLOR = 1, 2, 4, 8, 16
HAIR_MAX_SEGMENTS = 65535


def read_strands(path: str | os.PathLike) -> Strands:
    """Strands from a file, its format by its ending. Raises StrandFileError for unknown, damaged or truncated files."""
    path = Path(path)
    reader = _format(path)[0]
    if not path.is_file():
        raise StrandFileError(f"{path}: there is no such file")
    strands = reader(path)
    if not np.isfinite(strands.points).all():
        bad = np.count_nonzero(~np.isfinite(strands.points).all(axis=1))
        raise StrandFileError(f"{path}: {bad} of {len(strands.points)} points are not finite numbers; export the file again")
    return strands


def write_strands(strands: Strands, path: str | os.PathLike) -> None:
    """Write strands to a file, its format by its ending, beside the target and renamed."""
    path = Path(path)
    writer = _format(path)[1]
    beside = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        writer(strands, beside)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def _format(path: Path) -> tuple[Callable[[Path], Strands], Callable[[Strands, Path], None]]:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        raise StrandFileError(f"{path}: unknown strand format '{path.suffix}'; known are {', '.join(FORMATS)}") from None


def _read_interleaved(path: Path, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """((M, columns) float32, (N + 1,) int64 offsets) of a file of counts and rows in turn."""
    raw = np.fromfile(path, dtype="<i4")
    if len(raw) < 1 or raw[0] < 0 or path.stat().st_size % 4:
        raise StrandFileError(f"{path}: not a {path.suffix} file (its size or its strand count makes no sense)")
    starts, counts, end = _interleaved_layout(raw, columns)
    if end < 0:
        raise StrandFileError(f"{path}: truncated or damaged: {raw[0]} strands announced, the file ends before the last")
    if end != len(raw):
        raise StrandFileError(f"{path}: {4 * (len(raw) - end)} bytes left over after {raw[0]} strands; another format?")
    offsets = offsets_from_counts(counts)
    rows = np.repeat(starts - offsets[:-1] * columns, counts) + np.arange(offsets[-1]) * columns
    values = raw.view("<f4")[rows[:, None] + np.arange(columns)]
    return values.astype(np.float32), offsets


@numba.njit(cache=True)
def _interleaved_layout(raw, columns):
    """Where each strand's rows start, how many it has, and where the last one ends (-1 past the file's end)."""
    count = raw[0]
    starts, counts = np.zeros(count, np.int64), np.zeros(count, np.int64)
    position = 1
    for n in range(count):
        if position >= len(raw) or raw[position] < 0 or position + 1 + columns * np.int64(raw[position]) > len(raw):
            return starts, counts, -1
        counts[n] = raw[position]
        starts[n] = position + 1
        position += 1 + columns * counts[n]
    return starts, counts, position


def _write_interleaved(values: np.ndarray, offsets: np.ndarray, path: Path) -> None:
    columns = values.shape[1]
    counts = np.diff(offsets)
    out = np.empty(1 + len(counts) + values.size, dtype="<i4")
    heads = 1 + np.arange(len(counts)) + offsets[:-1] * columns
    out[0] = len(counts)
    out[heads] = counts
    rows = np.repeat(heads + 1 - offsets[:-1] * columns, counts) + np.arange(len(values)) * columns
    out.view("<f4")[rows[:, None] + np.arange(columns)] = values
    out.tofile(path)


def _read_data(path: Path) -> Strands:
    return Strands(*_read_interleaved(path, 3))


def _write_data(strands: Strands, path: Path) -> None:
    _write_interleaved(strands.points, strands.offsets, path)


def _read_bin(path: Path) -> Strands:
    values, offsets = _read_interleaved(path, 7)
    return Strands(values[:, :3], offsets)


def _write_bin(strands: Strands, path: Path) -> None:
    label = np.zeros((len(strands.points), 1), np.float32)
    _write_interleaved(np.hstack([strands.points, strands.tangents(), label]), strands.offsets, path)


def _read_hair(path: Path) -> Strands:
    raw = path.read_bytes()
    if len(raw) < HAIR_HEADER.size or raw[:4] != b"HAIR":
        raise StrandFileError(f"{path}: not a HAIR file (it does not begin with the letters HAIR and 128 bytes of header)")
    _, strand_count, point_count, flags, default_segments, *_ = HAIR_HEADER.unpack_from(raw)
    if not flags & HAIR_POINTS:
        raise StrandFileError(f"{path}: the HAIR file holds no points")
    position = HAIR_HEADER.size
    if flags & HAIR_SEGMENTS:
        if len(raw) < position + 2 * strand_count:
            raise StrandFileError(f"{path}: truncated: {strand_count} strands announced, the file ends before their lengths")
        segments = np.frombuffer(raw, "<u2", strand_count, position)
        position += 2 * strand_count
    else:
        segments = np.full(strand_count, default_segments)
    offsets = offsets_from_counts(segments.astype(np.int64) + 1)
    if offsets[-1] != point_count:
        raise StrandFileError(f"{path}: the strands need {offsets[-1]} points, the header says {point_count}")
    if len(raw) < position + 12 * point_count:
        raise StrandFileError(f"{path}: truncated: {point_count} points announced, the file ends before the last")
    points = np.frombuffer(raw, "<f4", 3 * point_count, position).reshape(-1, 3)
    return Strands(points.copy(), offsets)


def _write_hair(strands: Strands, path: Path) -> None:
    counts = strands.counts
    if len(counts) and (counts.min() < 2 or counts.max() - 1 > HAIR_MAX_SEGMENTS):
        raise StrandFileError(
            f"a HAIR file takes strands of 2 to {HAIR_MAX_SEGMENTS + 1} points, these have {counts.min()} to {counts.max()}; "
            "resample them first"
        )
    header = HAIR_HEADER.pack(
        b"HAIR", len(strands), len(strands.points), HAIR_SEGMENTS | HAIR_POINTS, 0, 0.08, 0.0, 0.2, 0.12, 0.08, b"CT2Hair, mm"
    )
    with path.open("wb") as file:
        file.write(header)
        file.write((counts - 1).astype("<u2").tobytes())
        file.write(strands.points.astype("<f4").tobytes())


FORMATS: dict[str, tuple[Callable[[Path], Strands], Callable[[Strands, Path], None]]] = {
    ".npz": (Strands.load, Strands.save),
    ".bin": (_read_bin, _write_bin),
    ".data": (_read_data, _write_data),
    ".hair": (_read_hair, _write_hair),
}
"""Ending -> (reader, writer)."""
