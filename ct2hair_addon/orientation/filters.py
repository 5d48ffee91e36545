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
def filter_z(block, taps):
    """The correlation of `block` with `taps` along z; shorter along z by len(taps) - 1."""
    nx, ny, nz = block.shape[0], block.shape[1], block.shape[2] - len(taps) + 1
    out = np.zeros((nx, ny, nz), np.float32)
    for i in range(nx):
        for j in range(ny):
            row, target = block[i, j], out[i, j]
            for t in range(len(taps)):
                weight = taps[t]
                for k in range(nz):
                    target[k] += weight * row[k + t]
    return out


@numba.njit(cache=True, nogil=True)
def filter_y(block, taps):
    """The same along y."""
    nx, ny, nz = block.shape[0], block.shape[1] - len(taps) + 1, block.shape[2]
    out = np.zeros((nx, ny, nz), np.float32)
    for i in range(nx):
        for j in range(ny):
            target = out[i, j]
            for t in range(len(taps)):
                weight = taps[t]
                row = block[i, j + t]
                for k in range(nz):
                    target[k] += weight * row[k]
    return out


@numba.njit(cache=True, nogil=True)
def filter_x(block, taps):
    """The same along x."""
    nx, ny, nz = block.shape[0] - len(taps) + 1, block.shape[1], block.shape[2]
    out = np.zeros((nx, ny, nz), np.float32)
    for i in range(nx):
        for j in range(ny):
            target = out[i, j]
            for t in range(len(taps)):
                weight = taps[t]
                row = block[i + t, j]
                for k in range(nz):
                    target[k] += weight * row[k]
    return out


@numba.njit(cache=True, nogil=True)
def gradients(block, smooth, slope):
    """The gradient (eq. 1) and the smoothed block, four arrays shorter by len(taps) - 1 along each axis.

    `smooth` and `slope` must have one length: `smooth` is padded by the caller where it is shorter.
    """
    in_z, slope_z = filter_z(block, smooth), filter_z(block, slope)
    in_yz = filter_y(in_z, smooth)
    along_z = filter_x(filter_y(slope_z, smooth), smooth)
    along_y = filter_x(filter_y(in_z, slope), smooth)
    return filter_x(in_yz, slope), along_y, along_z, filter_x(in_yz, smooth)


@numba.njit(cache=True, nogil=True)
def tensor(gx, gy, gz, window):
    """(6, ...) xx, xy, xz, yy, yz, zz: the outer products of the gradients, weighted by `window` along each axis and summed."""
    nx, ny, nz = gx.shape
    reach = len(window) - 1
    out = np.empty((6, nx - reach, ny - reach, nz - reach), np.float32)
    for c in range(6):
        a = gx if c < 3 else (gy if c < 5 else gz)
        b = gx if c == 0 else (gy if c == 1 or c == 3 else gz)
        out[c] = filter_x(filter_y(filter_z(a * b, window), window), window)
    return out


def noise_gain(smooth: np.ndarray, slope: np.ndarray) -> float:
    """The variance of one gradient component in white noise of variance 1. By symmetry such noise adds this much to each
    diagonal entry of the tensor and nothing to the others: it moves eigenvalues, never eigenvectors."""
    return float((slope.astype(np.float64) ** 2).sum() * (smooth.astype(np.float64) ** 2).sum() ** 2)
