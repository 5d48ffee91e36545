"""What else there is for orientations: structure-tensor (PyPI) on the same voxels, threads and run as our field.

It works on dense arrays, so both get the fullest cube of the scan. Where the package isn't installed, that is said.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np

from ..evaluation import orientation_error
from ..head import Head, HeadMesh, remove_hairnet
from ..orientation import orientation_field
from ..settings import OrientationSettings, Settings
from ..strands import Strands
from ..volume import BRICK, BrickVolume, find_thresholds, import_scan, open_scan

EDGE = 12
"""Bricks along an edge of the cube: 7 million voxels."""
ROUNDS = 3
"""Each is timed this often, by turns, and its shortest time taken."""
SMOOTHING = ((0.7, 1.0), (0.7, 1.5), (0.7, 2.0))
"""(sigma, rho), voxels, that structure-tensor is given: those of FINDINGS; ours is given its own."""
BLOCK = 128
"""Voxels along an edge of structure-tensor's blocks, its own default."""


def installed() -> str | None:
    """structure-tensor's version, None where it isn't installed."""
    try:
        return importlib.metadata.version("structure-tensor")
    except importlib.metadata.PackageNotFoundError:
        return None


def fullest_cube(density: BrickVolume, level: float, edge: int = EDGE) -> np.ndarray:
    """(3,) the first brick of the cube of `edge` bricks that holds the most hair voxels."""
    counts = np.zeros(density.table.shape, np.int64)
    counts[tuple(density.brick_index.T)] = (density.bricks > level).sum(axis=(1, 2, 3))
    size = [min(edge, n) for n in counts.shape]
    sums = counts
    for axis, width in enumerate(size):
        sums = np.insert(np.cumsum(sums, axis=axis), 0, 0, axis=axis)
        sums = np.take(sums, np.arange(width, sums.shape[axis]), axis=axis) - np.take(
            sums, np.arange(sums.shape[axis] - width), axis=axis
        )
    return np.array(np.unravel_index(int(np.argmax(sums)), sums.shape))


def hair_of(scan: Path, head: HeadMesh, settings: Settings) -> tuple[BrickVolume, float]:
    """(density, hair level) of a scan; the net, which has directions of its own, is taken out around the true head."""
    reader = open_scan(scan, settings.scan)
    wig = import_scan(reader, find_thresholds(reader, settings.scan), settings.scan)
    return remove_hairnet(wig.density, Head(head), settings.head)[0], wig.hair_level


def compare(density: BrickVolume, level: float, truth: Strands) -> list[dict[str, Any]]:
    """Rows of the comparison: name, smoothing, seconds, hair voxels and all voxels a second, error (degrees), speed over ours.

    density: air subtracted, mm; level: density above which a voxel is hair. Errors are taken at the same hair voxels for all.
    """
    low = fullest_cube(density, level) * BRICK
    shape = np.minimum(EDGE * BRICK, np.array(density.shape) - low)
    dense = np.ascontiguousarray(density.block(low, low + shape), np.float32)
    cube = BrickVolume.from_dense(dense, density.spacing, density.to_scan(low))
    hair = np.argwhere(dense > level)
    places = cube.to_scan(hair)
    settings = OrientationSettings()
    ours = OrientationSettings(confidence=0.0)
    fields: dict[str, Any] = {}

    def our_field() -> None:
        fields["ours"] = orientation_field(cube, level, ours)

    work: dict[str, tuple[Any, Callable[[], None]]] = {"ours": ((settings.sigma, settings.rho), our_field)}
    if installed():
        for sigma, rho in SMOOTHING:
            name = f"structure-tensor {installed()}, rho {rho:g}"

            def theirs(name=name, sigma=sigma, rho=rho) -> None:
                fields[name] = _structure_tensor(dense, sigma, rho)

            work[name] = ((sigma, rho), theirs)
    our_field()  # compiled before anything is timed
    seconds = dict.fromkeys(work, np.inf)
    for _ in range(ROUNDS):
        for name, (_, run) in work.items():
            begun = time.perf_counter()
            run()
            seconds[name] = min(seconds[name], time.perf_counter() - begun)
    rows = []
    for name, (smoothing, _) in work.items():
        directions = fields[name].sample(places)[0] if name == "ours" else fields[name][:, *hair.T].T
        known = np.linalg.norm(directions, axis=1) > 0.5
        rows.append(
            {
                "name": name,
                "sigma, rho": smoothing,
                "seconds": seconds[name],
                "hair voxels a second": len(hair) / seconds[name],
                "voxels a second": dense.size / seconds[name],
                "times ours": seconds["ours"] / seconds[name],
                **orientation_error(places[known], directions[known], truth),
            }
        )
    return rows


def _structure_tensor(dense: np.ndarray, sigma: float, rho: float) -> np.ndarray:
    """(3, X, Y, Z) float32: the package's vectors of the smallest eigenvalue, x first; a process for each of our threads."""
    from structure_tensor.multiprocessing import parallel_structure_tensor_analysis

    devices = ["cpu"] * numba.get_num_threads()
    with _plain_termination():
        _, _, vectors = parallel_structure_tensor_analysis(dense, sigma, rho, devices=devices, block_size=BLOCK)
    # its first component runs along the array's last axis
    return vectors[::-1]


@contextlib.contextmanager
def _plain_termination() -> Iterator[None]:
    """SIGTERM as the system has it: processes forked meanwhile end by it without a word."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
