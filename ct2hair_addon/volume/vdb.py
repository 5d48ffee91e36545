"""BrickVolume to and from an OpenVDB file, brick by brick: the sparse grid of the wig that the scene shows (paper 3.1)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..errors import ScanError
from .grid import BRICK, BrickVolume
from .openvdb_module import openvdb

TABLE_KEY = "ct2hair_table"
"""Grid metadata: the table's size, so that a volume comes back with the same origin even where its low corner is empty."""


def save_vdb(volume: BrickVolume, path: str | os.PathLike, name: str = "density") -> None:
    """Write a scalar volume as a FloatGrid called `name`, beside the target and renamed: never half a file.

    Voxel (i, j, k) becomes grid index (i, j, k); the transform maps it to `origin + (i, j, k) * spacing`, in mm. Voxels
    equal to the background are left inactive. Raises ScanError where the file can't be written.
    """
    write_grids(path, [as_grid(volume, name)])


def as_grid(volume: BrickVolume, name: str, scale: float = 1.0):
    """An OpenVDB grid called `name` of the volume's values times `scale`, laid out as `save_vdb` says.

    A FloatGrid, or a Vec3SGrid where each voxel holds three numbers.
    """
    vdb = openvdb()
    if volume.bricks.ndim == 4:
        grid = vdb.FloatGrid(float(volume.background) * scale)
    elif volume.bricks.shape[4:] == (3,):
        grid = vdb.Vec3SGrid((float(volume.background) * scale,) * 3)
    else:
        raise ValueError(f"only numbers and vectors of three go into a grid, got bricks of shape {volume.bricks.shape}")
    grid.name = name
    grid.transform = linear_transform(vdb, (volume.spacing,) * 3, volume.origin)
    grid[TABLE_KEY] = " ".join(str(n) for n in volume.table.shape)
    for low, brick in zip((volume.brick_index * BRICK).tolist(), volume.bricks, strict=True):
        grid.copyFromArray(np.multiply(brick, np.float32(scale), dtype=np.float32), ijk=tuple(low))
    return grid


def load_vdb(path: str | os.PathLike, name: str | None = None) -> BrickVolume:
    """Read a grid (`name`, else "density", else the only scalar one) as a BrickVolume; the whole grid is in memory once.

    Raises ScanError where the file, the grid or its transform can't be used (not isotropic, say).
    """
    grid = read_grid(path, name)
    spacing, origin = grid_geometry(path, grid)
    if max(spacing) > min(spacing) * 1.0001:
        raise ScanError(f"{path}: the grid's voxels measure {spacing} mm; open it as a scan to resample it to cubes")
    background = float(grid.background)
    if not grid.activeVoxelCount():
        low = np.zeros(3, np.int64)
        table = np.full((1, 1, 1), -1, np.int32)
        bricks = np.zeros((0, BRICK, BRICK, BRICK), np.float32)
        return BrickVolume(_stored_table(grid, low, table), bricks, float(spacing[0]), origin, background)
    first, last = (np.array(corner, np.int64) for corner in grid.evalActiveVoxelBoundingBox())
    low = first >> 4
    table = np.full(tuple((last >> 4) + 1 - low), -1, np.int32)
    stored = _stored_table(grid, low, table)
    if stored is not table:
        low, table = np.zeros(3, np.int64), stored
    kept: list[np.ndarray] = []
    count = 0
    layer = np.empty((BRICK, BRICK * table.shape[1], BRICK * table.shape[2]), np.float32)
    for x in range(table.shape[0]):
        grid.copyToArray(layer, ijk=tuple(int(n) for n in (low + (x, 0, 0)) * BRICK))
        blocks = layer.reshape(BRICK, table.shape[1], BRICK, table.shape[2], BRICK).transpose(1, 3, 0, 2, 4)
        filled = (blocks != np.float32(background)).any(axis=(2, 3, 4))
        found = np.count_nonzero(filled)
        table[x][filled] = count + np.arange(found, dtype=np.int32)
        count += found
        kept.append(blocks[filled])
    corner = origin + low * BRICK * spacing
    return BrickVolume(table, np.concatenate(kept), float(spacing[0]), corner, background)


def _stored_table(grid, low: np.ndarray, table: np.ndarray) -> np.ndarray:
    """An empty table of the size that `save_vdb` noted, from index 0 on, where the grid still fits it; else `table`."""
    try:
        size = tuple(int(n) for n in grid[TABLE_KEY].split())
    except (KeyError, ValueError, AttributeError):
        return table
    if len(size) != 3 or min(size) < 1 or (low < 0).any() or (low + table.shape > size).any():
        return table
    return np.full(size, -1, np.int32)


def linear_transform(vdb, spacing, origin):
    """OpenVDB's transform from index (i, j, k) to `origin + (i, j, k) * spacing` (rows, translation last)."""
    matrix = np.diag([*(float(s) for s in spacing), 1.0])
    matrix[3, :3] = origin
    return vdb.createLinearTransform(matrix.tolist())


def write_grids(path: str | os.PathLike, grids: list) -> None:
    """Write grids to `path`, beside it first and then renamed. Raises ScanError where that fails."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.part.vdb")
    try:
        openvdb().write(str(beside), grids=grids)
        beside.replace(path)
    except (OSError, RuntimeError) as error:
        raise ScanError(f"{path}: the grid can't be written ({error}); check the folder and the space left on it") from error
    finally:
        beside.unlink(missing_ok=True)


def read_grid(path: str | os.PathLike, name: str | None = None):
    """The scalar grid `name` of a .vdb file; without a name "density", else the only one.

    Raises ScanError where the file is missing or damaged, or there is no such grid.
    """
    vdb = openvdb()
    path = Path(path)
    if not path.is_file():
        raise ScanError(f"{path}: there is no such file")
    try:
        grids = {grid.name: grid for grid in vdb.readAllGridMetadata(str(path)) if grid.valueTypeName in ("float", "double")}
        if not grids:
            raise ScanError(f"{path}: it holds no grid of numbers (float); export the density as a float grid")
        wanted = name if name is not None else "density" if "density" in grids else next(iter(grids))
        if wanted not in grids or (name is None and wanted != "density" and len(grids) > 1):
            raise ScanError(f"{path}: no grid '{name or 'density'}'; it holds {', '.join(sorted(grids))}")
        return vdb.read(str(path), wanted)
    except (OSError, RuntimeError) as error:
        raise ScanError(
            f"{path}: not a readable OpenVDB file, damaged or cut short ({error}); write or copy it again"
        ) from error


def grid_geometry(path, grid) -> tuple[np.ndarray, np.ndarray]:
    """Spacing (3,) and the position of index (0, 0, 0) (3,), mm. Raises ScanError for rotated or tapered transforms."""
    if not grid.transform.isLinear:
        raise ScanError(f"{path}: the grid's transform is not linear; resample it to a plain grid")
    origin = np.array(grid.transform.indexToWorld((0, 0, 0)), np.float64)
    axes = np.array([grid.transform.indexToWorld(tuple(row)) for row in np.eye(3).tolist()]) - origin
    spacing = np.diag(axes).copy()
    if (spacing <= 0).any() or np.abs(axes - np.diag(spacing)).max() > 1e-4 * np.abs(axes).max():
        raise ScanError(f"{path}: the grid's transform rotates or mirrors it; resample it along x, y and z")
    return spacing, origin
