"""The wig out of the scan: hair as sparse bricks, air and mannequin left out, knots and the mannequin's surface as points.

Supplement 1, out of core: the scan is read once, slab by slab and ahead of the work, and only bricks with something
strand-like in them are kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np

from ..errors import ScanError
from ..progress import Progress, silent
from ..settings import ScanSettings
from .bodies import CLEAR, Bodies
from .grid import BRICK, LEAST, BrickVolume
from .readers import ScanReader
from .resampling import CubicScan, cubic
from .structure import (
    BLOB_VARIANCE,
    DIRECTIONS,
    HALO,
    LINE_SHARE,
    MEAN_REACH,
    NOISE_SHARE,
    PERSISTS,
    SMOOTHING,
    TAPS,
    bump,
    cut_block,
    find_peaks,
    flat_limit,
    local_mean,
    ripple,
    smoothed,
    top_around,
)
from .thresholds import BELOW_NOISE, BLOCK, SOLID_VOLUME, Thresholds

SLAB_BYTES = 192 * 2**20
"""About what one slab takes as float32; three of them are in memory: one in work, one read ahead, one being read."""
LEAST_VOXELS = 4
"""Strand-like voxels in and just around a brick for it to be kept: fewer are noise."""
MARGIN = 2
"""Voxels around a brick that are looked at, too, so that a strand's flank beyond its brick is kept."""
CONTRAST = 0.4
"""A voxel is strand-like where the smoothed density exceeds the local mean by this share of a lone strand's smoothed peak."""
FALSE_BRICKS = 0.01
"""Share of the bricks of pure noise that may be kept. Where more would be by LEAST_VOXELS alone (signal to noise below 3.5),
voxels count only in clusters so large that noise makes fewer."""
CORE_MEAN = 0.4
"""Inside a body the local mean, too, is above this share of its threshold; over a thin bundle of hair it is not."""
FLAT_EVERY = 2
"""Ripple is measured at every second voxel along each axis."""
KNOT_LINE = 55
"""A blob keeps at most this share, percent, of its peak on both sides in its best direction."""
BUMP = 0.6
"""On the mannequin's skin a knot is a bump of at least this share of what a knot at the threshold makes."""
MOST_KNOTS = 1024
"""Knots noted in a block of 48^3 voxels."""
FINE_UNITS, MOST_STRANDS = 32, 16
"""A lone strand is at least so many units of what is stored whole, and so many of them fit in."""
ENOUGH_BUMPS = 500
"""Knots on the mannequin's skin from which on no others are needed."""


@dataclass(frozen=True)
class WigScan:
    """A wig as later stages need it, in the scan frame.

    density: BrickVolume, air at 0, but exactly 0 only where the mannequin was cleared and nothing is known; int16 in the scan's
    own units where they are fine enough for that (CT numbers are), else float32. hair_level: density above which a voxel is
    hair.
    knots: (K, 3) float32 mm, blobs denser than strands: knots of the net, and some chance crossings of hair.
    solid_points: (S, 3) float32 mm on the mannequin's outer surface; none without a mannequin. tally: what was kept and left
    out. warnings: what was assumed.
    """

    density: BrickVolume
    hair_level: float
    knots: np.ndarray
    solid_points: np.ndarray
    thresholds: Thresholds
    tally: dict[str, int]
    warnings: tuple[str, ...] = ()

    @property
    def counted(self) -> bool:
        """Whether the knots are as many as the strands: all are found by a mannequin's skin; without one they are few."""
        return len(self.solid_points) > 0


