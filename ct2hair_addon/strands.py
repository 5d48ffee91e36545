"""Strands: the one type for hair between the stages: flat points, offsets and named attributes, root first, in mm."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from zipfile import BadZipFile

import numba
import numpy as np
from scipy.spatial import cKDTree

from .errors import StrandFileError

POINT_PREFIX = "point_"
"""Key prefix of per-point attributes in an npz file; per-strand attributes keep their plain name."""
MOST_CELLS = 512
"""Cells along an axis that places are marked in at most: 134 MB."""
THREADED = 1000
"""Places from which on a tree is asked on threads: to start them takes as long as fewer do."""


def normalized(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1; those of no length stay 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def point_tree(points: np.ndarray) -> cKDTree:
    """A tree to find the nearest of many points (M, 3) in. Strands' lie evenly: cells cut in the middle answer as soon as
    balanced ones, and are made in half the time."""
    return cKDTree(points, balanced_tree=False)


def nearest_points(
    tree: cKDTree, places: np.ndarray, k: int | Sequence[int] = 1, reach: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """(distance, index) of a tree's k nearest within `reach` of each place (N, 3), as `cKDTree.query` gives them, on as many
    threads as kernels run on."""
    threads = numba.get_num_threads() if len(places) >= THREADED else 1
    return tree.query(places, k=k, distance_upper_bound=reach, workers=threads)


def points_around(points: np.ndarray, places: np.ndarray, reach: float) -> np.ndarray:
    """Indices, rising, of all of `points` (M, 3) within `reach` of one of `places` (N, 3), and of few that are not: a tree of
    these answers for `places` as one of all would."""
    if not len(places):
        return np.zeros(0, np.int64)
    low, high = places.min(axis=0).astype(np.float64) - reach, places.max(axis=0).astype(np.float64) + reach
    cell = max(reach, float((high - low).max()) / MOST_CELLS)
    near = np.zeros(((high - low) / cell).astype(np.int64) + 1, bool)
    _mark(places, low, cell, reach, near)
    return np.flatnonzero(_marked(points, low, cell, near))


@numba.njit(cache=True)
def _mark(places, low, cell, reach, near):
    """Set the cells of `near` that hold anything within `reach` of one of `places`."""
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(places)):
        for axis in range(3):
            first[axis] = max(int((places[n, axis] - reach - low[axis]) / cell), 0)
            last[axis] = min(int((places[n, axis] + reach - low[axis]) / cell), near.shape[axis] - 1)
        near[first[0] : last[0] + 1, first[1] : last[1] + 1, first[2] : last[2] + 1] = True


@numba.njit(cache=True, parallel=True)
def _marked(points, low, cell, near):
    """(M,) bool: the points in cells of `near`."""
    out = np.zeros(len(points), np.bool_)
    for n in numba.prange(len(points)):
        i, j, k = (points[n, 0] - low[0]) / cell, (points[n, 1] - low[1]) / cell, (points[n, 2] - low[2]) / cell
        if i >= 0.0 and j >= 0.0 and k >= 0.0 and i < near.shape[0] and j < near.shape[1] and k < near.shape[2]:
            out[n] = near[int(i), int(j), int(k)]
    return out


@dataclass(frozen=True)
class Strands:
    """Polylines of hair, root first.

    points: (M, 3) float32, mm, in the frame of whoever made them (the scan frame between stages).
    offsets: (N + 1,) int64; strand `n` is `points[offsets[n]:offsets[n + 1]]`.
    strand_attributes: name -> array of length N (for example `root_uv` (N, 2), `support` (N,)).
    point_attributes: name -> array of length M.
    """

    points: np.ndarray
    offsets: np.ndarray
    strand_attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    point_attributes: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float32).reshape(-1, 3)
        offsets = np.ascontiguousarray(self.offsets, dtype=np.int64)
        if offsets.ndim != 1 or len(offsets) < 1 or offsets[0] != 0 or offsets[-1] != len(points):
            raise ValueError(f"offsets must run from 0 to the {len(points)} points, got {offsets[:1]}..{offsets[-1:]}")
        if np.any(np.diff(offsets) < 0):
            raise ValueError("offsets must not decrease")
        for kind, attributes, length in (
            ("strand", self.strand_attributes, len(offsets) - 1),
            ("point", self.point_attributes, len(points)),
        ):
            for name, values in attributes.items():
                if len(values) != length:
                    raise ValueError(f"{kind} attribute '{name}' has {len(values)} values, expected {length}")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "offsets", offsets)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @classmethod
    def from_polylines(cls, polylines: Sequence[np.ndarray], **strand_attributes: np.ndarray) -> Strands:
        """Strands from a sequence of (n, 3) arrays."""
        counts = np.array([len(line) for line in polylines], dtype=np.int64)
        points = np.concatenate(polylines) if len(polylines) else np.zeros((0, 3), np.float32)
        return cls(points, offsets_from_counts(counts), strand_attributes)

    @classmethod
    def from_array(cls, array: np.ndarray, **strand_attributes: np.ndarray) -> Strands:
        """Strands of equal point counts from an (N, P, 3) array."""
        count, size = array.shape[:2]
        return cls(array.reshape(-1, 3), np.arange(count + 1, dtype=np.int64) * size, strand_attributes)

    @property
    def counts(self) -> np.ndarray:
        """(N,) int64: points of each strand."""
        return np.diff(self.offsets)

    @property
    def roots(self) -> np.ndarray:
        """(N, 3) float32: the first point of each strand (no strand may be empty)."""
        return self.points[self.offsets[:-1]]

    @property
    def tips(self) -> np.ndarray:
        """(N, 3) float32: the last point of each strand (no strand may be empty)."""
        return self.points[self.offsets[1:] - 1]

    @property
    def strand_index(self) -> np.ndarray:
        """(M,) int64: the strand that each point belongs to."""
        return np.repeat(np.arange(len(self), dtype=np.int64), self.counts)

    def arc_lengths(self) -> np.ndarray:
        """(M,) float32: the length from the root to each point along its strand, mm."""
        return _arc_lengths(self.points, self.offsets)

    def lengths(self) -> np.ndarray:
        """(N,) float32: the length of each strand, mm; 0 for strands of fewer than two points."""
        arc = self.arc_lengths()
        ends = np.maximum(self.offsets[1:] - 1, 0)
        return np.where(self.counts > 0, arc[ends] if len(arc) else 0.0, 0.0).astype(np.float32)

    def tangents(self, reach: int = 1) -> np.ndarray:
        """(M, 3) float32: unit tangents, from `reach` points before to as many after, cut short at the ends; 0 where these
        coincide."""
        return _tangents(self.points, self.offsets, reach)

    def polylines(self) -> list[np.ndarray]:
        """The strands as a list of (n, 3) views: for tests and small sets."""
        return np.split(self.points, self.offsets[1:-1]) if len(self) else []

    def select(self, which: np.ndarray) -> Strands:
        """The strands of a boolean mask (N,) or of an integer index, in that order, attributes included."""
        which = np.asarray(which)
        index = np.flatnonzero(which) if which.dtype == bool else which.astype(np.int64)
        counts = self.counts[index]
        offsets = offsets_from_counts(counts)
        rows = np.repeat(self.offsets[:-1][index] - offsets[:-1], counts) + np.arange(offsets[-1])
        return Strands(
            self.points[rows],
            offsets,
            {name: values[index] for name, values in self.strand_attributes.items()},
            {name: values[rows] for name, values in self.point_attributes.items()},
        )

    def reversed(self, which: np.ndarray | None = None) -> Strands:
        """The same strands with the points of those in the mask `which` (N,) (all by default) in reverse order."""
        flip = np.ones(len(self), bool) if which is None else np.asarray(which, bool)
        strand = self.strand_index
        position = np.arange(len(self.points), dtype=np.int64)
        mirrored = self.offsets[:-1][strand] + self.offsets[1:][strand] - 1 - position
        rows = np.where(flip[strand], mirrored, position)
        return replace(
            self,
            points=self.points[rows],
            point_attributes={name: values[rows] for name, values in self.point_attributes.items()},
        )

    def transformed(self, matrix: np.ndarray) -> Strands:
        """The strands under a 4 x 4 matrix acting on column vectors (`matrix @ [x, y, z, 1]`)."""
        matrix = np.asarray(matrix, dtype=np.float64)
        return replace(self, points=(self.points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32))

    def with_points(self, points: np.ndarray) -> Strands:
        """The same strands at new positions (M, 3)."""
        return replace(self, points=points)

    def with_attributes(self, **strand_attributes: np.ndarray) -> Strands:
        """The same strands with these per-strand attributes added or replaced."""
        return replace(self, strand_attributes={**self.strand_attributes, **strand_attributes})

    def resampled(self, size: int) -> np.ndarray:
        """(N, size, 3) float32: each strand at `size` points of equal arc length (linear between the given points)."""
        if size < 2:
            raise ValueError(f"a strand needs at least 2 points, got {size}")
        return _resample(self.points, self.offsets, np.full(len(self), size, np.int64)).reshape(len(self), size, 3)

    def resampled_by_step(self, step: float) -> Strands:
        """Each strand at points at most `step` mm apart along it, ends kept; strand attributes kept, point ones dropped."""
        counts = np.maximum(np.ceil(self.lengths() / np.float32(step)).astype(np.int64) + 1, 2)
        points = _resample(self.points, self.offsets, counts)
        return Strands(points, offsets_from_counts(counts), self.strand_attributes)

    def save(self, path: str | os.PathLike) -> None:
        """Write an npz (points, offsets, attributes), beside the target and renamed: never half a file."""
        path = Path(path)
        beside = path.with_name(f".{path.name}.part.npz")
        arrays = {"points": self.points, "offsets": self.offsets, **self.strand_attributes}
        arrays |= {POINT_PREFIX + name: values for name, values in self.point_attributes.items()}
        try:
            np.savez(beside, **arrays)
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Strands:
        """Read what `save` wrote. Raises StrandFileError where the file is not such a file."""
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in file.files}
            points, offsets = arrays.pop("points"), arrays.pop("offsets")
            strand = {name: values for name, values in arrays.items() if not name.startswith(POINT_PREFIX)}
            point = {name[len(POINT_PREFIX) :]: arrays[name] for name in arrays if name.startswith(POINT_PREFIX)}
            return cls(points, offsets, strand, point)
        except FileNotFoundError:
            raise StrandFileError(f"{path}: there is no such file") from None
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise StrandFileError(
                f"{path}: not a strand file (expected an npz with 'points' (M, 3) and 'offsets' (N + 1)): {error}"
            ) from error


def offsets_from_counts(counts: np.ndarray) -> np.ndarray:
    """(N + 1,) int64 offsets of strands with these point counts."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def concatenate(parts: Iterable[Strands]) -> Strands:
    """One set from several; an attribute is kept where every part has it."""
    parts = list(parts)
    if not parts:
        return Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))

    def joined(kind: str) -> dict[str, np.ndarray]:
        maps = [getattr(part, kind) for part in parts]
        names = [name for name in maps[0] if all(name in other for other in maps)]
        return {name: np.concatenate([other[name] for other in maps]) for name in names}

    return Strands(
        np.concatenate([part.points for part in parts]),
        offsets_from_counts(np.concatenate([part.counts for part in parts])),
        joined("strand_attributes"),
        joined("point_attributes"),
    )


