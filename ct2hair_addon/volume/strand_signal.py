"""What strands look like in a scan: the profile of a lone strand, the mass of all hair, and what the scan backs along strands.

Density is linear in hair: a strand adds its `line_mass` per mm of its length, spread over a Gaussian cross-section by the
scanner (supplement 3 of the paper, read backwards). So the profile of one strand turns density into length of hair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..progress import Progress, silent
from ..strands import Strands
from .grid import BrickVolume, trilinear
from .structure import SMOOTHING, STRAND_BLUR

TYPICAL_BLUR = STRAND_BLUR
"""Gaussian blur of a scan, voxels, taken where no lone strand can be measured (0.8 to 0.9 in the paper's scans)."""

INTERPOLATION_VARIANCE = 1.0 / 6.0
"""Variance, voxels^2, that trilinear sampling adds to a profile: that of the triangle of half-width one."""

PIECE_POINTS = 9
RING_STEP = 0.5
RINGS = 11
ANGLES = 12
CORE_RINGS = 7
"""A piece is 9 points a voxel apart; its cross-section is sampled on 12 angles and rings 0, 0.5, ... 5 voxels. Rings up to
3 voxels (core) hold more than 99 % of a strand's mass at a blur of 0.9; those from 3.5 on (moat) tell whether it is alone."""

STRAIGHT = 0.97
"""Chord over length from which on a piece is straight."""
CROWDED, CROWDED_ALL_ROUND = 0.2, 0.08
"""Shares of a piece's density: what its moat holds at most, along any one angle and all round, where it is alone."""

LONE_EXCESS = 1.15
"""How much higher what is taken for lone strands may stand than a lone strand by the thresholds, both smoothed as there: lone
ones are at 0.80 to 0.95 of it whatever the blur and the noise; in a braid, where none is alone, the loneliest are at 1.4."""

MAX_PIECES = 60_000
MIN_LONE_PIECES = 40
BEST_SHARE = 0.02
FLOOR_QUANTILE = 2e-4
LIKELY_FLOOR = 1.0
"""mm; hair that the scan shows begins about as far over the head, seldom farther."""


@dataclass(frozen=True)
class StrandProfile:
    """One strand's signature in a scan.

    peak: density on the axis of a lone straight strand, above air. blur: standard deviation of its Gaussian cross-section,
    voxels. line_mass: integral of density over the cross-section, density * mm^2; the mass of 1 mm of hair.
    pieces: lone pieces that it was measured on; 0 where typical values had to do. seen: the mean that trilinear reads give on
    its axis, lower than the peak because they blur by themselves.
    """

    peak: float
    blur: float
    line_mass: float
    pieces: int

    @classmethod
    def gaussian(cls, peak: float, blur: float, spacing: float, pieces: int = 0) -> StrandProfile:
        """The profile of this peak (density) and blur (voxels of `spacing` mm)."""
        return cls(float(peak), float(blur), float(peak) * 2.0 * np.pi * (float(blur) * spacing) ** 2, pieces)

    @property
    def seen(self) -> float:
        return self.peak * self.blur**2 / (self.blur**2 + INTERPOLATION_VARIANCE)


def alone(profile: StrandProfile, peak: float, spacing: float) -> StrandProfile:
    """`profile`, unless it was measured on bundles: then that of `peak`, a lone strand's by the thresholds, and the usual blur.

    The thresholds look all over the scan for the faintest lines, taking the usual blur for granted. peak 0: not known.
    """
    usual = StrandProfile.gaussian(peak, TYPICAL_BLUR, spacing)
    height = [p.peak * p.blur**2 / (p.blur**2 + SMOOTHING**2) for p in (profile, usual)]
    return usual if 0.0 < LONE_EXCESS * height[1] < height[0] else profile


def lone_profile(
    density: BrickVolume, hair_level: float, strands: Strands, peak: float = 0.0, progress: Progress = silent
) -> StrandProfile:
    """The profile of a lone strand, measured where pieces of `strands` (mm, scan frame) run alone through the scan.

    The cross-section of each piece is averaged along it; the pieces with the emptiest moat around them count, and the
    typical one (half-sample mode, deaf to pairs that lie in one another) is taken. With too few of them, or none but bundles
    (`alone`), `peak` (of a lone strand, by the thresholds) or the thinner strands' density along the guides and a typical blur
    stand in.
    """
    lines = strands.resampled_by_step(density.spacing) if len(strands) else strands
    per_strand = np.maximum(lines.counts // PIECE_POINTS, 0) if len(strands) else np.zeros(0, np.int64)
    firsts = _piece_starts(lines.offsets, per_strand)
    if len(firsts) > MAX_PIECES:
        firsts = firsts[np.linspace(0, len(firsts) - 1, MAX_PIECES).astype(np.int64)]
    voxels = density.to_voxel(lines.points)
    images = np.empty((len(firsts), RINGS, ANGLES), np.float32)
    lone = np.empty(len(firsts), bool)
    chunk = 4000
    for start in range(0, len(firsts), chunk):
        progress(start, len(firsts))
        part = slice(start, start + chunk)
        _cross_sections(
            density.table, density.bricks, np.float32(density.background), voxels, firsts[part], images[part], lone[part]
        )
    measured = _typical_lone(images[lone], len(firsts), hair_level, density.spacing)
    if measured is not None:
        return alone(measured, peak, density.spacing)
    axis = images[:, :2].mean(axis=(1, 2)) if len(images) else np.zeros(0)
    axis = axis[axis > hair_level]
    if peak <= 0.0:
        peak = float(np.quantile(axis, 0.2)) if len(axis) else 2.0 * hair_level
    return StrandProfile.gaussian(peak, TYPICAL_BLUR, density.spacing)


def _typical_lone(images: np.ndarray, pieces: int, hair_level: float, spacing: float) -> StrandProfile | None:
    """The profile from polar cross-sections (L, RINGS, ANGLES) of those of `pieces` that may run alone; None with too few."""
    if not len(images):
        return None
    radius = RING_STEP * np.arange(RINGS)
    profile = images.mean(axis=2)
    area = 2.0 * np.pi * radius * RING_STEP
    area[0] = np.pi * (RING_STEP / 2) ** 2
    moat = profile[:, CORE_RINGS:].mean(axis=1)
    crowding = np.abs(images[:, CORE_RINGS:].mean(axis=1)).max(axis=1)
    core = profile[:, :CORE_RINGS] - moat[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        mass = core @ area[:CORE_RINGS]
        angle = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
        weight = (images[:, :CORE_RINGS] - moat[:, None, None]) * (area * radius / ANGLES)[None, :CORE_RINGS, None]
        centre = np.hypot((weight * np.cos(angle)).sum((1, 2)), (weight * np.sin(angle)).sum((1, 2))) / mass
        variance = (core @ (area * radius**2)[:CORE_RINGS] / mass - centre**2) / 2.0 - INTERPOLATION_VARIANCE
    axis = profile[:, :2].mean(axis=1)
    usable = (axis > hair_level) & (mass > 0.0) & (centre < 0.8) & np.isfinite(variance)
    alone = usable & (crowding < CROWDED * axis) & (np.abs(moat) < CROWDED_ALL_ROUND * axis)
    if np.count_nonzero(alone) < MIN_LONE_PIECES:
        return None
    rows = np.flatnonzero(alone)
    order = np.argsort(crowding[rows] / axis[rows], kind="stable")
    rows = rows[order[: max(MIN_LONE_PIECES, int(BEST_SHARE * pieces))]]
    mass_mode = half_sample_mode(mass[rows])
    near = rows[np.abs(mass[rows] - mass_mode) < 0.35 * mass_mode]
    line_mass = float(np.median(mass[near]))
    blur = _untruncated(float(np.median(variance[near])))
    contained = 1.0 - np.exp(-((RING_STEP * (CORE_RINGS - 0.5)) ** 2) / (2.0 * (blur**2 + INTERPOLATION_VARIANCE)))
    line_mass *= spacing**2 / contained
    return StrandProfile(line_mass / (2.0 * np.pi * (blur * spacing) ** 2), blur, line_mass, len(near))


def _untruncated(variance: float) -> float:
    """The blur, voxels, of a Gaussian whose second moment out to the core's edge, less the sampling's, is `variance`."""
    reach = RING_STEP * (CORE_RINGS - 0.5)
    measured = full = variance + INTERPOLATION_VARIANCE
    for _ in range(20):
        q = reach**2 / (2.0 * full)
        full = min(measured / (1.0 - q * np.exp(-q) / (1.0 - np.exp(-q))), 2.0)
    return float(np.sqrt(np.clip(full - INTERPOLATION_VARIANCE, 0.6**2, 1.4**2)))


def half_sample_mode(values: np.ndarray) -> float:
    """The mode of a sample: the middle of ever denser halves (Bickel and Fruehwirth 2006)."""
    values = np.sort(np.asarray(values, np.float64))
    while len(values) > 3:
        half = (len(values) + 1) // 2
        start = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
        values = values[start : start + half]
    return float(np.mean(values))


def hair_mass(density: BrickVolume, progress: Progress = silent) -> float:
    """The integral of density over the scan, density * mm^3: the mass of all hair. Noise around it, being signed, cancels."""
    sums = np.empty(len(density.bricks))
    chunk = 2048
    for start in range(0, len(sums), chunk):
        progress(start, len(sums))
        sums[start : start + chunk] = density.bricks[start : start + chunk].sum(axis=(1, 2, 3), dtype=np.float64)
    return float(sums.sum() * density.spacing**3)


def data_floor(density: BrickVolume, hair_level: float, head, sample: int = 200_000) -> float:
    """The distance from the head, mm, below which the scan holds no hair because the hairnet was cut away (0 or more).

    `head` answers `signed_distance(points)`. A low quantile over a sample of hair voxels: robust to a few left-overs.
    """
    per_brick = density.count_above(hair_level)
    total = int(per_brick.sum())
    if total == 0:
        return 0.0
    centres = density.to_scan(16.0 * density.brick_index + 7.5)
    reach = head.signed_distance(centres.astype(np.float32), 16.0 * density.spacing)
    near = np.flatnonzero((per_brick > 0) & (reach < 16.0 * density.spacing))
    if not len(near):
        return 0.0
    keep = max(1, int(np.ceil(per_brick[near].sum() / sample)))
    hair = density.bricks[near] > hair_level
    row, *within = np.unravel_index(np.flatnonzero(hair)[::keep], hair.shape)
    points = density.to_scan(16 * density.brick_index[near[row]] + np.stack(within, axis=1)).astype(np.float32)
    share, beyond, above = min(1.0, FLOOR_QUANTILE * total / per_brick[near].sum()), LIKELY_FLOOR, np.inf
    while above >= beyond:  # of all farther points that much is told in a fraction of the time
        beyond *= 2.0
        distance = head.signed_distance(points, beyond)
        floor, above = (np.quantile(distance, share, method=method) for method in ("linear", "higher"))
    return float(max(floor, 0.0))


def support_along(
    strands: Strands, density: BrickVolume, hair_level: float, window: float = 1.5
) -> tuple[np.ndarray, np.ndarray]:
    """What the scan backs: (M,) float32 per point and (N,) float32 per strand, 0 (made up) to 1 (lies in hair).

    The density along the strand, averaged over `window` mm to either side against noise, in units of `hair_level`, cut at
    1; a strand's value is the mean over its length.
    """
    steps = strands.resampled_by_step(density.spacing)
    values = density.sample(steps.points)
    reach = max(1, round(window / density.spacing))
    backed = np.empty(len(values), np.float32)
    per_strand = np.zeros(len(strands), np.float32)
    _backed_along(values, steps.offsets, np.int64(reach), np.float32(max(hair_level, 1e-9)), backed, per_strand)
    per_point = np.empty(len(strands.points), np.float32)
    _at_points(strands.arc_lengths(), strands.offsets, backed, steps.offsets, per_point)
    return per_point, per_strand


def _piece_starts(offsets: np.ndarray, per_strand: np.ndarray) -> np.ndarray:
    """(L,) int64: the first point of each piece of PIECE_POINTS points."""
    begin = np.concatenate([[0], np.cumsum(per_strand)])
    strand = np.repeat(np.arange(len(per_strand)), per_strand)
    return offsets[:-1][strand] + (np.arange(begin[-1]) - begin[strand]) * PIECE_POINTS


@numba.njit(cache=True, parallel=True)
def _cross_sections(table, bricks, background, voxels, firsts, images, lone):
    """Fill the cross-sections `images` (L, RINGS, ANGLES) of the pieces that begin at `firsts`, and `lone` (L,): whether they
    may run alone. Of those that don't no more than the two innermost rings is sure to be filled: most show it at once."""
    for n in numba.prange(len(firsts)):
        piece = voxels[firsts[n] : firsts[n] + PIECE_POINTS]
        tx, ty, tz = piece[-1, 0] - piece[0, 0], piece[-1, 1] - piece[0, 1], piece[-1, 2] - piece[0, 2]
        chord = np.sqrt(tx * tx + ty * ty + tz * tz)
        arc = 0.0
        for m in range(PIECE_POINTS - 1):
            arc += np.sqrt(
                (piece[m + 1, 0] - piece[m, 0]) ** 2
                + (piece[m + 1, 1] - piece[m, 1]) ** 2
                + (piece[m + 1, 2] - piece[m, 2]) ** 2
            )
        images[n], lone[n] = 0.0, False
        if chord <= 0.0:
            continue
        tx, ty, tz = tx / chord, ty / chord, tz / chord
        ux, uy, uz = ty, -tx, 0.0
        if abs(tz) > 0.7:
            ux, uy, uz = 0.0, tz, -ty
        norm = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / norm, uy / norm, uz / norm
        vx, vy, vz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
        frame = ux, uy, uz, vx, vy, vz
        axis = 0.0
        for step in range(ANGLES):
            _spoke(table, bricks, background, piece, frame, step, 0, 2, images[n])
            axis += (images[n, 0, step] + images[n, 1, step]) / (2 * ANGLES)
        most = 1.001 * CROWDED * axis  # what is nearly too much is left to the exact sums
        alone = chord > STRAIGHT * arc
        for step in range(ANGLES):
            if alone:
                _spoke(table, bricks, background, piece, frame, step, CORE_RINGS, RINGS, images[n])
                beside = 0.0
                for ring in range(CORE_RINGS, RINGS):
                    beside += images[n, ring, step] / (RINGS - CORE_RINGS)
                alone = abs(beside) < most
        if alone:
            for step in range(ANGLES):
                _spoke(table, bricks, background, piece, frame, step, 2, CORE_RINGS, images[n])
        lone[n] = alone


@numba.njit(cache=True)
def _spoke(table, bricks, background, piece, frame, step, first, last, image):
    """Fill the rings [first, last) of a piece's cross-section (RINGS, ANGLES) at one angle, averaged along it."""
    ux, uy, uz, vx, vy, vz = frame
    angle = 2.0 * np.pi * step / ANGLES
    for ring in range(first, last):
        a, b = RING_STEP * ring * np.cos(angle), RING_STEP * ring * np.sin(angle)
        total = 0.0
        for m in range(PIECE_POINTS):
            x, y, z = piece[m, 0] + a * ux + b * vx, piece[m, 1] + a * uy + b * vy, piece[m, 2] + a * uz + b * vz
            total += trilinear(table, bricks, background, x, y, z)
        image[ring, step] = total / PIECE_POINTS


@numba.njit(cache=True, parallel=True)
def _backed_along(values, offsets, reach, level, backed, per_strand):
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        total = 0.0
        for m in range(start, end):
            first, last = max(start, m - reach), min(end, m + reach + 1)
            mean = 0.0
            for i in range(first, last):
                mean += values[i]
            mean /= last - first
            backed[m] = min(max(mean / level, 0.0), 1.0)
            total += backed[m]
        if end > start:
            per_strand[n] = total / (end - start)


@numba.njit(cache=True, parallel=True)
def _at_points(arc, offsets, values, steps, out):
    """Values at equal steps along each strand, read off linearly at its own points."""
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        if end == start:
            continue
        length = arc[end - 1]
        count = steps[n + 1] - steps[n]
        for m in range(start, end):
            place = arc[m] / length * (count - 1) if length > 0.0 else 0.0
            i = min(int(place), count - 2)
            t = place - i
            out[m] = (1.0 - t) * values[steps[n] + i] + t * values[steps[n] + i + 1]


@numba.njit(cache=True, nogil=True)
def add_strand(table, bricks, path, amplitudes, blur):
    """Add a strand's blurred profile (peak `amplitudes[n]` on the line) to the bricks: a Gaussian blob at each point, weighted
    by its share of the length, which for points no farther apart than the blur is the tube itself to a thousandth."""
    reach = int(np.ceil(3.2 * blur))
    size = 2 * reach + 1
    wx, wy, wz = np.empty(size), np.empty(size), np.empty(size)
    shrink = -0.5 / (blur * blur)
    for n in range(len(path)):
        length = 0.0
        for m in (n - 1, n):
            if m >= 0 and m + 1 < len(path):
                length += 0.5 * np.sqrt(
                    (path[m + 1, 0] - path[m, 0]) ** 2 + (path[m + 1, 1] - path[m, 1]) ** 2 + (path[m + 1, 2] - path[m, 2]) ** 2
                )
        weight = amplitudes[n] * length / (blur * np.sqrt(2.0 * np.pi))
        if weight == 0.0:
            continue
        ci, cj, ck = int(np.floor(path[n, 0] + 0.5)), int(np.floor(path[n, 1] + 0.5)), int(np.floor(path[n, 2] + 0.5))
        for t in range(size):
            wx[t] = weight * np.exp(shrink * (ci + t - reach - path[n, 0]) ** 2)
            wy[t] = np.exp(shrink * (cj + t - reach - path[n, 1]) ** 2)
            wz[t] = np.exp(shrink * (ck + t - reach - path[n, 2]) ** 2)
        for a in range(size):
            i = ci + a - reach
            if i < 0 or i >> 4 >= table.shape[0]:
                continue
            for b in range(size):
                j = cj + b - reach
                if j < 0 or j >> 4 >= table.shape[1]:
                    continue
                across = wx[a] * wy[b]
                for c in range(size):
                    k = ck + c - reach
                    if k < 0 or k >> 4 >= table.shape[2]:
                        continue
                    row = table[i >> 4, j >> 4, k >> 4]
                    if row >= 0:
                        bricks[row, i & 15, j & 15, k & 15] += across * wz[c]
