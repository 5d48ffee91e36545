"""The smallest eigenvector of a symmetric 3 x 3 matrix in closed form (eq. 2 without the SVD)."""

from __future__ import annotations

import numba
import numpy as np

SMALL = 1e-30


@numba.njit(cache=True, nogil=True)
def smallest_eigenvector(xx, xy, xz, yy, yz, zz):
    """(x, y, z, smallest, middle, largest): the unit eigenvector of the smallest eigenvalue, and the three eigenvalues.

    Trigonometric solution of the characteristic polynomial (Smith 1961), in float64; the vector is the largest cross
    product of two rows of `A - smallest I`. Where the two smallest are equal any vector of their plane may come back.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    scale = np.sqrt((a * a + b * b + c * c + 2.0 * off) / 6.0)
    if scale <= SMALL + 1e-9 * abs(mean):
        return 1.0, 0.0, 0.0, mean, mean, mean
    half = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2.0 * scale * scale * scale)
    angle = np.arccos(min(max(half, -1.0), 1.0)) / 3.0
    largest = mean + 2.0 * scale * np.cos(angle)
    smallest = mean + 2.0 * scale * np.cos(angle + 2.0 * np.pi / 3.0)
    middle = 3.0 * mean - largest - smallest
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    n0, n1, n2 = x0 * x0 + y0 * y0 + z0 * z0, x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2
    if n1 > n0 and n1 >= n2:
        x0, y0, z0, n0 = x1, y1, z1, n1
    elif n2 > n0:
        x0, y0, z0, n0 = x2, y2, z2, n2
    if n0 <= 1e-24 * scale**4:
        # The two smallest are equal: any vector across the largest's will do.
        return _across(xx - largest, xy, xz, yy - largest, yz, zz - largest, smallest, middle, largest)
    norm = 1.0 / np.sqrt(n0)
    return x0 * norm, y0 * norm, z0 * norm, smallest, middle, largest


@numba.njit(cache=True, nogil=True)
def _across(a, xy, xz, b, yz, c, smallest, middle, largest):
    """The first long enough row of `A - largest I`: it is normal to the largest's eigenvector."""
    n0, n1, n2 = a * a + xy * xy + xz * xz, xy * xy + b * b + yz * yz, xz * xz + yz * yz + c * c
    if n0 >= n1 and n0 >= n2:
        x, y, z, n = a, xy, xz, n0
    elif n1 >= n2:
        x, y, z, n = xy, b, yz, n1
    else:
        x, y, z, n = xz, yz, c, n2
    norm = 1.0 / np.sqrt(n)
    return x * norm, y * norm, z * norm, smallest, middle, largest
