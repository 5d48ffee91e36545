"""Tips put where the hair ends: a trace is given up where density falls off, the better part of a voxel before that.

Along a strand's own line the scan, less what the other strands leave there, falls from a strand's height to nothing as its
blur lets it, and is at half of it where the hair ends.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.special import ndtr

from ..progress import Progress, part, silent
from ..volume import BrickVolume
from ..volume.grid import voxel
from ..volume.strand_signal import INTERPOLATION_VARIANCE, StrandProfile
from .curves import segment_lengths
from .pruning import amplitude, excess_of

PLACES = np.arange(-2.0, 4.01, 0.5)
"""voxel along a strand from its tip, where the scan is read."""
MOVES = np.arange(-1.5, 3.01, 0.125)
"""voxel that a tip may be moved by."""
LEAST_LENGTH = 8.0
"""voxel; shorter strands stay as they are."""


def settle_tips(
    points: np.ndarray,
    offsets: np.ndarray,
    visible: np.ndarray,
    density: BrickVolume,
    profile: StrandProfile,
    traced: np.ndarray,
    progress: Progress = silent,
) -> tuple[np.ndarray, np.ndarray]:
    """Control points (M, 3) mm with the last of each strand moved along its end to where the scan shows the hair to end, and
    by how much, (N,) mm.

    offsets (N + 1,), visible (M,) 0..1 as in `splat.render`. traced (N,) bool: strands that were found in the scan; made-up
    ones keep their lengths. Of MOVES the one is taken by which what the scan shows of the strand is nearest, in squares, to
    what its blur makes of an end there. Each is looked at as if the others stayed; the same on any number of threads.
    """
    voxels = density.to_voxel(points)
    excess, mark = excess_of(voxels, offsets, visible, density, profile, progress=part(progress, 0.0, 0.9))
    spread = np.sqrt(mark.blur**2 + INTERPOLATION_VARIANCE)
    ends = ndtr((MOVES[:, None] - PLACES) / spread)
    own = ndtr(-PLACES / spread)
    moved = np.zeros(len(offsets) - 1)
    tips = np.zeros((len(moved), 3))
    last = offsets[1:] - 1
    strand = np.repeat(np.arange(len(moved)), np.diff(offsets))
    lengths = np.bincount(strand, segment_lengths(voxels, offsets), len(moved))
    may = np.asarray(traced, bool) & (np.diff(offsets) > 1) & (visible[last] >= 1.0) & (lengths >= LEAST_LENGTH)
    _settle(density.table, excess, voxels, offsets, may, mark.peak, mark.seen, ends, own, moved, tips)
    out = np.array(points)
    out[last] += tips * density.spacing
    progress(1.0, 1.0)
    return out, moved * density.spacing


@numba.njit(cache=True, parallel=True)
def _settle(table, excess, points, offsets, may, peak, seen, ends, own, moved, tips):
    """Fill `moved` (N,), and `tips` (N, 3) with the moves, voxels, of the strands that `may` (N,).

    ends (moves, places), own (places,): the share of a strand's height at each place after each move, and as it is.
    """
    for n in numba.prange(len(moved)):
        if not may[n]:
            continue
        start, last = offsets[n], offsets[n + 1] - 1
        tx, ty, tz = _end_tangent(points, start, last)
        x, y, z = points[last, 0], points[last, 1], points[last, 2]
        shown = np.empty(len(PLACES))
        whole = True
        for i in range(len(PLACES)):
            px, py, pz = x + PLACES[i] * tx, y + PLACES[i] * ty, z + PLACES[i] * tz
            a, b, c = int(np.floor(px + 0.5)), int(np.floor(py + 0.5)), int(np.floor(pz + 0.5))
            if np.isnan(voxel(table, excess, np.float32(np.nan), a, b, c)):
                whole = False  # nothing is stored there
                break
            # no more than one strand: what others lack here isn't this one's
            shown[i] = min(own[i] - amplitude(table, excess, px, py, pz, tx, ty, tz, peak, seen), 1.0)
        if not whole:
            continue
        least, best = np.inf, 0
        for move in range(len(MOVES)):
            off = 0.0
            for i in range(len(PLACES)):
                off += (shown[i] - ends[move, i]) ** 2
            if off < least:
                least, best = off, move
        moved[n] = MOVES[best]
        tips[n, 0], tips[n, 1], tips[n, 2] = MOVES[best] * tx, MOVES[best] * ty, MOVES[best] * tz


@numba.njit(cache=True, inline="always")
def _end_tangent(points, start, last):
    """The unit direction in which a strand ends, as it bends between its last three control points."""
    x = points[last, 0] - points[last - 1, 0]
    y = points[last, 1] - points[last - 1, 1]
    z = points[last, 2] - points[last - 1, 2]
    if last - start > 1:
        x += 0.5 * (x - points[last - 1, 0] + points[last - 2, 0])
        y += 0.5 * (y - points[last - 1, 1] + points[last - 2, 1])
        z += 0.5 * (z - points[last - 1, 2] + points[last - 2, 2])
    norm = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    return x / norm, y / norm, z / norm
