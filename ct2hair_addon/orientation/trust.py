"""How far a direction of the field is to be trusted, by its confidence: what tracing and the field after it both weigh by."""

from __future__ import annotations

import numba
import numpy as np

from ..volume.grid import BRICK, UNIT, BrickVolume

DOUBT = 0.05
"""A direction whose confidence falls short of 1 by so much counts half, and less as the square of its error does: against
the truth of made scans, directions of confidence 0.99 are 4 degrees off, of 0.95 6, of 0.85 12, of 0.65 22."""


@numba.njit(cache=True, nogil=True, inline="always")
def trust(confidence):
    """0 to 1: the weight of a direction of `confidence`, uint8, 0..255 for 0..1."""
    short = (1.0 - confidence / 255.0) / DOUBT
    return 1.0 / (1.0 + short * short)


def trusted(direction: BrickVolume, confidence: BrickVolume) -> BrickVolume:
    """int8 (B, 16, 16, 16, 3): the directions, UNIT times as long as each is trusted, 0 where there is none.

    direction: int8 (B, 16, 16, 16, 3) of any length; confidence: uint8 (B, 16, 16, 16), 0..255 for 0..1.
    """
    out = direction.like(np.int8, (3,))
    _scale(direction.bricks, confidence.bricks, out.bricks)
    return out


@numba.njit(cache=True, parallel=True)
def _scale(direction, confidence, out):
    for row in numba.prange(len(out)):
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    if confidence[row, i, j, k] == 0:
                        continue
                    d = direction[row, i, j, k]
                    x, y, z = float(d[0]), float(d[1]), float(d[2])
                    square = x * x + y * y + z * z
                    if square == 0.0:
                        continue
                    scale = UNIT * trust(confidence[row, i, j, k]) / np.sqrt(square)
                    out[row, i, j, k, 0] = np.int8(np.rint(scale * x))
                    out[row, i, j, k, 1] = np.int8(np.rint(scale * y))
                    out[row, i, j, k, 2] = np.int8(np.rint(scale * z))
