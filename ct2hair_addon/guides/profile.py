"""What one strand looks like in this scan: peak and width of a lone strand's cross-section, and the noise beside it."""

from __future__ import annotations

import numba
import numpy as np

from ..volume.grid import BrickVolume, voxel
from ..volume.strand_signal import TYPICAL_BLUR, StrandProfile, alone
from .sampling import centred

BINS = 16
BIN = 0.25
"""voxel; radial bins of the mean cross-section."""
ALONG = 4
"""voxel; half the length of hair that is averaged for one candidate."""
LONE_SHARE = 0.05
"""The share of the candidates, emptiest surroundings first, that is taken for lone strands."""
FAINTER = (5.0, 40.0)
"""Percentiles of the lone candidates' density that are averaged."""
CENTRING = 0.25
"""voxel; how far candidates' centres are off along each axis of the plane: it widens their mean cross-section, the mass
kept."""


def strand_profile(
    density: BrickVolume, hair_level: float, voxels: np.ndarray, directions: np.ndarray, peak: float = 0.0
) -> StrandProfile:
    """Measure the profile at candidate voxels (M, 3) with unit directions (M, 3).

    Of the candidates, those with the emptiest surroundings (two to four voxels off the line) are lone strands; their
    mean cross-section is fitted. Where the hair is too thick for any, `peak` (a lone strand's by the thresholds) or, where that
    is not known, the thinnest tenth stands in, with the usual blur.
    """
    return alone(_measured(density, hair_level, voxels, directions), peak, density.spacing)


def _measured(density: BrickVolume, hair_level: float, voxels: np.ndarray, directions: np.ndarray) -> StrandProfile:
    """`strand_profile` by the scan alone."""
    if len(voxels) == 0:
        return StrandProfile.gaussian(max(2.0 * hair_level, 1e-6), TYPICAL_BLUR, density.spacing)
    sums, counts = _cross_sections(density.table, density.bricks, voxels.astype(np.float64), directions.astype(np.float64))
    inner, outer = slice(0, 4), slice(10, BINS)
    centre = sums[:, inner].sum(1) / np.maximum(counts[:, inner].sum(1), 1)
    around = np.abs(sums[:, outer].sum(1)) / np.maximum(counts[:, outer].sum(1), 1)
    good = centre > hair_level
    if good.sum() < 10:
        return StrandProfile.gaussian(max(float(centre.max()), hair_level), TYPICAL_BLUR, density.spacing)
    emptiness = np.where(good, around / np.maximum(centre, 1e-9), np.inf)
    chosen = np.argsort(emptiness, kind="stable")[: max(int(LONE_SHARE * good.sum()), 10)]
    # Two strands on top of each other look as lone as one, only brighter: the fainter part of what is left.
    faint, bright = np.percentile(centre[chosen], FAINTER)
    chosen = chosen[(centre[chosen] >= faint) & (centre[chosen] <= bright)]
    section = sums[chosen].sum(0) / np.maximum(counts[chosen].sum(0), 1)
    radius = (np.arange(BINS) + 0.5) * BIN
    fit = (section > 0.15 * section[0]) & (radius < 2.0)
    if fit.sum() >= 4 and np.median(emptiness[chosen]) < 0.25:
        slope, level = np.polyfit(radius[fit] ** 2, np.log(section[fit]), 1, w=section[fit])
        if slope < 0:
            wide = -0.5 / slope
            square = max(wide - CENTRING**2, 0.3)
            if square <= 6.0:
                return StrandProfile.gaussian(np.exp(level) * wide / square, np.sqrt(square), density.spacing, len(chosen))
    thin = np.percentile(centre[good], 10)
    return StrandProfile.gaussian(thin, TYPICAL_BLUR, density.spacing)


@numba.njit(cache=True, parallel=True)
def _cross_sections(table, bricks, voxels, directions):
    """(M, BINS) sums and counts of the voxels by distance from the line through each (centred) candidate."""
    sums = np.zeros((len(voxels), BINS))
    counts = np.zeros((len(voxels), BINS))
    for n in numba.prange(len(voxels)):
        x, y, z = voxels[n]
        dx, dy, dz = directions[n]
        for _ in range(3):
            x, y, z, _value = centred(table, bricks, x, y, z, dx, dy, dz, ALONG, 0.7)
        reach = ALONG + 2
        ci, cj, ck = int(np.rint(x)), int(np.rint(y)), int(np.rint(z))
        for i in range(ci - reach, ci + reach + 1):
            for j in range(cj - reach, cj + reach + 1):
                for k in range(ck - reach, ck + reach + 1):
                    along = (i - x) * dx + (j - y) * dy + (k - z) * dz
                    if abs(along) > ALONG:
                        continue
                    off = (i - x) ** 2 + (j - y) ** 2 + (k - z) ** 2 - along * along
                    slot = int(np.sqrt(max(off, 0.0)) / BIN)
                    if slot < BINS:
                        sums[n, slot] += voxel(table, bricks, np.float32(0.0), i, j, k)
                        counts[n, slot] += 1.0
    return sums, counts