def import_scan(
    reader: ScanReader, thresholds: Thresholds, settings: ScanSettings | None = None, progress: Progress = silent
) -> WigScan:
    """The wig in a scan. Voxels that are no cubes are resampled to cubes. Raises ScanError where no hair is left, or where
    the thresholds were in doubt and no mannequin wears knots."""
    scan = cubic(reader)
    levels = _Levels.of(thresholds, float(scan.spacing[0]))
    size = [scan.shape[axis] for axis in scan.order]
    table = np.full([-(-n // BRICK) for n in size], -1, np.int32)
    core_table = table.copy()
    bricks = np.empty((0, BRICK, BRICK, BRICK), _storage(thresholds))
    cores: list[np.ndarray] = []
    flats: list[np.ndarray] = []
    wanted: list[np.ndarray] = []
    knots: list[np.ndarray] = []
    bumps: list[np.ndarray] = []
    stored = solid = hair_voxels = 0
    for low, slab, before, own in _slabs(scan, progress):
        found = _look(slab, before, own, low, levels)
        knots.append(found.knots)
        bumps.append(found.bumps)
        rows = np.argwhere(found.flags > 0)
        place = rows + [low // BRICK, 0, 0]
        table[tuple(place.T)] = stored + np.arange(len(rows), dtype=np.int32)
        stored += len(rows)
        flags = found.flags[tuple(rows.T)]
        wanted.append(flags & 1 > 0)
        hair_voxels += int(found.hair)
        bricks.resize((stored, BRICK, BRICK, BRICK), refcheck=False)  # grows where it lies: no second copy of a large scan
        _cut_bricks(slab, rows, before, levels.air, bricks.dtype.kind == "i", bricks[stored - len(rows) :])
        dense = np.flatnonzero(flags & 2)
        core_table[tuple(place[dense].T)] = solid + np.arange(len(dense), dtype=np.int32)
        solid += len(dense)
        cores.append(found.cores[tuple(rows[dense].T)])
        flats.append(found.flats[tuple(rows[dense].T)])
    dense, flat = (np.concatenate(parts) if parts else np.zeros((0, BRICK, BRICK), np.uint16) for parts in (cores, flats))
    keep = np.concatenate(wanted) if wanted else np.zeros(0, bool)
    cell = float(scan.spacing[0])
    bodies = Bodies.of(core_table, dense, flat, cell)
    surface = np.zeros((0, 3))
    cleared = 0
    if bodies.volume > 0.0:
        surface = bodies.surface(size)
        index = np.empty((stored, 3), np.int32)
        where = np.argwhere(table >= 0)
        index[table[tuple(where.T)]] = where
        cleared = bodies.clear(index, bricks)
        # what is stored for its dense voxels alone stays where that was hair after all
        keep |= (core_table[tuple(index.T)] >= 0) & ~bodies.lie_in(index)
        bumps = [found[bodies.near(np.rint(found).astype(np.int64))] for found in bumps]
        worn = sum(len(found) for found in bumps) >= ENOUGH_BUMPS
        if worn:
            # knots on the mannequin's skin are sure; blobs elsewhere are hair that crosses
            knots = [np.zeros((0, 3), np.float32)]
    else:
        keep[:] = True
        worn = False
    if thresholds.doubt and not worn:
        raise ScanError(thresholds.doubt)
    knots += bumps
    table, bricks = _kept(table, bricks, keep)
    density = _in_scan_axes(table, bricks, scan)
    tally = {
        "voxels of the scan": int(np.prod(scan.shape, dtype=np.int64)),
        "strand-like voxels": hair_voxels,
        "bricks kept": len(bricks),
        "bricks left out: air": int(np.prod(table.shape)) - stored,
        "bricks left out: mannequin": stored - len(bricks),
        "voxels cleared: mannequin": cleared,
        "knot points": sum(len(found) for found in knots),
        "mannequin surface points": len(surface),
        "voxels without a number, taken as air": scan.not_numbers,
    }
    if not len(bricks):
        raise ScanError(
            f"{scan.path}: no hair is left above air ({thresholds.air:.6g}) at the hair level {thresholds.hair:.6g}; "
            "set scan.hair lower"
        )
    if thresholds.solid is not None and bodies.volume == 0.0:
        where = f"no body of at least {SOLID_VOLUME / 1000:.0f} cm3 lies above scan.solid ({thresholds.solid:.6g})"
        warnings = (*scan.warnings, f"{where}: the scan is taken as having no mannequin")
    else:
        warnings = tuple(scan.warnings)
    if thresholds.doubt:
        worn_knots = f"the {tally['knot points']:,} knots on its mannequin"
        warnings += (f"{scan.path}: little hair runs alone; taken for a wig by {worn_knots}",)
    axes = np.argsort(scan.order)
    points = [
        (np.asarray(found, np.float64)[:, axes] * cell + scan.origin).astype(np.float32)
        for found in (np.concatenate(knots), surface)
    ]
    progress(1.0, 1.0)
    return WigScan(density, float(thresholds.hair - thresholds.air), points[0], points[1], thresholds, tally, warnings)


@dataclass(frozen=True)
class _Levels:
    """Densities above air: strand-like contrast, knots (smoothed), the mannequin's core; float32. solid is huge for none.

    cluster: strand-like voxels that must hang together; 1 for any. flat: the ripple that the mannequin stays below; infinite
    where the settings give the mannequin's level, which then decides.
    """

    air: np.float32
    contrast: np.float32
    cluster: int
    knots: np.float32
    solid: np.float32
    flat: np.float32

    @classmethod
    def of(cls, thresholds: Thresholds, spacing: float) -> _Levels:
        contrast = max(
            CONTRAST * LINE_SHARE * thresholds.strand, 0.8 * BELOW_NOISE * NOISE_SHARE * thresholds.noise, 1e-30
        )  # fmt: skip
        if "hair" in thresholds.chosen:
            contrast = LINE_SHARE * (thresholds.hair - thresholds.air)
        cluster = noise_cluster(float(contrast) / max(NOISE_SHARE * thresholds.noise, 1e-30))
        knots = LINE_SHARE * (thresholds.knots - thresholds.air)
        solid = thresholds.solid - thresholds.air if thresholds.solid is not None else 3e38
        flat = np.inf if "solid" in thresholds.chosen else flat_limit(spacing)
        air, contrast, knots, solid, flat = (np.float32(v) for v in (thresholds.air, contrast, knots, solid, flat))
        return cls(air, contrast, cluster, knots, solid, flat)


def noise_cluster(level: float) -> int:
    """How many voxels above `level`, in standard deviations of the smoothed noise, must hang together to be no noise: 1 where
    LEAST_VOXELS is enough to keep but FALSE_BRICKS of the bricks of noise out.

    Clusters over a high level of a smooth Gaussian field come at random, so many a voxel, and their sizes to the power 2/3 are
    exponential
    (Friston et al. 1994, Assessing the significance of focal activations using their spatial extent, eqs. 2, 3, 11).
    """
    rough = 2.0 * SMOOTHING**2  # the field's roughness is 1 / rough on each axis
    voxel = (level**2 - 1.0) * math.exp(-0.5 * level**2) / ((2.0 * math.pi) ** 2 * rough**1.5)
    brick = voxel * (BRICK + 2 * MARGIN) ** 3
    if level <= 1.5 or brick <= FALSE_BRICKS:
        return 1
    above = 0.5 * math.erfc(level / math.sqrt(2.0))
    shape = (math.gamma(2.5) * voxel / above) ** (2.0 / 3.0)
    least = (math.log(brick / FALSE_BRICKS) / shape) ** 1.5
    return math.ceil(least) if least > LEAST_VOXELS else 1


@dataclass(frozen=True)
class _Found:
    """What a slab holds.

    flags: (bricks) uint8, 1 strand-like, 2 dense core. cores, flats: uint16 rows of core voxels and of those that are flat.
    knots, bumps: (K, 3) places in voxels, between them too, of blobs in the hair and on the mannequin's skin. hair: strand-like
    voxels.
    """

    flags: np.ndarray
    cores: np.ndarray
    flats: np.ndarray
    knots: np.ndarray
    bumps: np.ndarray
    hair: int


def _slabs(scan: ScanReader | CubicScan, progress: Progress) -> Iterator[tuple[int, np.ndarray, int, int]]:
    """(first slice, slab with its halo, slices of halo before the first, slices without the halo) one after another; the next
    are read meanwhile."""
    depth = scan.shape[scan.order[0]]
    plane = 4 * scan.shape[scan.order[1]] * scan.shape[scan.order[2]]
    thick = max(SLAB_BYTES // (BLOCK * plane), 1) * BLOCK
    starts = list(range(0, depth, thick))

    def read(start: int) -> np.ndarray:
        return scan.native(start, min(start + thick, depth))

    with ThreadPoolExecutor(1) as pool:
        ahead = [pool.submit(read, start) for start in starts[:2]]
        try:
            before = np.zeros((0, 0, 0), np.float32)
            current = ahead.pop(0).result()
            for number, start in enumerate(starts):
                progress(start, depth)
                if number + 2 < len(starts):
                    ahead.append(pool.submit(read, starts[number + 2]))
                following = ahead.pop(0).result() if number + 1 < len(starts) else None
                parts = [
                    part
                    for part in (before, current, None if following is None else following[:HALO])
                    if part is not None and len(part)
                ]
                yield start, np.concatenate(parts) if len(parts) > 1 else parts[0], len(before), len(current)
                before, current = current[-HALO:].copy(), following
        finally:
            for waiting in ahead:
                waiting.cancel()


def _look(slab: np.ndarray, before: int, own: int, low: int, levels: _Levels) -> _Found:
    """Flags, cores and knots of a slab's `own` slices, after `before` of halo; low: the first own one's number in the scan."""
    shape = [-(-own // BRICK), *(-(-n // BRICK) for n in slab.shape[1:])]
    flags = np.zeros(shape, np.uint8)
    cores = np.zeros((*shape, BRICK, BRICK), np.uint16) if levels.solid < 3e38 else np.zeros((0, 0, 0, BRICK, BRICK), np.uint16)
    flats = np.zeros_like(cores)
    corners = np.stack(np.meshgrid(*(np.arange(0, n, BLOCK // BRICK) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    knots = np.empty((len(corners), MOST_KNOTS, 3), np.float32)
    counts = np.zeros((len(corners), 3), np.int64)
    _mark(
        slab, before, own, corners, levels.air, levels.contrast, levels.cluster, levels.knots, levels.solid, levels.flat, TAPS,
        DIRECTIONS, flags, cores, flats, knots, counts,
    )  # fmt: skip
    on_skin = np.concatenate([knots[n, :count] for n, count in enumerate(counts[:, 2])]) + [low, 0, 0]
    in_hair = np.concatenate([knots[n, first:end] for n, (end, _, first) in enumerate(counts)]) + [low, 0, 0]
    return _Found(flags, cores, flats, in_hair, on_skin, int(counts[:, 1].sum()))


@numba.njit(cache=True, parallel=True, nogil=True)
def _mark(
    slab, before, own, corners, air, contrast, cluster, knots, solid, flat, taps, directions,
    flags, cores, flats, places, counts,
):  # fmt: skip
    reach = MARGIN + CLEAR
    for n in numba.prange(len(corners)):
        low = corners[n] * BRICK
        start = np.array([low[0] + before, low[1], low[2]])
        block = np.empty((BLOCK + 2 * HALO, BLOCK + 2 * HALO, BLOCK + 2 * HALO), np.float32)
        cut_block(slab, start, HALO, air, block)
        smooth = smoothed(block, taps)  # 6 voxels more than the block on every side
        mean = local_mean(block, MEAN_REACH)  # 5 voxels more
        edge = HALO - 3 - reach
        wide = BLOCK + 2 * reach
        some = False
        near = np.zeros((wide, wide, wide), np.bool_)
        if solid < 3e38:
            for i in range(wide):
                for j in range(wide):
                    for k in range(wide):
                        if smooth[i + edge, j + edge, k + edge] > solid and mean[i, j, k] > CORE_MEAN * solid:
                            near[i, j, k] = True
                            some = True
        if some:
            for i in range(BLOCK):
                for j in range(BLOCK):
                    for k in range(BLOCK):
                        if near[i + reach, j + reach, k + reach]:
                            I, J, K = corners[n, 0] + i // BRICK, corners[n, 1] + j // BRICK, corners[n, 2] + k // BRICK
                            if I < flags.shape[0] and J < flags.shape[1] and K < flags.shape[2]:
                                flags[I, J, K] |= 2
                                bit = np.uint16(1) << np.uint16(k % BRICK)
                                cores[I, J, K, i % BRICK, j % BRICK] |= bit
                                if i % FLAT_EVERY or j % FLAT_EVERY or k % FLAT_EVERY:
                                    continue
                                inner = reach + edge
                                if ripple(smooth, i + inner, j + inner, k + inner) < flat:
                                    flats[I, J, K, i % BRICK, j % BRICK] |= bit
            _widen(near, CLEAR)
            counts[n, 0] = counts[n, 2] = _bumps(
                smooth, mean, near, reach, edge, solid, BUMP * knots / BLOB_VARIANCE, low, own, places[n]
            )
        lone = np.zeros((wide, wide, wide) if cluster > 1 else (0, 0, 0), np.bool_)
        if cluster > 1:
            for i in range(wide):
                for j in range(wide):
                    for k in range(wide):
                        over = smooth[i + edge, j + edge, k + edge] - mean[i, j, k] > contrast
                        lone[i, j, k] = over and not near[i, j, k]
            _leave_small(lone, cluster)
        found = np.zeros((BLOCK // BRICK, BLOCK // BRICK, BLOCK // BRICK), np.int64)
        beside = np.zeros(found.shape, np.bool_)
        if some and cluster > 1:
            # beside a body the mean is high, and hair that lies on it shows little over that: there any voxel counts
            for i in range(reach, reach + BLOCK):
                for j in range(reach, reach + BLOCK):
                    for k in range(reach, reach + BLOCK):
                        if near[i, j, k]:
                            beside[(i - reach) // BRICK, (j - reach) // BRICK, (k - reach) // BRICK] = True
        for i in range(CLEAR, wide - CLEAR):
            for j in range(CLEAR, wide - CLEAR):
                for k in range(CLEAR, wide - CLEAR):
                    if smooth[i + edge, j + edge, k + edge] - mean[i, j, k] <= contrast or near[i, j, k]:
                        continue
                    small = cluster > 1 and lone[i, j, k]
                    a, b, c = i - reach, j - reach, k - reach
                    if not small and 0 <= a < BLOCK and 0 <= b < BLOCK and 0 <= c < BLOCK:
                        counts[n, 1] += 1
                    for I in range(max(a - MARGIN, 0) // BRICK, min(a + MARGIN, BLOCK - 1) // BRICK + 1):
                        for J in range(max(b - MARGIN, 0) // BRICK, min(b + MARGIN, BLOCK - 1) // BRICK + 1):
                            for K in range(max(c - MARGIN, 0) // BRICK, min(c + MARGIN, BLOCK - 1) // BRICK + 1):
                                if not small or beside[I, J, K]:
                                    found[I, J, K] += 1
        for a in range(found.shape[0]):
            for b in range(found.shape[1]):
                for c in range(found.shape[2]):
                    I, J, K = corners[n, 0] + a, corners[n, 1] + b, corners[n, 2] + c
                    if found[a, b, c] >= LEAST_VOXELS and I < flags.shape[0] and J < flags.shape[1] and K < flags.shape[2]:
                        flags[I, J, K] |= 1
        place = np.empty((8 * MOST_KNOTS, 3), np.int16)
        value = np.empty((8 * MOST_KNOTS, 2), np.float32)
        goes_on = np.empty((8 * MOST_KNOTS, 2), np.int16)
        inner = mean[reach : reach + BLOCK, reach : reach + BLOCK, reach : reach + BLOCK]
        peaks = find_peaks(smooth, inner, HALO - 3, 0.5 * knots, directions, PERSISTS, place, value, goes_on)
        for p in range(peaks):
            i, j, k = place[p, 0], place[p, 1], place[p, 2]
            if value[p, 0] <= knots or goes_on[p, 1] > KNOT_LINE or near[i + reach, j + reach, k + reach]:
                continue
            if low[0] + i >= own or counts[n, 0] == MOST_KNOTS:
                continue
            at, margin = counts[n, 0], HALO - 3
            x, y, z = top_around(smooth, i + margin, j + margin, k + margin)
            x, y, z = low[0] + x - margin, low[1] + y - margin, low[2] + z - margin
            places[n, at, 0], places[n, at, 1], places[n, at, 2] = x, y, z
            counts[n, 0] += 1


@numba.njit(cache=True, nogil=True)
def _leave_small(where, least):
    """Leave True only in clusters of `where`, over the faces of voxels, of fewer than `least`."""
    n = len(where)
    stack = np.empty((n**3, 3), np.int16)
    seen = np.zeros((n, n, n), np.bool_)
    for a in range(n):
        for b in range(n):
            for c in range(n):
                if not where[a, b, c] or seen[a, b, c]:
                    continue
                seen[a, b, c] = True
                stack[0, 0], stack[0, 1], stack[0, 2] = a, b, c
                count, at = 1, 0
                while at < count:
                    i, j, k = stack[at, 0], stack[at, 1], stack[at, 2]
                    at += 1
                    for axis in range(3):
                        for step in range(-1, 2, 2):
                            x = i + (step if axis == 0 else 0)
                            y = j + (step if axis == 1 else 0)
                            z = k + (step if axis == 2 else 0)
                            if x < 0 or y < 0 or z < 0 or x >= n or y >= n or z >= n or seen[x, y, z] or not where[x, y, z]:
                                continue
                            seen[x, y, z] = True
                            stack[count, 0], stack[count, 1], stack[count, 2] = x, y, z
                            count += 1
                if count >= least:
                    for at in range(count):
                        where[stack[at, 0], stack[at, 1], stack[at, 2]] = False


@numba.njit(cache=True, nogil=True)
def _bumps(smooth, mean, near, reach, edge, solid, least, low, own, places):
    """Note the knots on the mannequin's skin, the block's strongest bumps in its band; returns how many."""
    size = BLOCK + 2
    height = np.zeros((size, size, size), np.float32)
    for i in range(size):
        for j in range(size):
            for k in range(size):
                a, b, c = i - 1 + reach, j - 1 + reach, k - 1 + reach
                if near[a, b, c] and smooth[a + edge, b + edge, c + edge] > 0.1 * solid:
                    height[i, j, k] = bump(smooth, a + edge, b + edge, c + edge)
    count = 0
    for i in range(1, size - 1):
        for j in range(1, size - 1):
            for k in range(1, size - 1):
                here = height[i, j, k]
                if here < least or low[0] + i - 1 >= own or count == len(places):
                    continue
                highest = True
                for a in range(-1, 2):
                    for b in range(-1, 2):
                        for c in range(-1, 2):
                            if height[i + a, j + b, k + c] > here:
                                highest = False
                if highest:
                    x, y, z = top_around(height, i, j, k)
                    places[count, 0], places[count, 1], places[count, 2] = low[0] + x - 1, low[1] + y - 1, low[2] + z - 1
                    count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _widen(mask, reach):
    """Grow a mask by a cube of `reach` voxels, in place."""
    size = mask.shape[0]
    line = np.empty(size, np.bool_)
    for axis in range(3):
        for i in range(size):
            for j in range(size):
                last = -reach - 1
                for k in range(size):
                    line[k] = mask[k, i, j] if axis == 0 else mask[i, k, j] if axis == 1 else mask[i, j, k]
                for k in range(size + reach):
                    if k < size and line[k]:
                        last = k
                    at = k - reach
                    if at >= 0 and last >= at - reach:
                        if axis == 0:
                            mask[at, i, j] = True
                        elif axis == 1:
                            mask[i, at, j] = True
                        else:
                            mask[i, j, at] = True


def _storage(thresholds: Thresholds) -> type:
    """int16 where a strand is many of the scan's units and few of int16's range, as in CT numbers; half of float32's memory."""
    return np.int16 if FINE_UNITS <= thresholds.strand <= np.iinfo(np.int16).max / MOST_STRANDS else np.float32


@numba.njit(cache=True, parallel=True, nogil=True)
def _cut_bricks(slab, rows, before, air, whole, out):
    """Fill out (B, 16, 16, 16) with the slab's bricks `rows` less air; rounded to int16's range with `whole`. None is exactly
    0, which is kept for what is cleared: such voxels take the least values there are, one above 0 and the next below."""
    least = 1.0 if whole else LEAST
    for n in numba.prange(len(rows)):
        start = np.array([rows[n, 0] * BRICK + before, rows[n, 1] * BRICK, rows[n, 2] * BRICK])
        block = np.empty((BRICK, BRICK, BRICK), np.float32)
        cut_block(slab, start, 0, air, block)
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    value = block[i, j, k]
                    if whole:
                        value = min(max(np.rint(value), -32768.0), 32767.0)
                    if value == 0.0:
                        value = least if (i + j + k) & 1 else -least
                    out[n, i, j, k] = value


def _kept(table: np.ndarray, bricks: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The table and bricks of those to be kept; rows move down in place, since a second copy may not fit."""
    # the row past the last is what -1, a brick that is not stored, points to
    number = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1).astype(np.int32)
    table = number[table]
    chunk, at = 1024, 0
    for start in range(0, len(bricks), chunk):
        part = bricks[start : start + chunk][keep[start : start + chunk]]
        bricks[at : at + len(part)] = part
        at += len(part)
    return table, bricks[:at]


def _in_scan_axes(table: np.ndarray, bricks: np.ndarray, scan: ScanReader | CubicScan) -> BrickVolume:
    """The volume with axes x, y, z from the file's own order."""
    axes = tuple(int(n) for n in np.argsort(scan.order))
    if axes != (0, 1, 2):
        table = np.ascontiguousarray(table.transpose(axes))
        for start in range(0, len(bricks), 1024):
            part = bricks[start : start + 1024]
            bricks[start : start + 1024] = part.transpose(0, *(1 + a for a in axes)).copy()
    return BrickVolume(table, bricks, float(scan.spacing[0]), scan.origin)
