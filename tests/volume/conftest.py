"""What the volume tests share: a small phantom that tells every axis and direction apart, and a ball with hair on it."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.head import HeadMesh
from ct2hair_addon.strands import Strands

SHAPE = (5, 4, 6)


@pytest.fixture(scope="session")
def phantom() -> np.ndarray:
    """(5, 4, 6) int16 [x, y, z]: another size along each axis, another value (1 to 120, so that every type holds it) at
    each voxel and so at each corner."""
    x, y, z = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    return (1 + x + 5 * y + 20 * z).astype(np.int16)


RADIUS = 40.0


@pytest.fixture(scope="session")
def ball(make_ball) -> HeadMesh:
    """The mannequin of these scans: a ball of 40 mm with its upper half for a scalp."""
    return make_ball(RADIUS)


@pytest.fixture(scope="session")
def spikes() -> Strands:
    """1000 slightly bent strands of about 40 mm that stand on the ball's upper half, some of them close together."""
    generator = np.random.default_rng(3)
    direction = generator.normal(size=(1000, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    t = np.linspace(0.0, 1.0, 20)[None, :, None]
    bend = generator.normal(0.0, 8.0, (1000, 1, 3))
    return Strands.from_array((direction[:, None] * (RADIUS + 40.0 * t) + bend * t**2).astype(np.float32))
