"""A ball of 80 mm with a cap of scalp, and guides on it that are all of one shape."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.head import Head
from ct2hair_addon.strands import Strands


@pytest.fixture(scope="session")
def head(make_ball) -> Head:
    return Head(make_ball(80.0, 10.0))


def arch(points: int = 40) -> np.ndarray:
    """(points, 3) mm in a root's frame: 50 mm out and over to one side, with a wave."""
    t = np.linspace(0.0, 1.0, points)
    return np.stack([22.0 * t**2, 2.0 * np.sin(7.0 * t), 50.0 * t - 14.0 * t**2], axis=1)


@pytest.fixture(scope="session")
def shape() -> np.ndarray:
    return arch()


@pytest.fixture(scope="session")
def guides(head, shape) -> Strands:
    """300 strands of that shape, each in its own root's frame, even over the scalp."""
    sample = head.sample_scalp(300, 1)
    frames = head.frames(sample.face, sample.bary).astype(np.float64)
    points = sample.position[:, None] + np.einsum("nij,pi->npj", frames, shape)
    support = np.random.default_rng(2).uniform(0.2, 1.0, 300).astype(np.float32)
    return Strands.from_array(points.astype(np.float32), support=support, root_uv=sample.uv)
