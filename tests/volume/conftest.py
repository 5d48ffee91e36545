"""A small phantom that tells every axis and direction apart, as the reader and writer tests share it."""

from __future__ import annotations

import numpy as np
import pytest

SHAPE = (5, 4, 6)


@pytest.fixture(scope="session")
def phantom() -> np.ndarray:
    """(5, 4, 6) int16 [x, y, z]: another size along each axis, another value (1 to 120, so that every type holds it) at
    each voxel and so at each corner."""
    x, y, z = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    return (1 + x + 5 * y + 20 * z).astype(np.int16)
