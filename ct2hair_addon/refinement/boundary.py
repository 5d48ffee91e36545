"""The head as a boundary of the refinement: which points may move against it, and what of a strand the scan can show."""

from __future__ import annotations

import numpy as np

from .motion import keep_outside

NEAR = 4.0
"""Distance from the head, mm, within which a point is held to a tangent plane."""
MARGIN = 0.05
"""Distance, mm, that free points keep from the head."""
LAST_PUSHES = 6
LEAVES, STANDS, BESIDE = 0.18, 0.6, 12.0
"""Slope at which hair leaves the scalp at least (10 degrees), up to how far over it, and along how much of it, mm: there the
scan shows none, and what holds a curve straight would lay it onto the skin."""


class Boundary:
    """The head's tangent planes near strands, taken anew by `look`; `push` moves points out of them.

    head answers `signed_distance` and `outward` as `Head` does. floor: distance from the head, mm, below which the scan shows
    no hair (net cut away). ramp: mm over which strands fade in above it, a voxel of the scan.
    """

    def __init__(self, head, floor: float, ramp: float) -> None:
        self.head, self.floor, self.ramp = head, floor, ramp
        self.near = np.zeros(0, bool)
        self.plane = np.zeros((0, 4))
        self._distance = np.zeros(0)
        self._seen_at = np.zeros((0, 3))

    def look(self, points: np.ndarray) -> np.ndarray:
        """Take the planes at `points` (M, 3); returns (M,) float64: how much of each point the scan can show, 0..1."""
        if len(self._seen_at) != len(points):
            stale = np.ones(len(points), bool)
            self._distance, self._seen_at = np.zeros(len(points)), points.copy()
        else:
            # The distance changes no faster than a point moves: far points need no second look until they may be near.
            moved = np.linalg.norm(points - self._seen_at, axis=1)
            stale = self._distance - moved < NEAR
        told = max(NEAR, self.floor + self.ramp)
        self._distance[stale] = self.head.signed_distance(points[stale].astype(np.float32), told)
        self._seen_at[stale] = points[stale]
        self.near = self._distance < NEAR
        self.plane = np.zeros((len(points), 4))
        rows = np.flatnonzero(self.near)
        normal = self.head.outward(points[rows])
        self.plane[rows, :3] = normal
        self.plane[rows, 3] = np.einsum("ij,ij->i", normal, points[rows]) - self._distance[rows]
        if self.floor <= 0.0:
            return np.ones(len(points))
        return np.clip((self._distance - self.floor) / self.ramp + 0.5, 0.0, 1.0)

    def push(self, points: np.ndarray, offsets: np.ndarray) -> None:
        """Move points inside the planes out of them, in place; roots stay."""
        keep_outside(points, offsets, self.near, self.plane, MARGIN)

    def raised(self, points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Points (M, 3), those by the roots of strands as high over the head as hair stands there (see the constants)."""
        points = np.array(points, np.float64)
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))[: len(points)]
        along -= np.repeat(along[offsets[:-1]], np.diff(offsets))
        rows = np.flatnonzero((along > 0.0) & (along < BESIDE))
        height = np.minimum(STANDS, LEAVES * np.minimum(along[rows], BESIDE - along[rows]))
        lack = height - np.asarray(self.head.signed_distance(points[rows].astype(np.float32), STANDS), np.float64)
        rows, lack = rows[lack > 0.0], lack[lack > 0.0]
        points[rows] += lack[:, None] * self.head.outward(points[rows])
        return points

    def clear(self, points: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, int]:
        """Points (M, 3) with none inside the head but roots, and how many were. Exact, by repeated pushes."""
        points = np.array(points, np.float64)
        root = np.zeros(len(points), bool)
        root[offsets[:-1]] = True
        rows = np.flatnonzero(~root)
        found = 0
        for attempt in range(LAST_PUSHES):
            distance = np.asarray(self.head.signed_distance(points[rows].astype(np.float32), MARGIN), np.float64)
            inside = distance < 0.5 * MARGIN
            rows, distance = rows[inside], distance[inside]
            found = found or len(rows)
            if not len(rows):
                break
            points[rows] += (MARGIN - distance + 0.02 * attempt)[:, None] * self.head.outward(points[rows])
        return points, found
