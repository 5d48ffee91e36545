"""Guide strands in motion: position-based dynamics of single strands that keep their length, their style and out of the head.

Verlet integration with local shape constraints (Han and Harada 2012, "Real-time Hair Simulation with Efficient Hair Style
Preservation") and position-based lengths (Mueller et al. 2007). No strand knows another. Blender's own hair dynamics are not
used: with a colliding head under it, 4.5's particle hair was 17 m long ten frames on. This module knows no Blender.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..head import Head, HeadMesh
from ..settings import SimulationSettings

SUBSTEPS = 8
"""Steps a frame at 24 frames a second: a tip that moves 5 m/s then goes less than a strand's edge in one."""
ITERATIONS = 2
"""Rounds over the constraints a step."""
FIXED = 2
"""Points of each strand that the head carries: the root, and the next, so that hair keeps the angle it grows at."""
GRID = 2.0
"""Spacing of the table of distances to the head, mm."""
REACH = 12.0
"""How far round the head the table goes, mm: farther out nothing collides."""
CLEARANCE = 0.3
"""Simulated points keep this far off the skin, mm, so that hair between them does not cut through it."""
GLIDE = 0.3
"""Share of its motion along the skin that a touching point keeps in a step: hair on skin hardly slides."""


@dataclass(frozen=True)
class Obstacle:
    """A head as a table of signed distances: low (3,) mm, spacing mm, distance (X, Y, Z) float32 mm, negative inside."""

    low: np.ndarray
    spacing: float
    distance: np.ndarray

    @classmethod
    def around(cls, mesh: HeadMesh) -> Obstacle:
        """The table of a head in its own frame, yet to be filled."""
        vertices = mesh.vertices.astype(np.float64)
        low = vertices.min(axis=0) - REACH
        size = np.ceil((vertices.max(axis=0) + REACH - low) / GRID).astype(int) + 1
        return cls(low, GRID, np.full(size, np.nan, np.float32))

    @classmethod
    def of(cls, head: Head) -> Obstacle:
        """The table of `head`, in its own frame."""
        table = cls.around(head.mesh)
        table.fill(head, 0, len(table.distance))
        return table

    def fill(self, head: Head, first: int, last: int) -> None:
        """Measure the layers `first` to `last` across x: all of them take seconds."""
        layers = self.distance[first:last]
        nodes = np.indices(layers.shape).reshape(3, -1).T * GRID + self.low
        nodes[:, 0] += first * GRID
        layers[:] = head.signed_distance(nodes).reshape(layers.shape)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """(M,) float64 mm at points (M, 3) in the head's frame; `REACH` outside the table."""
        return _distances(np.ascontiguousarray(points, np.float64), self.low, self.spacing, self.distance)


class Simulation:
    """Strands of equally many points under way: `step` takes them on by one frame.

    rest: (N, P, 3) mm where they would stand by themselves, in the world; the first `FIXED` points always do.
    """

    def __init__(self, rest: np.ndarray, settings: SimulationSettings) -> None:
        self.settings = settings
        self.rest = np.array(rest, np.float64)
        self.points = self.rest.copy()
        self._before = self.rest.copy()

    def step(self, rest: np.ndarray, obstacle: Obstacle, head_to_world: np.ndarray, seconds: float, gravity) -> np.ndarray:
        """The points (N, P, 3), mm, `seconds` later.

        rest: as in the constructor, at the end of the step. obstacle: the head, in its own frame; head_to_world: its place
        then, 4 x 4, rigid, mm. gravity: (3,) m/s^2, in the world.
        """
        chosen = self.settings
        rest = np.ascontiguousarray(rest, np.float64)
        _advance(
            self.points,
            self._before,
            self.rest,
            rest,
            obstacle.low,
            obstacle.spacing,
            obstacle.distance,
            np.ascontiguousarray(head_to_world[:3, :3], np.float64),
            np.ascontiguousarray(head_to_world[:3, 3], np.float64),
            seconds / SUBSTEPS,
            1000.0 * chosen.gravity * np.asarray(gravity, np.float64),
            1000.0 * np.array([chosen.wind_x, chosen.wind_y, chosen.wind_z]),
            chosen.drag,
            chosen.stiffness,
            chosen.hold,
        )
        self.rest = rest
        return self.points