@numba.njit(cache=True, parallel=True)
def _arc_lengths(points, offsets):
    arc = np.zeros(len(points), np.float32)
    for n in numba.prange(len(offsets) - 1):
        total = 0.0
        for m in range(offsets[n] + 1, offsets[n + 1]):
            dx = points[m, 0] - points[m - 1, 0]
            dy = points[m, 1] - points[m - 1, 1]
            dz = points[m, 2] - points[m - 1, 2]
            total += np.sqrt(dx * dx + dy * dy + dz * dz)
            arc[m] = total
    return arc


@numba.njit(cache=True, parallel=True)
def _tangents(points, offsets, reach):
    tangents = np.zeros_like(points)
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        for m in range(start, end):
            before, after = max(m - reach, start), min(m + reach, end - 1)
            dx = points[after, 0] - points[before, 0]
            dy = points[after, 1] - points[before, 1]
            dz = points[after, 2] - points[before, 2]
            norm = np.sqrt(dx * dx + dy * dy + dz * dz)
            if norm > 0.0:
                tangents[m, 0] = dx / norm
                tangents[m, 1] = dy / norm
                tangents[m, 2] = dz / norm
    return tangents


@numba.njit(cache=True, parallel=True)
def _resample(points, offsets, counts):
    """Each strand `n` at `counts[n]` points of equal arc length, ends kept; a single point is repeated."""
    starts = np.zeros(len(counts) + 1, np.int64)
    starts[1:] = np.cumsum(counts)
    out = np.empty((starts[-1], 3), np.float32)
    for n in numba.prange(len(counts)):
        first, last = offsets[n], offsets[n + 1] - 1
        size = last - first + 1
        arc = np.zeros(max(size, 1))
        for i in range(1, size):
            d = points[first + i] - points[first + i - 1]
            arc[i] = arc[i - 1] + np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        segment = 0
        for s in range(counts[n]):
            wanted = arc[size - 1] * s / max(counts[n] - 1, 1)
            while segment < size - 2 and arc[segment + 1] < wanted:
                segment += 1
            after = min(segment + 1, size - 1)
            span = arc[after] - arc[segment]
            t = min(max((wanted - arc[segment]) / span, 0.0), 1.0) if span > 0.0 else 0.0
            for axis in range(3):
                a, b = points[first + segment, axis], points[first + after, axis]
                out[starts[n] + s, axis] = a + (b - a) * t
        if counts[n] > 1:
            out[starts[n + 1] - 1] = points[last]
    return out
