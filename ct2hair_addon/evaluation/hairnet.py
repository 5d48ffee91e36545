"""The base that a wig is knotted into: a hairnet over the scalp and a knot at every root (supplement, section 1).

Both are strands themselves, of hair's own thickness, so that the same blurred counts make them into a scan.
"""

from __future__ import annotations

import numpy as np

from ..head import Head
from ..strands import Strands

WAVE = 6.0
"""Wavelength of the net's height over the scalp, in meshes."""

_POINTS_PER_EDGE = 6


def hairnet(head: Head, cell: float, height: float, seed: int) -> Strands:
    """The threads of a hexagonal net over the scalp, one short strand an edge of a mesh.

    cell: width of a mesh (between opposite sides), mm; height: threads wave between 0 and this over the scalp, mm.
    The net lies in the scalp's texture, which is near free of distortion, and is lifted onto the head (its frame, mm).
    """
    generator = np.random.default_rng(seed)
    # texture units per mm: the texture keeps areas up to one factor
    corners = head.mesh.uv[head.mesh.faces[head.mesh.scalp_faces]].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    unit = np.sqrt(area / head.scalp_area)
    step = cell * unit
    start, end = _hexagon_edges(step)
    angle = generator.uniform(0.0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    t = np.linspace(0.0, 1.0, _POINTS_PER_EDGE)[None, :, None]
    uv = (start[:, None] * (1.0 - t) + end[:, None] * t) @ turn + 0.5
    on = head.on_scalp(uv.reshape(-1, 2))
    kept = on.valid.reshape(uv.shape[:2]).all(axis=1)
    phase = generator.uniform(0.0, 2.0 * np.pi, 4)
    wave = uv.reshape(-1, 2) * (2.0 * np.pi / (WAVE * step))
    lift = 0.5 + 0.25 * (np.sin(wave[:, 0] + phase[0]) + np.sin(wave[:, 1] + phase[1]))
    points = on.position + on.normal * (height * lift)[:, None].astype(np.float32)
    return Strands.from_array(points.reshape(*uv.shape[:2], 3)[kept])


def knots(roots: np.ndarray, spacing: float, level: float, blur: float, seed: int) -> Strands:
    """A small tangle of hair at each root (N, 3): loops whose blurred count peaks at `level` lone strands.

    Loops have a radius of 0.4 voxel, so that a knot is a blob of the size of the blur; spacing: mm; blur: voxels.
    """
    generator = np.random.default_rng(seed)
    radius = 0.4
    # a blob of n points with the loop's and the blur's variance peaks at n / (2 pi s^2)^(3/2); a strand at 2 / (2 pi blur^2)
    variance = blur * blur + 1.0 / 12.0 + radius * radius / 3.0
    points = level * 2.0 / (2.0 * np.pi * blur * blur) * (2.0 * np.pi * variance) ** 1.5
    turns = 0.5 * points / (2.0 * np.pi * radius)
    size = max(int(np.ceil(turns * 8)), 8) + 1
    angle = np.linspace(0.0, 2.0 * np.pi * turns, size)[None, :]
    # the loop's plane turns as it goes round, which winds it into a ball
    axis = generator.normal(size=(len(roots), 2, 3))
    first = axis[:, 0] / np.linalg.norm(axis[:, 0], axis=1, keepdims=True)
    second = axis[:, 1] - (axis[:, 1] * first).sum(axis=1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    third = np.cross(first, second)
    tilt = angle * 0.31
    along, across = np.cos(angle), np.sin(angle)
    ball = (
        first[:, None] * (along * np.ones_like(tilt))[..., None]
        + second[:, None] * (across * np.cos(tilt))[..., None]
        + third[:, None] * (across * np.sin(tilt))[..., None]
    )
    return Strands.from_array((roots[:, None] + radius * spacing * ball).astype(np.float32))


def _hexagon_edges(width: float) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2), (E, 2): the edges of regular hexagons of this width covering the square of edge 1.5 around 0."""
    side = width / np.sqrt(3.0)
    count = int(np.ceil(0.75 * np.sqrt(2.0) / width)) + 1
    row, column = np.meshgrid(np.arange(-count, count + 1), np.arange(-count, count + 1), indexing="ij")
    x = (column + 0.5 * (row % 2)) * width
    y = row * 1.5 * side
    centre = np.stack([x.ravel(), y.ravel()], axis=1)
    # three of a hexagon's six edges each: its neighbours have the others
    corner = np.array([[0.0, side], [0.5 * width, 0.5 * side], [0.5 * width, -0.5 * side], [0.0, -side]])
    start = np.concatenate([centre + corner[0], centre + corner[1], centre + corner[2]])
    end = np.concatenate([centre + corner[1], centre + corner[2], centre + corner[3]])
    inside = (np.abs(start) < 0.75).all(axis=1)
    return start[inside], end[inside]
