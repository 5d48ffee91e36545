"""Strands taken away, whole or from the tip, where they explain nothing of the scan: the count comes from the scan.

Removing a stretch of a strand changes half the squared misfit by the integral of `1/2 - a` along it, in units of a lone
strand's energy, where `a` is how much of a strand is rendered there too many (the misfit's amplitude under a strand's
profile): 0 where the strand is needed, 1 where it doubles another. What is best kept is the prefix from the root that
earns most. A strand that was traced has its evidence in the scan, and one that lies a voxel beside its hair looks half a
double: such a strand stays whole unless it doubles others all along.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from ..progress import Progress, part, silent
from ..volume import BrickVolume
from ..volume.grid import trilinear, voxel
from ..volume.strand_signal import INTERPOLATION_VARIANCE, StrandProfile, add_strand
from .blur import CHUNK, blurred
from .curves import SAMPLES_PER_VOXEL, segment_samples, spline, spline_at
from .splat import render

LEAST_EARNED = 8.0
"""voxel; a strand that earns less than so much of a lone strand's length is left out."""
DOUBLE = 0.8
"""A traced strand goes where so much of a strand is too many in the mean along it."""
LEAST_CUT = 6.0
"""voxel; a tip is cut only where that earns as much."""
BARE = 0.4
"""The scan shows no hair where it stays below this share of a lone strand's peak."""
BARE_COST = 1.0
"""What a stretch where the scan shows no hair costs beside its misfit: amid dense hair any strand earns something."""
REMOVED = "strands removed: the scan has them already"
CUT_BACK = "tips cut back"
BLOBS = 1.7
"""Points within a blur that a strand taken out is made of: the tube to a thousandth, its ends to a hundredth."""
RING = 1.0
"""voxel; the misfit is read on the centre line and on four points this far from it."""


def prune(
    points: np.ndarray,
    offsets: np.ndarray,
    visible: np.ndarray,
    density: BrickVolume,
    profile: StrandProfile,
    progress: Progress = silent,
    reach: float = 0.0,
    traced: np.ndarray | None = None,
    fewest: int = 0,
) -> tuple[np.ndarray, dict[str, int]]:
    """(N,) int64: how many control points of each strand stay, 0 for none; and the counts of what went.

    points (M, 3) mm, root first, offsets (N + 1,), visible (M,) 0..1 as in `splat.render`. Strands are judged one after
    another, those that earn least first, each against what the others before it have left; the same on any number of threads.
    reach: voxels by which strands may still be off: scan and rendering are blurred by as much before they are held together,
    so that one beside hair that nothing else explains is kept. traced: (N,) bool, strands that were found in the scan
    (None: none was); the others are made up. fewest: no traced strand goes where no more than so many are left: they are known
    to be there, and in a bundle one that takes another's place looks like a double.
    """
    counts = np.diff(offsets)
    kept = counts.copy()
    if not len(counts):
        return kept, {REMOVED: 0, CUT_BACK: 0}
    voxels = density.to_voxel(points)
    excess, mark = excess_of(voxels, offsets, visible, density, profile, reach, part(progress, 0.0, 0.7))
    bare = 0.0 if reach else BARE * mark.peak
    earned, shown, _ = earnings(density.table, excess, density.bricks, bare, voxels, offsets, visible, mark.peak, mark.seen)
    progress(0.8, 1.0)
    traced = np.zeros(len(counts), bool) if traced is None else np.asarray(traced, bool)
    # what goes makes the others earn more: a strand that stays as it is now needs no second look
    order = np.argsort(earned, kind="stable")
    order = order[~traced[order] | (earned[order] < (0.5 - DOUBLE) * shown[order])]
    left, step = np.array([np.count_nonzero(counts)]), 2000
    for start in range(0, len(order), step):
        progress(0.8 + 0.2 * start / len(order), 1.0)
        _cut(
            density.table, excess, density.bricks, bare, voxels, offsets, visible, order[start : start + step], mark.peak,
            mark.seen, mark.blur, traced, fewest, left, kept,
        )  # fmt: skip
    progress(1.0, 1.0)
    gone = int(np.count_nonzero((kept == 0) & (counts > 0)))
    tally = {
        REMOVED: gone,
        CUT_BACK: int(np.count_nonzero((kept > 0) & (kept < counts))),
    }
    return kept, tally


