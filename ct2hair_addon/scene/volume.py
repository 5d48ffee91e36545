"""The scan in the scene: a Volume object on a .vdb, with a material that shows the wig (frames: see `frames`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ..errors import ScanError
from .materials import density_material
from .staging import NewData

DENSITY = "density"
"""Name of the grid that is shown; the first grid of a file of somebody else's may stand in."""
PROXY_BYTES = 512 * 2**20
"""Files larger than this are drawn as a box in the viewport: views other than Cycles hang at some gigabytes."""


@dataclass(frozen=True)
class GridSummary:
    """What a .vdb holds: name of the grid, voxel size and corners in its own units (mm), and the range worth showing.

    low, high: grid values between which the material runs. low_corner, high_corner: (3,) the box of active voxels.
    """

    name: str
    spacing: float
    voxels: int
    low: float
    high: float
    low_corner: np.ndarray
    high_corner: np.ndarray


def summarize(path: str | Path, low: float | None = None, high: float | None = None) -> GridSummary:
    """Look into a .vdb. `low` and `high`, where given (the thresholds of the scan), are taken over.

    Without them the range is guessed: from a fifth to the whole of the value that 1 % of a sample of the positive voxels
    exceed. Raises ScanError where there is no float grid in the file.
    """
    openvdb = _openvdb()
    path = Path(path)
    if not path.is_file():
        raise ScanError(f"{path}: there is no such file")
    try:
        names = [grid.name for grid in openvdb.readAllGridMetadata(str(path))]
        name = DENSITY if DENSITY in names else next(iter(names), None)
        if name is None:
            raise ScanError(f"{path}: the file holds no grid; expected an OpenVDB file with a float grid '{DENSITY}'")
        grid = openvdb.read(str(path), name)
    except (OSError, RuntimeError, KeyError, LookupError) as error:
        raise ScanError(f"{path}: not a readable OpenVDB file ({error})") from None
    if grid.valueTypeName not in ("float", "half"):
        raise ScanError(f"{path}: the grid '{name}' holds {grid.valueTypeName} values; expected a float grid of density")
    voxels = grid.activeVoxelCount()
    if not voxels:
        raise ScanError(f"{path}: the grid '{name}' has no active voxel; it holds no hair")
    first, last = grid.evalActiveVoxelBoundingBox()
    corners = np.array([grid.transform.indexToWorld(corner) for corner in (first, last)], np.float64)
    if low is None or high is None:
        dense = _sampled_values(grid, first, last)
        top = float(np.quantile(dense[dense > 0], 0.99)) if (dense > 0).any() else float(grid.evalMinMax()[1])
        low, high = (0.2 * top if low is None else low), (top if high is None else high)
    spacing = float(grid.transform.voxelSize()[0])
    return GridSummary(name, spacing, voxels, float(low), float(high), corners.min(axis=0), corners.max(axis=0))


def new_volume(new: NewData, name: str, path: str | Path, summary: GridSummary) -> bpy.types.Object:
    """A Volume object on the .vdb at `path`, not linked yet; its grid's own transform is in mm of the scan frame."""
    volume = new.add(bpy.data.volumes.new(name))
    volume.filepath = str(Path(path).resolve())
    if not volume.grids.load():
        raise ScanError(f"{path}: Blender can't load the grid ({volume.grids.error_message})")
    volume.materials.append(density_material(new, f"{name} Density", summary.low, summary.high, summary.name))
    volume.display.density = 0.05
    ob = new.add(bpy.data.objects.new(name, volume))
    if Path(path).stat().st_size > PROXY_BYTES:
        ob.display_type = "BOUNDS"
    return ob


def _sampled_values(grid, first, last, edge: int = 96, blocks: int = 27) -> np.ndarray:
    """Values of some cubes of voxels spread evenly over the box of active voxels: enough for a quantile."""
    first, last = np.asarray(first), np.asarray(last)
    steps = round(blocks ** (1 / 3))
    found = []
    for index in np.ndindex(steps, steps, steps):
        centre = first + (last - first) * (np.array(index) + 0.5) / steps
        low = np.maximum(first, centre.astype(int) - edge // 2)
        size = np.minimum(edge, last - low + 1)
        block = np.zeros(tuple(int(n) for n in size), np.float32)
        grid.copyToArray(block, ijk=tuple(int(n) for n in low))
        found.append(block.ravel())
    return np.concatenate(found)


def _openvdb():
    bpy.utils.expose_bundled_modules()
    try:
        import openvdb
    except ImportError:
        raise ScanError("this Blender was built without OpenVDB for Python; install a Blender from blender.org") from None
    return openvdb
