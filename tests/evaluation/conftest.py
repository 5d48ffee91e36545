"""A ball of 40 mm with its upper half for a scalp: the head of these tests, with every distance known."""

import numpy as np
import pytest

from ct2hair_addon.head import HeadMesh
from ct2hair_addon.strands import Strands

RADIUS = 40.0


@pytest.fixture(scope="session")
def ball() -> HeadMesh:
    rings, sides = 40, 64
    polar = np.pi * np.arange(1, rings) / rings
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack(
        [
            np.outer(np.sin(polar), np.cos(turn)),
            np.outer(np.sin(polar), np.sin(turn)),
            np.outer(np.cos(polar), np.ones(sides)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = RADIUS * np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]])
    here = np.arange((rings - 2) * sides).reshape(rings - 2, sides)
    right = np.roll(here, -1, axis=1)
    quads = np.stack([here, here + sides, right + sides, right], axis=-1).reshape(-1, 4)
    first, last = np.arange(sides), (rings - 2) * sides + np.arange(sides)
    top, bottom = len(vertices) - 2, len(vertices) - 1
    caps = [
        np.stack([np.full(sides, top), first, np.roll(first, -1)], axis=1),
        np.stack([np.full(sides, bottom), np.roll(last, -1), last], axis=1),
    ]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], *caps])
    scalp = vertices[:, 2] > -1e-3
    # Lambert's azimuthal projection: keeps areas, as the scalp texture nearly does
    planar = vertices[:, :2] / np.sqrt(np.maximum(RADIUS * (RADIUS + vertices[:, 2:]), 1e-9))
    uv = np.where(scalp[:, None], 0.5 + 0.48 * planar / np.abs(planar[scalp]).max(), np.nan)
    return HeadMesh(vertices, faces, scalp, uv)


@pytest.fixture(scope="session")
def spikes() -> Strands:
    """Straight strands of 20 mm standing on the ball's upper half."""
    generator = np.random.default_rng(3)
    direction = generator.normal(size=(300, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = np.linspace(RADIUS, RADIUS + 20.0, 6)
    return Strands.from_array((direction[:, None] * reach[None, :, None]).astype(np.float32))
