"""How strongly hair bends, by the length of its waves: whether a result keeps its curls, and what waves it adds."""

from __future__ import annotations

import numpy as np

from ..strands import Strands
from .curves import sample_curves

BANDS = ((10.0, 25.0), (25.0, 60.0), (60.0, 150.0))
"""Wavelengths, mm of hair: shorter ones are the corners of polylines, longer ones the shape of the head."""
STEP = 1.0
"""mm; curvature is taken from points so far apart along the smooth curves."""
LEAST = 16
"""Points of the shortest strand that is asked."""
_ROWS = 512


def curvature_spectrum(strands: Strands) -> dict[str, float]:
    """The root mean square of the strands' curvature, 1/m, in each of BANDS: {"10-25": ..}.

    strands: mm. Each strand's curvature vector is Hann-windowed over its length; strands count by their length, ones shorter
    than 16 mm not at all.
    """
    samples = sample_curves(Strands(strands.points, strands.offsets), STEP)
    samples = samples.select(samples.counts >= LEAST)
    power, length = np.zeros(len(BANDS)), 0.0
    by_size = np.argsort(samples.counts, kind="stable")
    for at in range(0, len(by_size), _ROWS):
        some = samples.select(by_size[at : at + _ROWS])
        counts = some.counts - 2
        power += (band_powers(_padded_curvature(some, counts), STEP, counts) * counts[:, None]).sum(axis=0)
        length += float(counts.sum())
    rms = 1000.0 * np.sqrt(power / max(length, 1.0))
    return {f"{low:g}-{high:g}": float(value) for (low, high), value in zip(BANDS, rms, strict=True)}


def band_powers(curvature: np.ndarray, step: float | np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(N, bands) mean squares of (N, P, 3) curvature vectors, 0 from `counts` (N,) on, in each of BANDS.

    step: mm between points, one for all or (N,).
    """
    place = np.arange(curvature.shape[1])
    window = np.sin(np.pi * (place + 0.5) / counts[:, None]) ** 2 * (place < counts[:, None])
    transformed = np.fft.rfft(curvature * window[:, :, None], axis=1)
    square = 2.0 * (np.abs(transformed) ** 2).sum(axis=2) / (curvature.shape[1] * (window**2).sum(axis=1)[:, None])
    frequency = np.fft.rfftfreq(curvature.shape[1]) / np.broadcast_to(step, len(counts))[:, None]
    inside = [(frequency > 1.0 / high) & (frequency <= 1.0 / low) for low, high in BANDS]
    return np.stack([(square * band).sum(axis=1) for band in inside], axis=1)


def _padded_curvature(samples: Strands, counts: np.ndarray) -> np.ndarray:
    """(N, P, 3) float64, 1/mm: second differences of points STEP apart, zeros after a strand's `counts` (N,)."""
    out = np.zeros((len(counts), max(int(counts.max()), int(4 * BANDS[-1][1] / STEP)), 3))
    points = samples.points.astype(np.float64)
    bend = (points[2:] - 2.0 * points[1:-1] + points[:-2]) / STEP**2
    owner = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    out[owner, place] = bend[samples.offsets[owner] + place]
    return out
