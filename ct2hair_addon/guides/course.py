"""The course of the hair at each voxel, for a trace to keep to: the orientation field's directions, as long as they are sure.

Among strands that touch, the density ahead is as high towards a neighbour as along the strand, and a trace hops over. The
field (paper 3.2.1), gathered over all hair around, shows which way the strand goes on.
"""

from __future__ import annotations

import numba
import numpy as np

from ..volume.grid import BRICK, BrickVolume

LENGTH = 127.0
"""A direction that is trusted wholly is so long in int8."""
DOUBT = 0.05
"""A direction whose confidence falls short of 1 by so much counts half, and less as the square of its error does: against
the truth of made scans, directions of confidence 0.99 are 4 degrees off, of 0.95 6, of 0.85 12, of 0.65 22."""


def hair_course(direction: BrickVolume, confidence: BrickVolume) -> BrickVolume:
    """int8 (B, 16, 16, 16, 3): the field's unit directions, LENGTH times as long as each is trusted, 0 where there is none.

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
                    short = (1.0 - confidence[row, i, j, k] / 255.0) / DOUBT
                    scale = LENGTH / (1.0 + short * short) / np.sqrt(square)
                    out[row, i, j, k, 0] = np.int8(np.rint(scale * x))
                    out[row, i, j, k, 1] = np.int8(np.rint(scale * y))
                    out[row, i, j, k, 2] = np.int8(np.rint(scale * z))


@numba.njit(cache=True, nogil=True)
def course_at(table, bricks, x, y, z):
    """(x, y, z, trust): the unit direction, sign without meaning, at the voxel nearest to (x, y, z), and 0 to 1; 0 off hair."""
    i, j, k = int(np.floor(x + 0.5)), int(np.floor(y + 0.5)), int(np.floor(z + 0.5))
    if i < 0 or j < 0 or k < 0:
        return 0.0, 0.0, 0.0, 0.0
    I, J, K = i >> 4, j >> 4, k >> 4
    if I >= table.shape[0] or J >= table.shape[1] or K >= table.shape[2]:
        return 0.0, 0.0, 0.0, 0.0
    row = table[I, J, K]
    if row < 0:
        return 0.0, 0.0, 0.0, 0.0
    d = bricks[row, i & 15, j & 15, k & 15]
    dx, dy, dz = float(d[0]), float(d[1]), float(d[2])
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return dx / length, dy / length, dz / length, length / LENGTH
