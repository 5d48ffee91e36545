"""Which scan values are air, hair, knots and mannequin, without a number set by hand (paper 3.1, supplement 1).

Air is the histogram's peak, and its lower flank tells the noise. Hair is looked for by its shape, not by its value: peaks
of the smoothed scan that go on in one direction and fall off in the others; the most usual height of them is a lone strand's.
Knots are well above a strand, and what is denser than all that and larger than any knot is the mannequin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..errors import ScanError
from ..progress import Progress, silent
from ..settings import ScanSettings
from .readers import ScanReader
from .resampling import cubic
from .strand_signal import half_sample_mode
from .structure import (
    DIRECTIONS,
    HALO,
    LINE_SHARE,
    MEAN_REACH,
    MOST_PEAKS,
    NOISE_SHARE,
    PERSISTS,
    TAPS,
    cut_block,
    find_peaks,
    flat_limit,
    local_mean,
    ripple,
    smoothed,
)

SLABS = 12
"""Places along the scan's slowest axis that are looked at."""
BLOCK = 48
"""Voxels along one edge of a block whose peaks are looked for."""
MOST_BLOCKS = 2400
"""Blocks looked at, evenly chosen: 2.6 x 10^8 voxels, whatever the scan's size."""
SAMPLE = 4_000_000
"""Values in the histogram that air is found in."""
BELOW_NOISE = 3.5
"""Peaks must exceed their surroundings by so many standard deviations of the smoothed noise: one in 4,000 does by chance,
and few of those go on like a line."""
LINE_DIRECTIONS = 3
"""A line seen along 13 directions goes on in at most this many of them; a sheet in more."""
LEAST_LENGTH, LEAST_SHARE = 4000.0, 0.08
"""mm of lines needed, and the lines' share of all peaks that are no blobs, for a scan to show hair."""
FEW_LENGTH, FEW_SHARE = 1000.0, 0.03
"""The same where there is a mannequin, for a scan that may show hair: tied hair, of which little runs alone. Knots decide."""
PEAK_EVERY = 4.5
"""voxel; a strand shows a peak about that often along its way."""
PILE = 0.4
"""A pile of heights counts from this share of the highest one on."""
PILE_BIN, PILE_TAPS = 0.04, np.array([0.06, 0.24, 0.4, 0.24, 0.06])
"""Bins of the heights' logarithm, and the weights under which piles are looked at."""
STANDS_OUT, LEAST_PILE = (0.75, 4.0), (100, 0.02)
"""A lower pile counts, too, where heights fall to this share of it before they rise again, by so many standard deviations, and
so many lines, and this share of all, are in it: the few strands that run alone beside a braid."""
FAINTEST, ONSET = (8, 0.01), 0.95
"""Nothing is fainter than a lone strand: so many lines, and this share of all, lie below the onset of their heights, which is
this share of a lone strand's: 0.82 in much noise to 1.2 where few strands run alone."""
BUNDLED = 1.9
"""A pile over so many times the onset is of bundles: a lone strand's lies at 1.0 to 1.5 of it, tied hair's at 2.1 to 14."""
HAIR_SHARE = 0.4
"""A voxel is hair above this share of a lone strand's peak."""
KNOT_SHARE = 2.2
"""A knot is denser than two strands that touch."""
SOLID_SHARE = 4.0
"""The mannequin's local mean is above so many lone strands' peaks, and its material is flat, which dense hair never is."""
SOLID_VOLUME = 10_000.0
"""mm^3; a smaller body is no mannequin."""


@dataclass(frozen=True)
class Thresholds:
    """Scan values that part the materials.

    air: value of air; noise: its standard deviation. strand: peak of a lone strand above air. hair: a voxel above it is
    hair; knots: a blob above it is a knot; solid: a large body above it is the mannequin, None where there is none.
    lines: strand-like peaks that hair was found by. chosen: names of those that the settings gave. doubt: why this may be no
    hair, for the error, unless a mannequin turns out to wear knots; empty where hair is sure.
    """

    air: float
    noise: float
    strand: float
    hair: float
    knots: float
    solid: float | None
    lines: int
    chosen: tuple[str, ...] = ()
    doubt: str = ""