class Mark(NamedTuple):
    """What one strand too many leaves in the misfit: its peak, its blur (voxels), and what trilinear reads see of the peak on
    its line and on the ring around it."""

    peak: float
    blur: float
    seen: np.ndarray


def excess_of(
    voxels: np.ndarray,
    offsets: np.ndarray,
    visible: np.ndarray,
    density: BrickVolume,
    profile: StrandProfile,
    reach: float = 0.0,
    progress: Progress = silent,
) -> tuple[np.ndarray, Mark]:
    """((B, 16, 16, 16) float32: the strands as rendered less the scan, 0 where that was cleared, blurred by `reach` voxels; a
    strand's mark there).

    voxels (M, 3): their points; the rest as for `prune`.
    """
    gain = profile.line_mass / density.spacing**2
    excess = render(voxels, offsets, visible, density, profile.blur, progress)
    for start in range(0, len(excess), CHUNK):
        part = slice(start, start + CHUNK)
        excess[part] *= np.float32(gain)
        excess[part] -= density.bricks[part]
        excess[part][density.bricks[part] == 0] = 0.0
    if reach:
        blurred(BrickVolume(density.table, excess, density.spacing, density.origin), reach, excess)
    blur = float(np.hypot(profile.blur, reach))
    wide = blur**2 + INTERPOLATION_VARIANCE
    seen = np.array([1.0, np.exp(-0.5 * RING**2 / wide)]) * blur**2 / wide
    return excess, Mark(gain / (2.0 * np.pi * blur**2), blur, seen)


@numba.njit(cache=True, nogil=True)
def amplitude(table, excess, x, y, z, tx, ty, tz, peak, seen):
    """How many strands too many are rendered at a point of a strand with unit tangent t: least squares over five reads."""
    if abs(tx) <= abs(ty) and abs(tx) <= abs(tz):
        ux, uy, uz = 0.0, tz, -ty
    elif abs(ty) <= abs(tz):
        ux, uy, uz = -tz, 0.0, tx
    else:
        ux, uy, uz = ty, -tx, 0.0
    norm = RING / max(np.sqrt(ux * ux + uy * uy + uz * uz), 1e-12)
    ux, uy, uz = ux * norm, uy * norm, uz * norm
    vx, vy, vz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
    nothing = np.float32(0.0)
    middle = trilinear(table, excess, nothing, x, y, z)
    ring = trilinear(table, excess, nothing, x + ux, y + uy, z + uz)
    ring += trilinear(table, excess, nothing, x - ux, y - uy, z - uz)
    ring += trilinear(table, excess, nothing, x + vx, y + vy, z + vz)
    ring += trilinear(table, excess, nothing, x - vx, y - vy, z - vz)
    return (seen[0] * middle + seen[1] * ring) / (peak * (seen[0] ** 2 + 4.0 * seen[1] ** 2))


@numba.njit(cache=True, nogil=True)
def prefix(table, excess, scan, bare, points, visible, start, end, peak, seen, earned):
    """Fill `earned` (end - start,) with what the strand earns up to each of its control points; its visible length, voxels."""
    total, whole = 0.0, 0.0
    earned[0] = 0.0
    for m in range(start, end - 1):
        curve, count = spline(points, m, m == start, m + 2 >= end), segment_samples(points, m)
        px, py, pz = points[m, 0], points[m, 1], points[m, 2]
        for s in range(count):
            qx, qy, qz = spline_at(curve, (s + 1.0) / count)
            tx, ty, tz = qx - px, qy - py, qz - pz
            length = np.sqrt(tx * tx + ty * ty + tz * tz)
            t = (s + 0.5) / count
            shown = (1.0 - t) * visible[m] + t * visible[m + 1]
            whole += shown * length
            if length > 0.0 and shown > 0.0:
                x, y, z = 0.5 * (px + qx), 0.5 * (py + qy), 0.5 * (pz + qz)
                i, j, k = int(np.floor(x + 0.5)), int(np.floor(y + 0.5)), int(np.floor(z + 0.5))
                a = 1.0  # where nothing is stored, nothing is rendered: the strand is one too many
                if not np.isnan(voxel(table, excess, np.float32(np.nan), i, j, k)):
                    a = amplitude(table, excess, x, y, z, tx / length, ty / length, tz / length, peak, seen)
                total += shown * length * (0.5 - min(max(a, -1.0), 2.0))
                if bare > 0.0 and trilinear(table, scan, np.float32(0.0), x, y, z) < bare:
                    if voxel(table, scan, 1.0, i, j, k) != 0.0:  # it wasn't cleared
                        total -= shown * length * BARE_COST
            px, py, pz = qx, qy, qz
        earned[m + 1 - start] = total
    return whole


