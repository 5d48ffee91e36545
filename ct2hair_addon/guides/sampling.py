"""Reads of the density and of the hair's course inside kernels."""

from __future__ import annotations

import numba
import numpy as np

from ..volume.grid import UNIT, trilinear


@numba.njit(cache=True, nogil=True, inline="always")
def density_at(table, bricks, x, y, z):
    """The trilinear density at continuous voxel indices, 0 off the bricks."""
    return trilinear(table, bricks, np.float32(0.0), x, y, z)


@numba.njit(cache=True, nogil=True)
def course_at(table, bricks, x, y, z):
    """(x, y, z, trust): the unit direction, sign without meaning, at the voxel nearest to (x, y, z), and 0 to 1; 0 off hair.

    bricks: int8 (B, 16, 16, 16, 3), vectors as long as they are trusted, UNIT at most.
    """
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
    return dx / length, dy / length, dz / length, length / UNIT


@numba.njit(cache=True, nogil=True)
def line_mean(table, bricks, x, y, z, dx, dy, dz, reach):
    """The mean density at the 2 reach + 1 points a voxel apart on the line through (x, y, z)."""
    total = 0.0
    for k in range(-reach, reach + 1):
        px, py, pz = x + k * dx, y + k * dy, z + k * dz
        total += density_at(table, bricks, px, py, pz)
    return total / (2 * reach + 1)


@numba.njit(cache=True, nogil=True)
def plane(dx, dy, dz):
    """Two unit vectors that span the plane normal to the unit vector d, as six numbers (u, v)."""
    if abs(dx) <= abs(dy) and abs(dx) <= abs(dz):
        ux, uy, uz = 0.0, dz, -dy
    elif abs(dy) <= abs(dz):
        ux, uy, uz = -dz, 0.0, dx
    else:
        ux, uy, uz = dy, -dx, 0.0
    norm = 1.0 / np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux * norm, uy * norm, uz * norm
    return ux, uy, uz, dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux


@numba.njit(cache=True, nogil=True)
def centred(table, bricks, x, y, z, dx, dy, dz, reach, most):
    """(x, y, z, value): the point moved to the peak of the density in the plane normal to d, by at most `most` voxels.

    The density is averaged over 2 reach + 1 points along d; the peak is that of a least-squares paraboloid
    through a 3 x 3 grid, or the grid's best point where the paraboloid has no peak nearby.
    """
    ux, uy, uz, vx, vy, vz = plane(dx, dy, dz)
    grid = 0.8
    sum_u = sum_v = sum_uu = sum_vv = sum_uv = total = 0.0
    best, at_u, at_v, middle = -1e30, 0.0, 0.0, 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            px, py, pz = x + grid * (a * ux + b * vx), y + grid * (a * uy + b * vy), z + grid * (a * uz + b * vz)
            value = line_mean(table, bricks, px, py, pz, dx, dy, dz, reach)
            total += value
            sum_u += a * value
            sum_v += b * value
            sum_uu += a * a * value
            sum_vv += b * b * value
            sum_uv += a * b * value
            if a == 0 and b == 0:
                middle = value
            if value > best:
                best, at_u, at_v = value, float(a), float(b)
    # Least squares of c + gu a + gv b + (huu a^2 + hvv b^2) / 2 + huv a b on the grid.
    gu, gv, huv = sum_u / 6.0, sum_v / 6.0, sum_uv / 4.0
    huu, hvv = sum_uu - 2.0 / 3.0 * total, sum_vv - 2.0 / 3.0 * total
    det = huu * hvv - huv * huv
    if huu < 0.0 and hvv < 0.0 and det > 0.0:
        su, sv = -(hvv * gu - huv * gv) / det, -(huu * gv - huv * gu) / det
        if su * su + sv * sv <= 2.0:
            at_u, at_v = su, sv
    length = grid * np.sqrt(at_u * at_u + at_v * at_v)
    scale = grid * (1.0 if length <= most else most / length)
    at_u, at_v = at_u * scale, at_v * scale
    return x + at_u * ux + at_v * vx, y + at_u * uy + at_v * vy, z + at_u * uz + at_v * vz, middle