def find_thresholds(reader: ScanReader, settings: ScanSettings, progress: Progress = silent) -> Thresholds:
    """The thresholds of a scan, from a few slabs of it; those that `settings` gives are taken as they are.

    Raises ScanError where the scan shows nothing like hair and `settings.hair` gives no level.
    """
    reader = cubic(reader)
    reader.prepare(lambda done, total: progress(0.3 * done / max(total, 1), 1.0))
    depth = reader.shape[reader.order[0]]
    slabs = _slabs(depth)
    values = _values(reader, slabs, lambda done, total: progress(0.3 + 0.2 * done / total, 1.0))
    air, noise = air_and_noise(values)
    chosen = tuple(name for name in ("air", "hair", "knots", "solid") if getattr(settings, name) > 0.0)
    if "air" in chosen:
        air = settings.air
    peaks, goes_on, means, looked = _peaks(
        reader, slabs, air, noise, lambda done, total: progress(0.5 + 0.5 * done / total, 1.0)
    )
    strand, lines, share = strand_level(peaks, goes_on)
    length = lines * PEAK_EVERY * float(np.mean(reader.spacing)) / looked
    shown = length >= LEAST_LENGTH and share >= LEAST_SHARE
    if "hair" in chosen:
        if settings.hair <= air:
            raise ScanError(f"{reader.path}: scan.hair is {settings.hair:g}, not above air ({air:.6g}); set it higher")
        strand = strand if shown else (settings.hair - air) / HAIR_SHARE
    hair = settings.hair if "hair" in chosen else air + HAIR_SHARE * strand
    knots = settings.knots if "knots" in chosen else air + KNOT_SHARE * strand
    volume = float(np.prod(np.array(reader.shape) * reader.spacing))
    solid = (
        settings.solid
        if "solid" in chosen
        else _solid_level(means, air, strand, volume, flat_limit(float(np.mean(reader.spacing))))
    )
    doubt = ""
    if not shown and "hair" not in chosen:
        doubt = _no_hair(reader, air, noise, length, share)
        if solid is None or length < FEW_LENGTH or share < FEW_SHARE:
            raise ScanError(doubt)
    progress(1.0, 1.0)
    return Thresholds(float(air), float(noise), float(strand), float(hair), float(knots), solid, int(lines), chosen, doubt)


def _no_hair(reader, air, noise, length, share) -> str:
    # rounded down: what is just too little doesn't read as enough
    found = f"{np.floor(length / 100) / 10:g} m of them" if length < LEAST_LENGTH else f"{np.floor(100 * share):g}% lines"
    return (
        f"{reader.path}: no hair was found. Looked for strands, lines a voxel or two wide that stand out of air (value "
        f"{air:.6g}, noise {noise:.3g}): found {found}, expected at least {LEAST_LENGTH / 1000:.0f} m, and {LEAST_SHARE:.0%} "
        "of what stands out to be lines. If it is a wig, check the voxel size (scan.spacing; 1 mm and more shows no strands) "
        "and set scan.hair to a value between air and hair"
    )


def air_and_noise(values: np.ndarray) -> tuple[float, float]:
    """Air's value and its standard deviation: the histogram's peak and the spread of its lower flank.

    values: (S,) of a scan. A constant filling outside the scanner's field, below air and apart from it, doesn't count.
    """
    values = np.asarray(values, np.float64)
    values = values[np.isfinite(values)]
    lowest = values.min()
    above = values[values > lowest]
    if len(above) and np.count_nonzero(values == lowest) > 0.02 * len(values):
        # many voxels of exactly the lowest value are padding, if nothing lies near it
        near, spread = np.quantile(above, [0.005, 0.25])
        if near - lowest > 2.0 * (spread - near) and len(above) > 0.1 * len(values):
            values = above
    low, high = np.quantile(values, [0.001, 0.999])
    if high <= low:
        return float(np.median(values)), 0.0
    for _ in range(3):
        # a histogram of the range that matters, narrowed round its peak
        counts, edges = np.histogram(values, 512, (low, high))
        smooth = np.convolve(counts, np.ones(5) / 5.0, mode="same")
        peak = int(smooth.argmax())
        half = np.flatnonzero(smooth > 0.25 * smooth[peak])
        width = max(half[-1] - half[0], 8)
        if width > 60 or edges[1] - edges[0] < 1e-9 * max(abs(low), abs(high), 1.0):
            break
        low, high = edges[max(peak - 4 * width, 0)], edges[min(peak + 4 * width, 512)]
    inside = values[(values >= edges[max(peak - 2, 0)]) & (values <= edges[min(peak + 3, 512)])]
    air = float(np.mean(inside)) if len(inside) else 0.5 * (edges[peak] + edges[peak + 1])
    below = air - values[values < air]
    below = below[below > 0]
    if len(below) < 0.02 * len(values):
        return air, 0.0
    return _flank(values, air, float(np.median(below) / 0.6745))