@numba.njit(cache=True, parallel=True)
def earnings(table, excess, scan, bare, points, offsets, visible, peak, seen):
    """(earned (N,) by each strand as a whole (`prefix`), its visible length (N,), the most that a stretch of it costs (N,))."""
    count = len(offsets) - 1
    whole, shown, loss = np.zeros(count), np.zeros(count), np.zeros(count)
    for n in numba.prange(count):
        size = offsets[n + 1] - offsets[n]
        if size > 1:
            earned = np.empty(size)
            shown[n] = prefix(table, excess, scan, bare, points, visible, offsets[n], offsets[n + 1], peak, seen, earned)
            whole[n] = earned[size - 1]
            top = 0.0
            for m in range(size):
                top = max(top, earned[m])
                loss[n] = max(loss[n], top - earned[m])
    return whole, shown, loss


@numba.njit(cache=True, nogil=True)
def _cut(table, excess, scan, bare, points, offsets, visible, order, peak, seen, blur, traced, fewest, left, kept):
    """Judge the strands of `order` one after another (`prune`); left (1,): how many there are still."""
    for n in order:
        start, end = offsets[n], offsets[n + 1]
        size = end - start
        if size < 2:
            continue
        earned = np.empty(size)
        shown = prefix(table, excess, scan, bare, points, visible, start, end, peak, seen, earned)
        best = 0
        for m in range(size):
            if earned[m] > earned[best]:
                best = m
        if traced[n]:
            if earned[size - 1] >= (0.5 - DOUBLE) * shown or left[0] <= fewest:
                continue
            stay = 0
        elif earned[best] < LEAST_EARNED:
            stay = 0
        elif earned[best] - earned[size - 1] >= LEAST_CUT and best + 1 < size:
            stay = max(best + 1, 2)
        else:
            continue
        kept[n] = stay
        if stay == 0:
            left[0] -= 1
        take_out(table, excess, points, visible, start, end, start + max(stay - 1, 0), end - 1, peak, blur)


@numba.njit(cache=True, nogil=True)
def take_out(table, excess, points, visible, start, end, low, high, peak, blur):
    """Take the profile of a strand (control points `start` to `end`) between its control points `low` and `high` out of the
    rendering: what is cut no longer shows."""
    samples = 0
    for m in range(low, high):
        samples += _blobs(points, m, blur)
    path = np.empty((samples + 1, 3), np.float32)
    amplitude = np.empty(samples + 1)
    for axis in range(3):
        path[0, axis] = points[low, axis]
    amplitude[0] = -peak * visible[low]
    at = 1
    for m in range(low, high):
        curve, count = spline(points, m, m == start, m + 2 >= end), _blobs(points, m, blur)
        for s in range(count):
            t = (s + 1.0) / count
            path[at, 0], path[at, 1], path[at, 2] = spline_at(curve, t)
            amplitude[at] = -peak * ((1.0 - t) * visible[m] + t * visible[m + 1])
            at += 1
    add_strand(table, excess, path, amplitude, blur)


@numba.njit(cache=True, inline="always")
def _blobs(points, m, blur):
    """How many blobs, BLOBS within a blur, make up the profile of the segment from control point m to m + 1."""
    return max(1, int(np.ceil(segment_samples(points, m) * BLOBS / (SAMPLES_PER_VOXEL * blur))))