@numba.njit(cache=True, inline="always")
def _sampled(low, spacing, table, x, y, z):
    """(distance, gradient x, y, z) of the table at a point of the head's frame, trilinear."""
    u, v, w = (x - low[0]) / spacing, (y - low[1]) / spacing, (z - low[2]) / spacing
    i, j, k = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
    if i < 0 or j < 0 or k < 0 or i + 1 >= table.shape[0] or j + 1 >= table.shape[1] or k + 1 >= table.shape[2]:
        return REACH, 0.0, 0.0, 0.0
    u, v, w = u - i, v - j, w - k
    value = gx = gy = gz = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                d = table[i + a, j + b, k + c]
                fu, fv, fw = (u if a else 1 - u), (v if b else 1 - v), (w if c else 1 - w)
                value += d * fu * fv * fw
                gx += (d if a else -d) * fv * fw
                gy += (d if b else -d) * fu * fw
                gz += (d if c else -d) * fu * fv
    return value, gx / spacing, gy / spacing, gz / spacing


@numba.njit(cache=True, parallel=True, nogil=True)
def _distances(points, low, spacing, table):
    out = np.empty(len(points))
    for m in numba.prange(len(points)):
        out[m] = _sampled(low, spacing, table, points[m, 0], points[m, 1], points[m, 2])[0]
    return out


@numba.njit(cache=True)
def _turn(frame, a, b):
    """Turn `frame` (3, 3) by the least rotation that takes direction a to direction b; opposite directions leave it."""
    la, lb = np.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2), np.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    if la < 1e-9 or lb < 1e-9:
        return
    a, b = a / la, b / lb
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if cosine < -0.9999:
        return
    axis = np.cross(a, b)
    factor = 1.0 / (1.0 + cosine)
    for column in range(3):
        v = frame[:, column].copy()
        along = np.cross(axis, v)
        # Rodrigues' formula with sine and cosine taken from the cross and dot products
        frame[:, column] = v + along + factor * np.cross(axis, along)


@numba.njit(cache=True)
def _keep_style(x, rest, stiffness):
    """Draw each edge of a strand towards the direction that it has at rest, as seen from the edge before it."""
    frame = np.eye(3)
    for i in range(1, len(x) - 1):
        _turn(frame, frame @ (rest[i] - rest[i - 1]), x[i] - x[i - 1])
        missing = x[i] + frame @ (rest[i + 1] - rest[i]) - x[i + 1]
        if i >= FIXED:
            x[i + 1] += 0.5 * stiffness * missing
            x[i] -= 0.5 * stiffness * missing
        else:
            x[i + 1] += stiffness * missing


@numba.njit(cache=True)
def _keep_lengths(x, rest):
    """Set every edge of a strand to its length at rest, from the root on."""
    for i in range(FIXED, len(x)):
        edge, wanted = x[i] - x[i - 1], rest[i] - rest[i - 1]
        length = np.sqrt(edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2)
        if length > 1e-9:
            x[i] = x[i - 1] + edge * (np.sqrt(wanted[0] ** 2 + wanted[1] ** 2 + wanted[2] ** 2) / length)


@numba.njit(cache=True)
def _keep_out(x, before, low, spacing, table, rotation, shift):
    """Move the free points of a strand out of the head, and let them hardly slide on it."""
    for i in range(FIXED, len(x)):
        p = rotation.T @ (x[i] - shift)
        d, gx, gy, gz = _sampled(low, spacing, table, p[0], p[1], p[2])
        norm = np.sqrt(gx * gx + gy * gy + gz * gz)
        if d < CLEARANCE and norm > 1e-6:
            x[i] += rotation @ np.array([gx, gy, gz]) * ((CLEARANCE - d) / norm)
            before[i] = x[i] - GLIDE * (x[i] - before[i])


@numba.njit(cache=True, parallel=True, nogil=True)
def _advance(
    points, before, rest_then, rest_now, low, spacing, table, rotation, shift, dt, gravity, wind, drag, stiffness, hold
):
    """All strands by one frame of `SUBSTEPS` steps of `dt` seconds; `points` and `before` (a step ago) are changed."""
    drawn_along = 1.0 - np.exp(-drag * dt)  # share of its speed against the air that a point loses in a step
    drawn_home = 1.0 - np.exp(-hold * dt)
    for n in numba.prange(len(points)):
        x, old = points[n], before[n]
        rest = np.empty_like(x)
        for step in range(1, SUBSTEPS + 1):
            share = step / SUBSTEPS
            rest[:] = (1.0 - share) * rest_then[n] + share * rest_now[n]
            for i in range(len(x)):
                if i < FIXED:
                    x[i] = rest[i]
                    old[i] = rest[i]
                    continue
                moved = x[i] - old[i]
                moved += (wind * dt - moved) * drawn_along
                old[i] = x[i]
                x[i] += moved + gravity * dt * dt + (rest[i] - x[i]) * drawn_home
            for _ in range(ITERATIONS):
                _keep_style(x, rest, stiffness)
                _keep_lengths(x, rest)
                _keep_out(x, old, low, spacing, table, rotation, shift)