def _flank(values: np.ndarray, air: float, noise: float) -> tuple[float, float]:
    """Air and noise by a parabola through the logarithm of the histogram's lower flank, which hair and foam don't reach."""
    for _ in range(4):
        low, high = air - 2.6 * noise, air + 0.1 * noise
        whole = np.abs(values[:1000] - np.rint(values[:1000])).max() < 1e-6
        # of whole numbers, bins as wide as whole numbers
        step = max(np.rint(0.1 * noise), 1.0) if whole else 0.1 * noise
        edges = np.arange(np.floor(low) - 0.5 if whole else low, high, step)
        if len(edges) < 6:
            break
        counts, edges = np.histogram(values, edges)
        middle = (0.5 * (edges[1:] + edges[:-1]) - air) / noise
        seen = counts > 20
        if np.count_nonzero(seen) < 5:
            break
        bent, slope, _ = np.polyfit(middle[seen], np.log(counts[seen]), 2, w=np.sqrt(counts[seen]))
        if bent >= -0.05:
            break
        centre = float(np.clip(-slope / (2.0 * bent), -1.0, 1.0))
        air, noise = air + noise * centre, noise * float(np.clip(np.sqrt(-0.5 / bent), 0.5, 2.0))
    return air, noise


def strand_level(peaks: np.ndarray, goes_on: np.ndarray) -> tuple[float, int, float]:
    """(peak of a lone strand above air, lines, their share of lines and sheets) from `find_peaks`' values and directions.

    Heights pile up at one strand, two that touch, and so on: the lowest pile is a lone strand's. Where tied hair hides it in
    noise, so that the lowest pile is of bundles, the faintest lines tell.
    """
    on = goes_on[:, 0]
    line = (on >= 1) & (on <= LINE_DIRECTIONS)
    lines, sheets = int(line.sum()), int((on > LINE_DIRECTIONS).sum())
    if not lines:
        return 0.0, 0, 0.0
    height = np.log(np.maximum(peaks[line, 0], 1e-30))
    low, high = np.quantile(height, [0.0, 0.9])
    counts, edges = np.histogram(height, np.arange(low - 0.3, high + 0.34, PILE_BIN))
    pile = _lowest_pile(counts.astype(np.float64))
    level = float(np.exp(0.5 * (edges[pile] + edges[pile + 1])))
    nth = max(FAINTEST[0], int(FAINTEST[1] * lines))
    onset = float(np.exp(np.partition(height, nth)[nth])) if nth < lines else level
    if level > BUNDLED * onset:
        level = onset / ONSET
    return level / LINE_SHARE, lines, lines / (lines + sheets)


def _lowest_pile(counts: np.ndarray) -> int:
    """The bin of `counts` (B,) float64 in which the lowest pile that counts has its top."""
    smooth = np.convolve(counts, PILE_TAPS, mode="same")
    noise = np.sqrt(np.convolve(counts, PILE_TAPS**2, mode="same"))
    tops = np.flatnonzero((smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:])) + 1
    for top in tops:
        if smooth[top] > PILE * smooth.max():
            return int(top)
        higher = np.flatnonzero(smooth[top:] > smooth[top])
        dip = top + int(smooth[top : top + higher[0]].argmin()) if len(higher) else len(smooth) - 1
        held = counts[: dip + 1].sum()
        falls = smooth[dip] < STANDS_OUT[0] * smooth[top] and smooth[top] - smooth[dip] > STANDS_OUT[1] * noise[top]
        if falls and held >= max(LEAST_PILE[0], LEAST_PILE[1] * counts.sum()):
            return int(top)
    return int(smooth.argmax())


def _slabs(depth: int) -> list[tuple[int, int]]:
    """Runs of slices [low, high) that are read: all of a small scan, SLABS runs of a large one."""
    thick = BLOCK + 2 * HALO
    if depth <= SLABS * BLOCK:
        return [(low, min(low + thick, depth)) for low in range(0, max(depth - 2 * HALO, 1), BLOCK)]
    starts = np.linspace(0, depth - thick, SLABS).astype(int)
    return [(int(low), int(low) + thick) for low in starts]


