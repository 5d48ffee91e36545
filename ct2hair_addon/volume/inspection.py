"""A first look at a scan: its histogram with the thresholds found in it, and a small copy to show slices of."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from ..errors import ScanError
from ..progress import Progress, part, silent
from ..settings import ScanSettings
from .readers import ScanReader
from .thresholds import Thresholds, find_thresholds

BINS = 256
LOOK_EDGE = 160
"""Voxels along the longest edge of the small copy: more than a panel shows."""


@dataclass(frozen=True)
class Inspection:
    """What a scan looks like.

    counts: (BINS,) int64 voxels of the small copy by value, edges: (BINS + 1,) their bounds. look: (X, Y, Z) float32, every
    n-th voxel of the scan, for slices. shape, spacing: of the scan itself, voxels and mm. hair_voxels: estimate of the whole
    scan's. thresholds: None where no hair was found, and `problem` then says so.
    """

    counts: np.ndarray
    edges: np.ndarray
    look: np.ndarray
    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    hair_voxels: int
    thresholds: Thresholds | None
    problem: str = ""

    def slice(self, axis: int, fraction: float) -> np.ndarray:
        """(A, B) float32: the slice across `axis` (0, 1, 2 for x, y, z) at a share of its length, other axes in order."""
        index = int(np.clip(round(fraction * (self.look.shape[axis] - 1)), 0, self.look.shape[axis] - 1))
        return np.take(self.look, index, axis=axis)

    def save(self, path: str | os.PathLike) -> None:
        """Write an npz, beside the target and renamed."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        known = {
            "shape": self.shape,
            "spacing": self.spacing,
            "hair_voxels": self.hair_voxels,
            "problem": self.problem,
            "thresholds": None if self.thresholds is None else asdict(self.thresholds),
        }
        beside = path.with_name(f".{path.name}.part.npz")
        try:
            np.savez_compressed(beside, counts=self.counts, edges=self.edges, look=self.look, known=np.array(json.dumps(known)))
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Inspection:
        """Read what `save` wrote. Raises ScanError where it is not such a file."""
        try:
            with np.load(path) as file:
                known = json.loads(str(file["known"]))
                thresholds = known["thresholds"]
                if thresholds is not None:
                    thresholds = Thresholds(**{**thresholds, "chosen": tuple(thresholds["chosen"])})
                return cls(
                    file["counts"],
                    file["edges"],
                    file["look"],
                    tuple(known["shape"]),
                    tuple(known["spacing"]),
                    known["hair_voxels"],
                    thresholds,
                    known["problem"],
                )
        except (OSError, KeyError, ValueError, TypeError, EOFError, BadZipFile) as error:
            raise ScanError(f"{path}: not a look at a scan ({error}); look at the scan again") from None


def inspect_scan(reader: ScanReader, settings: ScanSettings, progress: Progress = silent) -> Inspection:
    """Look at an open scan. Where no hair is found, the rest is there all the same, and `problem` says why."""
    reader.prepare(part(progress, 0.0, 0.2))
    look = _small_copy(reader, part(progress, 0.2, 0.6))
    low, high = np.quantile(look, [0.0005, 0.9995])
    if high <= low:
        low, high = float(look.min()), float(look.min()) + 1.0
    counts, edges = np.histogram(look, BINS, (float(low), float(high)))
    thresholds, problem, hair = None, "", 0
    try:
        thresholds = find_thresholds(reader, settings, part(progress, 0.6, 1.0))
        upper = np.inf if thresholds.solid is None else thresholds.solid
        share = np.count_nonzero((look > thresholds.hair) & (look < upper)) / look.size
        hair = int(share * np.prod(reader.shape, dtype=float))
    except ScanError as error:
        problem = str(error)
    progress(1.0, 1.0)
    spacing = tuple(float(s) for s in reader.spacing)
    return Inspection(counts, edges, look, reader.shape, spacing, hair, thresholds, problem)


def _small_copy(reader: ScanReader, progress: Progress) -> np.ndarray:
    """(X, Y, Z) float32: every n-th voxel along each axis, n by the axis, read slice by slice."""
    steps = [max(1, -(-n // LOOK_EDGE)) for n in reader.shape]
    slow, mid, fast = reader.order
    places = range(0, reader.shape[slow], steps[slow])
    slices = []
    for number, place in enumerate(places):
        slices.append(reader.native(place, place + 1)[0, :: steps[mid], :: steps[fast]].copy())
        progress(number + 1, len(places))
    return np.ascontiguousarray(np.stack(slices).transpose(np.argsort(reader.order)), np.float32)
