"""Neighbouring curls brought into phase, so that blending them doesn't cancel them out (beyond the paper: it blends as found).

A strand's steps are parted into a slow course and a swing. The swing's analytic signal (Gabor 1946) gives its size and phase
along the strand; each neighbour's phase is turned, place by place, to the weighted mean of all, as a phase vocoder does.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter1d

SLOW_CYCLES = 2.0
"""What goes to and fro less often from root to tip is course; what goes more often is swing."""
WINDOW = 0.5
"""Gaussian over which phases are compared, in waves of the swing."""
LEAST_SWING = 0.15
"""A strand whose swing's root mean square is less than this share of its steps is smooth: blended as it is."""


def swing_share(shapes: np.ndarray) -> np.ndarray:
    """(N,) float32: root mean square of the swing over that of all steps, for shapes (N, P, 3)."""
    swing = _parted(_unit_steps(shapes)[0])[1]
    return np.sqrt((swing**2).sum(axis=2).mean(axis=1)).astype(np.float32)


def in_phase(shapes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Neighbours' shapes (M, k, P, 3) with their swings in phase: their weighted sum swings as much as they do.

    weights: (M, k), adding up to 1; column 0 is the nearest, whose phase the others' are measured against. A neighbour whose
    swing is not like the nearest's (wound the other way, say) is given the nearest's. The roots stay at 0.
    """
    steps, length = _unit_steps(shapes.reshape(-1, *shapes.shape[2:]))
    course, swing = _parted(steps)
    signal = _analytic(swing).reshape(*shapes.shape[:2], -1, 3)  # (M, k, T, 3) complex
    first = signal[:, :1]
    window = WINDOW * signal.shape[2] / _waves(signal)
    # One window for all: the median strand's. Kernels per strand would differ by little.
    width = float(np.median(window))
    product = gaussian_filter1d((signal * first.conj()).sum(axis=3), width, axis=2, mode="nearest")
    power = gaussian_filter1d((np.abs(signal) ** 2).sum(axis=3), width, axis=2, mode="nearest")
    likeness = np.abs(product) / np.maximum(np.sqrt(power * power[:, :1]), 1e-12)
    turn = product / np.maximum(np.abs(product), 1e-12)
    trust = np.clip((likeness - 0.3) / 0.4, 0.0, 1.0)
    mean = (weights[:, :, None] * trust * turn).sum(axis=1)
    mean /= np.maximum(np.abs(mean), 1e-12)
    brought = signal * (mean[:, None] * turn.conj() * trust)[..., None]
    brought += first * (mean[:, None] * (1.0 - trust))[..., None]
    steps = course.reshape(*signal.shape) + brought.real
    points = np.zeros(shapes.shape, np.float32)
    np.cumsum(steps * (length.reshape(shapes.shape[:2]) / steps.shape[2])[:, :, None, None], axis=2, out=points[:, :, 1:])
    return points


def _unit_steps(shapes):
    moves = np.diff(shapes.astype(np.float64), axis=1)
    length = np.linalg.norm(moves, axis=2).sum(axis=1)
    return moves * (moves.shape[1] / np.maximum(length, 1e-12))[:, None, None], length


def _parted(steps):
    """Course and swing (N, T, 3) of steps: the cosines up to SLOW_CYCLES, and the rest."""
    spectrum = scipy.fft.dct(steps, axis=1, norm="ortho")
    # faded over an octave: a sharp cut rings
    cycles = 0.5 * np.arange(steps.shape[1])
    fade = np.clip(1.5 - cycles / SLOW_CYCLES, 0.0, 1.0)
    course = scipy.fft.idct(spectrum * fade[:, None], axis=1, norm="ortho")
    return course, steps - course


def _analytic(swing):
    """Analytic signal of (N, T, 3), mirrored at its ends so that they don't jump."""
    count = swing.shape[1]
    mirrored = np.concatenate([swing, swing[:, ::-1]], axis=1)
    spectrum = scipy.fft.fft(mirrored, axis=1)
    spectrum[:, 1:count] *= 2.0
    spectrum[:, count + 1 :] = 0.0
    return scipy.fft.ifft(spectrum, axis=1)[:, :count]


def _waves(signal):
    """(M, k) waves along each swing: its phase's whole turn, weighted by its size."""
    advance = (signal[:, :, 1:] * signal[:, :, :-1].conj()).sum(axis=(2, 3))
    return np.maximum(np.abs(np.angle(advance)) * signal.shape[2] / (2.0 * np.pi), SLOW_CYCLES)