def _values(reader: ScanReader, slabs, progress: Progress) -> np.ndarray:
    """A thinned sample of the scan's values."""
    parts = []
    for number, (low, high) in enumerate(slabs):
        some = np.concatenate([reader.native(n, n + 1).ravel() for n in np.unique([low, (low + high) // 2])])
        every = max(len(some) * len(slabs) // SAMPLE, 1)
        # a prime step, so that no row or column of the slice is favoured
        parts.append(some[:: next(p for p in range(every, 2 * every + 2) if _prime(p))])
        progress(number + 1, len(slabs))
    return np.concatenate(parts)


def _prime(n: int) -> bool:
    return n == 1 or (n > 1 and all(n % d for d in range(2, int(n**0.5) + 1)))


def _peaks(reader: ScanReader, slabs, air: float, noise: float, progress: Progress):
    """The peaks, their directions, the local means of blocks all over the slabs, and the share of the scan in those blocks."""
    least = BELOW_NOISE * NOISE_SHARE * noise
    peaks, goes_on, means = [], [], []
    seen = 0
    a_slab = max(MOST_BLOCKS // len(slabs), 1)
    for number, (low, high) in enumerate(slabs):
        progress(number, len(slabs))
        slab = reader.native(low, high)
        if not least:
            # without noise, what stands out is held against the scan's own range
            least = 0.02 * float(np.quantile(slab[::5, ::5, ::5] - air, 0.999))
        corners = np.stack(
            np.meshgrid(
                np.arange(min(HALO, slab.shape[0] // 4), max(slab.shape[0] - HALO, 1), BLOCK),
                np.arange(0, slab.shape[1], BLOCK),
                np.arange(0, slab.shape[2], BLOCK),
                indexing="ij",
            ),
            axis=-1,
        ).reshape(-1, 3)
        seen += len(corners) * BLOCK**3
        if len(corners) > a_slab:
            seen -= (len(corners) - a_slab) * BLOCK**3
            corners = corners[np.linspace(0, len(corners) - 1, a_slab).astype(int)]
        value = np.empty((len(corners), MOST_PEAKS, 2), np.float32)
        directions = np.empty((len(corners), MOST_PEAKS, 2), np.int16)
        counts = np.zeros(len(corners), np.int64)
        some = np.empty((len(corners), 6, 6, 6, 3), np.float32)
        _look(
            slab,
            corners,
            np.float32(air),
            np.float32(max(least, 1e-6)),
            TAPS,
            DIRECTIONS,
            PERSISTS,
            value,
            directions,
            counts,
            some,
        )
        for n, count in enumerate(counts):
            peaks.append(value[n, :count].copy())
            goes_on.append(directions[n, :count].copy())
        means.append(some.reshape(-1, 3))
    looked = min(seen / np.prod(reader.shape, dtype=float), 1.0)
    return np.concatenate(peaks), np.concatenate(goes_on), np.concatenate(means), looked


@numba.njit(cache=True, parallel=True)
def _look(slab, corners, air, least, taps, directions, persists, value, goes_on, counts, means):
    for n in numba.prange(len(corners)):
        block = np.empty((BLOCK + 2 * HALO, BLOCK + 2 * HALO, BLOCK + 2 * HALO), np.float32)
        cut_block(slab, corners[n], HALO, air, block)
        smooth = smoothed(block, taps)
        inner = HALO - MEAN_REACH
        mean = local_mean(
            block[inner + 0 : len(block) - inner, inner : len(block) - inner, inner : len(block) - inner], MEAN_REACH
        )
        place = np.empty((MOST_PEAKS, 3), np.int16)
        counts[n] = find_peaks(smooth, mean, HALO - 3, least, directions, persists, place, value[n], goes_on[n])
        for i in range(6):
            for j in range(6):
                for k in range(6):
                    means[n, i, j, k, 0] = mean[8 * i, 8 * j, 8 * k]
                    a, b, c = 8 * i + HALO - 3, 8 * j + HALO - 3, 8 * k + HALO - 3
                    means[n, i, j, k, 1] = smooth[a, b, c]
                    means[n, i, j, k, 2] = ripple(smooth, a, b, c)


def _solid_level(means: np.ndarray, air: float, strand: float, volume: float, flat: float) -> float | None:
    """The value half way from air to the mannequin's material, from (local mean, smoothed, ripple); None without one.

    volume: mm^3 of the scan. flat: the most that a body's material ripples. A mannequin is a body of at least SOLID_VOLUME,
    denser than most hair is over a while.
    """
    dense = means[(means[:, 0] > SOLID_SHARE * strand) & (means[:, 2] < flat), 1]
    if volume * len(dense) / max(len(means), 1) < SOLID_VOLUME:
        return None
    # a thin wall nowhere fills the cube of the mean, but reaches its own value in the middle
    return float(air + 0.5 * half_sample_mode(dense[dense >= np.quantile(dense, 0.7)]))
