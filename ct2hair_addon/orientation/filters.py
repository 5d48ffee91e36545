"""Separable filters over dense blocks, and the structure tensor made with them (paper 3.2.1, eq. 1).

Every pass is "valid": it returns only the voxels that it had all inputs for, so a block with a halo gives the very bits
that the whole volume would give.
"""

from __future__ import annotations

import numba
import numpy as np

TRUNCATE = 3.0
"""Taps reach this many standard deviations to each side."""


def gaussian_taps(sigma: float) -> np.ndarray:
    """(2 r + 1,) float32: a Gaussian of `sigma` voxels that sums to 1, r = ceil(3 sigma); [1] for sigma 0."""
    radius = int(np.ceil(TRUNCATE * sigma))
    if radius == 0:
        return np.ones(1, np.float32)
    at = np.arange(-radius, radius + 1)
    taps = np.exp(-0.5 * (at / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def derivative_taps(sigma: float) -> np.ndarray:
    """(2 r + 1,) float32: the derivative of that Gaussian, of gain 1 on a ramp; central differences for sigma 0."""
    radius = int(np.ceil(TRUNCATE * sigma))
    if radius == 0:
        return np.array([-0.5, 0.0, 0.5], np.float32)
    at = np.arange(-radius, radius + 1)
    taps = at * np.exp(-0.5 * (at / sigma) ** 2)
    return (taps / (taps * at).sum()).astype(np.float32)


def box_taps(radius: int) -> np.ndarray:
    """(2 r + 1,) float32: a box that sums to 1."""
    return np.full(2 * radius + 1, 1.0 / (2 * radius + 1), np.float32)


@numba.njit(cache=True, nogil=True)
def filter_z(block, taps, out):
    """The correlation of `block` with `taps` along z into `out`, which is shorter along z by len(taps) - 1."""
    out[:] = 0.0
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            row, target = block[i, j], out[i, j]
            for t in range(len(taps)):
                weight = taps[t]
                for k in range(len(target)):
                    target[k] += weight * row[k + t]


@numba.njit(cache=True, nogil=True)
def filter_y(block, taps, out):
    """The same along y."""
    out[:] = 0.0
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            target = out[i, j]
            for t in range(len(taps)):
                weight = taps[t]
                row = block[i, j + t]
                for k in range(len(target)):
                    target[k] += weight * row[k]


@numba.njit(cache=True, nogil=True)
def filter_x(block, taps, out):
    """The same along x."""
    out[:] = 0.0
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            target = out[i, j]
            for t in range(len(taps)):
                weight = taps[t]
                row = block[i + t, j]
                for k in range(len(target)):
                    target[k] += weight * row[k]


# Each filter is called in one place of a function: numba puts its code wherever it is called, and compiles all of that.


@numba.njit(cache=True, nogil=True)
def gradients(block, smooth, slope):
    """(4, ...) the gradient (eq. 1) along x, y and z, and the smoothed block, shorter by len(taps) - 1 along each axis.

    `smooth` and `slope` must have one length: `smooth` is padded by the caller where it is shorter.
    """
    reach = len(smooth) - 1
    nx, ny, nz = block.shape
    taps = (smooth, slope)
    in_z = np.empty((2, nx, ny, nz - reach), np.float32)  # smoothed, derived
    for n in range(2):
        filter_z(block, taps[n], in_z[n])
    in_yz = np.empty((3, nx, ny - reach, nz - reach), np.float32)  # smoothed, derived along y, along z
    for n in range(3):
        filter_y(in_z[n // 2], taps[n % 2], in_yz[n])
    out = np.empty((4, nx - reach, ny - reach, nz - reach), np.float32)
    for n in range(4):
        filter_x(in_yz[n % 3], taps[1 if n == 0 else 0], out[n])
    return out


@numba.njit(cache=True, nogil=True)
def tensor(gradient, window):
    """(6, ...) xx, xy, xz, yy, yz, zz: the outer products of `gradient` (3 or more, ...), weighted by `window` along each axis
    and summed."""
    _, nx, ny, nz = gradient.shape
    reach = len(window) - 1
    in_z = np.empty((nx, ny, nz - reach), np.float32)
    in_yz = np.empty((nx, ny - reach, nz - reach), np.float32)
    out = np.empty((6, nx - reach, ny - reach, nz - reach), np.float32)
    c = 0
    for a in range(3):
        for b in range(a, 3):
            filter_z(gradient[a] * gradient[b], window, in_z)
            filter_y(in_z, window, in_yz)
            filter_x(in_yz, window, out[c])
            c += 1
    return out


def noise_gain(smooth: np.ndarray, slope: np.ndarray) -> float:
    """The variance of one gradient component in white noise of variance 1. By symmetry such noise adds this much to each
    diagonal entry of the tensor and nothing to the others: it moves eigenvalues, never eigenvectors."""
    return float((slope.astype(np.float64) ** 2).sum() * (smooth.astype(np.float64) ** 2).sum() ** 2)
