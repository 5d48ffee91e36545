"""What all tests share: the engine on the path, OpenVDB from bpy, a ball for a head, and where the reference data lies."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real reference data, outside the project; the test skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference data is not on this machine ({SHARED})")
    return SHARED


@pytest.fixture(scope="session")
def make_ball() -> Callable:
    """Makes a head of which every distance is known: a ball round the origin, its scalp the vertices above a height, mm."""
    from ct2hair_addon.head import HeadMesh

    def make(radius: float, scalp_over: float = -1e-3, rings: int = 40, sides: int = 64) -> HeadMesh:
        polar, turn = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(sides) / sides
        east, north = np.outer(np.sin(polar), np.cos(turn)), np.outer(np.sin(polar), np.sin(turn))
        ring = np.stack([east, north, np.outer(np.cos(polar), np.ones(sides))], axis=-1).reshape(-1, 3)
        vertices = radius * np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]])
        here = np.arange((rings - 1) * sides).reshape(rings - 1, sides)
        right = np.roll(here, -1, axis=1)
        quads = np.stack([here[:-1], here[1:], right[1:], right[:-1]], axis=-1).reshape(-1, 4)
        top, bottom = np.full(sides, len(ring)), np.full(sides, len(ring) + 1)
        caps = [np.stack([top, here[0], right[0]], axis=1), np.stack([bottom, right[-1], here[-1]], axis=1)]
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], *caps])
        return HeadMesh(vertices, faces, vertices[:, 2] > scalp_over, np.full((len(vertices), 2), np.nan))

    return make
