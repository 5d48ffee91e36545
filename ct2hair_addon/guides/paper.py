"""Guide strands the paper's way: mean shift of the oriented points, Euler segments, Algorithm 1, growing (3.2.2, supplement 2).

Nam et al. 2019 ("Strand-accurate multi-view hair capture", 5.1) give the filter: a point moves, in the plane normal to its
orientation, to the weighted mean of its neighbours, and takes their mean orientation. What neither text fixes is in the
constants below, chosen once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from ..head import Head
from ..progress import Progress, part, silent
from ..settings import GuideSettings
from ..strands import Strands, concatenate, normalized, offsets_from_counts
from ..volume.grid import BRICK, BrickVolume
from .seeds import _hash

BANDWIDTH = 1.0
"""voxel; width of the Gaussian over distance: about a strand's own radius in the thresholded scan."""
NEIGHBOURHOOD = 2
"""voxel; neighbours are looked for this far: two bandwidths."""
ANGLE = 20.0
"""degrees; width of the Gaussian over the angle between two orientations."""
SHIFTS = 8
"""Steps of the mean shift at most; most points rest after four."""
AT_REST = 0.02
"""voxel; a shorter shift is the last."""
MOST_SHIFT = 2.0
"""voxel; how far a point may come from its voxel in all: farther it is another strand's."""
CAPTURE = 1.5
"""voxel; filtered points this close to an Euler step's end draw it onto themselves."""
CAPTURE_WIDTH = 0.75
"""voxel; width of the Gaussian of that."""
TAKEN = 1.5
"""voxel; points this close to a segment, and within `guides.max_turn` of its direction, belong to it and to no other."""
SHORTEST = 6
"""Points of a segment at least, as in tracing: fewer are noise, however long a voxel is."""
MOST_STEPS = 4000
STALE = 3
"""Steps without a point that is new to the segment after which it ends: it runs in a circle."""
BRICKS_A_CALL = 512
SEEDS_A_CALL = 200_000
PATH_ROOM = 1 << 22
"""Points of the segments found in one call at most; the call returns early where they would not fit."""


@dataclass(frozen=True)
class OrientedPoints:
    """The point cloud with orientations: places (M, 3) float32 in voxels, directions (M, 3) float32 unit, sign without
    meaning, confidence (M,) uint8."""

    places: np.ndarray
    directions: np.ndarray
    confidence: np.ndarray

    def __len__(self) -> int:
        return len(self.places)


def filtered_points(direction: BrickVolume, confidence: BrickVolume, progress: Progress = silent) -> OrientedPoints:
    """P'_theta: every voxel with an orientation, after the mean shift (Nam et al. 2019, 5.1).

    direction: int8 (B, 16, 16, 16, 3), confidence: uint8 (B, 16, 16, 16), 0 where there is none, as in the orientation field.
    The same on any number of threads.
    """
    table, corners = confidence.table, confidence.brick_index.astype(np.int64) * BRICK
    starts = offsets_from_counts(confidence.count_above(0))
    confidence, direction = confidence.bricks, direction.bricks
    places, directions = np.empty((starts[-1], 3), np.float32), np.empty((starts[-1], 3), np.float32)
    sure = np.empty(starts[-1], np.uint8)
    for first in range(0, len(corners), BRICKS_A_CALL):
        progress(first, len(corners))
        last = min(first + BRICKS_A_CALL, len(corners))
        _shift(
            table, direction, confidence, corners, starts, first, last, BANDWIDTH, np.radians(ANGLE), places, directions, sure,
        )  # fmt: skip
    progress(1.0, 1.0)
    return OrientedPoints(places, directions, sure)


@numba.njit(cache=True, parallel=True)
def _shift(table, direction, confidence, corners, starts, first, last, width, angle, places, directions, sure):
    halo = NEIGHBOURHOOD + int(np.ceil(MOST_SHIFT)) + 1
    size = BRICK + 2 * halo
    near, turned = -0.5 / (width * width), -0.5 / np.sin(angle) ** 2
    reach2 = float(NEIGHBOURHOOD * NEIGHBOURHOOD)
    for b in numba.prange(first, last):
        # the orientations around the brick, a dense block
        block = np.zeros((size, size, size, 3), np.float32)
        for i in range(size):
            for j in range(size):
                for k in range(size):
                    x, y, z = corners[b, 0] + i - halo, corners[b, 1] + j - halo, corners[b, 2] + k - halo
                    if min(x, y, z) < 0 or x >> 4 >= table.shape[0] or y >> 4 >= table.shape[1] or z >> 4 >= table.shape[2]:
                        continue
                    row = table[x >> 4, y >> 4, z >> 4]
                    if row >= 0 and confidence[row, x & 15, y & 15, z & 15] > 0:
                        a = float(direction[row, x & 15, y & 15, z & 15, 0])
                        c = float(direction[row, x & 15, y & 15, z & 15, 1])
                        e = float(direction[row, x & 15, y & 15, z & 15, 2])
                        norm = 1.0 / np.sqrt(a * a + c * c + e * e)
                        block[i, j, k, 0], block[i, j, k, 1], block[i, j, k, 2] = a * norm, c * norm, e * norm
        at = starts[b]
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    if confidence[b, i, j, k] == 0:
                        continue
                    x0, y0, z0 = float(i + halo), float(j + halo), float(k + halo)
                    x, y, z = x0, y0, z0
                    dx, dy, dz = block[i + halo, j + halo, k + halo]
                    for _ in range(SHIFTS):
                        ci, cj, ck = int(x + 0.5), int(y + 0.5), int(z + 0.5)
                        weight = mx = my = mz = ox = oy = oz = 0.0
                        for p in range(ci - NEIGHBOURHOOD, ci + NEIGHBOURHOOD + 1):
                            for q in range(cj - NEIGHBOURHOOD, cj + NEIGHBOURHOOD + 1):
                                for r in range(ck - NEIGHBOURHOOD, ck + NEIGHBOURHOOD + 1):
                                    ax, ay, az = p - x, q - y, r - z
                                    square = ax * ax + ay * ay + az * az
                                    if square > reach2:
                                        continue
                                    nx, ny, nz = block[p, q, r, 0], block[p, q, r, 1], block[p, q, r, 2]
                                    cosine = nx * dx + ny * dy + nz * dz
                                    if abs(cosine) < 0.5:  # off the hair, or another strand that crosses
                                        continue
                                    w = np.exp(near * square + turned * (1.0 - cosine * cosine))
                                    weight += w
                                    mx, my, mz = mx + w * ax, my + w * ay, mz + w * az
                                    w = w if cosine >= 0.0 else -w
                                    ox, oy, oz = ox + w * nx, oy + w * ny, oz + w * nz
                        if weight <= 0.0:
                            break
                        mx, my, mz = mx / weight, my / weight, mz / weight
                        along = mx * dx + my * dy + mz * dz
                        mx, my, mz = mx - along * dx, my - along * dy, mz - along * dz
                        ax, ay, az = x + mx - x0, y + my - y0, z + mz - z0
                        if ax * ax + ay * ay + az * az > MOST_SHIFT * MOST_SHIFT:
                            break
                        x, y, z = x + mx, y + my, z + mz
                        norm = 1.0 / np.sqrt(ox * ox + oy * oy + oz * oz)
                        dx, dy, dz = ox * norm, oy * norm, oz * norm
                        if mx * mx + my * my + mz * mz < AT_REST * AT_REST:
                            break
                    places[at, 0] = corners[b, 0] + x - halo
                    places[at, 1] = corners[b, 1] + y - halo
                    places[at, 2] = corners[b, 2] + z - halo
                    directions[at, 0], directions[at, 1], directions[at, 2] = dx, dy, dz
                    sure[at] = confidence[b, i, j, k]
                    at += 1


def euler_segments(
    points: OrientedPoints, shape, spacing: float, settings: GuideSettings, seed: int, progress: Progress = silent
) -> tuple[Strands, dict[str, int]]:
    """Segments through the filtered points by forward Euler steps, in voxels, each point in one segment at most.

    shape: bricks along x, y, z of the volume. Seeds are tried surest first. A segment ends where no point lies ahead, where
    it would turn more than `max_turn` in one step, and where all points belong to other segments.
    """
    tally = dict.fromkeys(("seeds already taken", "segments too short", *_ENDS), 0)
    if not len(points):
        return Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64)), tally | {"segments": 0}
    table, heads, following = _cells(points.places, np.array(shape, np.int64))
    order = _seed_order(points.confidence, seed)
    owner = np.full(len(points), -1, np.int32)
    shortest = max(round(settings.min_length / (settings.step * spacing)), SHORTEST)
    turn = np.cos(np.radians(settings.max_turn))
    room = min(PATH_ROOM, 4 * len(points) + 2 * MOST_STEPS + 2)
    paths, ends = np.empty((room, 3), np.float32), np.empty((room // 2, 2), np.int64)
    lengths = np.empty(room // 2, np.int64)
    pieces, sizes = [], []
    at, number = 0, 0
    while at < len(order):
        progress(at, len(order))
        last = min(at + SEEDS_A_CALL, len(order))
        at, number, found, stored, skipped, short = _trace(
            points.places, points.directions, table, heads, following, order, owner, at, last, number, settings.step, turn,
            shortest, paths, lengths, ends,
        )  # fmt: skip
        pieces.append(paths[:stored].copy())
        sizes.append(lengths[:found].copy())
        tally["seeds already taken"] += skipped
        tally["segments too short"] += short
        for reason, name in enumerate(_ENDS):
            tally[name] += int((ends[:found] == reason).sum())
    segments = Strands(np.concatenate(pieces), offsets_from_counts(np.concatenate(sizes)))
    progress(1.0, 1.0)
    return segments, tally | {"segments": len(segments)}


_ENDS = ("ended: no points ahead", "ended: turn too sharp", "ended: points of another segment", "ended: ran in a circle")
NOTHING, TURN, OTHERS, CIRCLE = range(4)


def _seed_order(confidence: np.ndarray, seed: int) -> np.ndarray:
    """(M,) int64: surest points first, shuffled among equals."""
    return np.argsort(((255 - confidence.astype(np.int64)) << 32) + _shuffle(len(confidence), seed), kind="stable")


@numba.njit(cache=True, parallel=True)
def _shuffle(count, seed):
    keys = np.empty(count, np.int64)
    for n in numba.prange(count):
        keys[n] = _hash(n, seed)
    return keys


@numba.njit(cache=True)
def _cells(places, shape):
    """Linked lists of the points in each voxel: table of bricks, heads (B, 4096), following (M,); -1 ends a list."""
    table = np.full((shape[0], shape[1], shape[2]), -1, np.int32)
    count = 0
    for n in range(len(places)):
        i, j, k = _cell(places, n, table)
        if table[i >> 4, j >> 4, k >> 4] < 0:
            table[i >> 4, j >> 4, k >> 4] = count
            count += 1
    heads = np.full((count, BRICK * BRICK * BRICK), -1, np.int32)
    following = np.full(len(places), -1, np.int32)
    for n in range(len(places)):
        i, j, k = _cell(places, n, table)
        row, cell = table[i >> 4, j >> 4, k >> 4], ((i & 15) << 8) + ((j & 15) << 4) + (k & 15)
        following[n] = heads[row, cell]
        heads[row, cell] = n
    return table, heads, following


@numba.njit(cache=True, inline="always")
def _cell(places, n, table):
    i = min(max(int(np.floor(places[n, 0] + 0.5)), 0), BRICK * table.shape[0] - 1)
    j = min(max(int(np.floor(places[n, 1] + 0.5)), 0), BRICK * table.shape[1] - 1)
    k = min(max(int(np.floor(places[n, 2] + 0.5)), 0), BRICK * table.shape[2] - 1)
    return i, j, k


@numba.njit(cache=True)
def _walk(places, directions, table, heads, following, owner, number, x, y, z, dx, dy, dz, step, turn, path):
    """Euler steps from (x, y, z) along d into `path`; the points beside them become the segment's. Returns (points, reason)."""
    count, stale = 0, 0
    narrow = -0.5 / (CAPTURE_WIDTH * CAPTURE_WIDTH)
    reach = int(np.ceil(TAKEN))
    while count < len(path):
        px, py, pz = x + step * dx, y + step * dy, z + step * dz
        ci, cj, ck = int(np.floor(px + 0.5)), int(np.floor(py + 0.5)), int(np.floor(pz + 0.5))
        weight = mx = my = mz = ox = oy = oz = 0.0
        others, fresh = 0, 0
        for i in range(max(ci - reach, 0), min(ci + reach + 1, BRICK * table.shape[0])):
            for j in range(max(cj - reach, 0), min(cj + reach + 1, BRICK * table.shape[1])):
                for k in range(max(ck - reach, 0), min(ck + reach + 1, BRICK * table.shape[2])):
                    row = table[i >> 4, j >> 4, k >> 4]
                    n = heads[row, ((i & 15) << 8) + ((j & 15) << 4) + (k & 15)] if row >= 0 else -1
                    while n >= 0:
                        ax, ay, az = places[n, 0] - px, places[n, 1] - py, places[n, 2] - pz
                        square = ax * ax + ay * ay + az * az
                        cosine = directions[n, 0] * dx + directions[n, 1] * dy + directions[n, 2] * dz
                        if square <= TAKEN * TAKEN and abs(cosine) >= turn:
                            if owner[n] >= 0 and owner[n] != number:
                                others += 1
                            else:
                                if owner[n] < 0:
                                    fresh += 1
                                if square <= CAPTURE * CAPTURE:
                                    w = np.exp(narrow * square)
                                    weight += w
                                    mx, my, mz = mx + w * ax, my + w * ay, mz + w * az
                                    w = w if cosine >= 0.0 else -w
                                    ox += w * directions[n, 0]
                                    oy += w * directions[n, 1]
                                    oz += w * directions[n, 2]
                        n = following[n]
        if weight <= 0.0:
            return count, OTHERS if others > 0 else NOTHING
        stale = 0 if fresh > 0 else stale + 1
        if stale >= STALE:
            return count, CIRCLE
        mx, my, mz = mx / weight, my / weight, mz / weight
        along = mx * dx + my * dy + mz * dz
        norm = 1.0 / np.sqrt(ox * ox + oy * oy + oz * oz)
        ox, oy, oz = ox * norm, oy * norm, oz * norm
        if ox * dx + oy * dy + oz * dz < turn:
            return count, TURN
        x, y, z = px + mx - along * dx, py + my - along * dy, pz + mz - along * dz
        dx, dy, dz = ox, oy, oz
        path[count, 0], path[count, 1], path[count, 2] = x, y, z
        count += 1
        _take(places, directions, table, heads, following, owner, number, x, y, z, dx, dy, dz, turn)
    return count, CIRCLE


@numba.njit(cache=True)
def _take(places, directions, table, heads, following, owner, number, x, y, z, dx, dy, dz, turn):
    """Give the free points around (x, y, z) that run along d to segment `number`."""
    reach = int(np.ceil(TAKEN))
    ci, cj, ck = int(np.floor(x + 0.5)), int(np.floor(y + 0.5)), int(np.floor(z + 0.5))
    for i in range(max(ci - reach, 0), min(ci + reach + 1, BRICK * table.shape[0])):
        for j in range(max(cj - reach, 0), min(cj + reach + 1, BRICK * table.shape[1])):
            for k in range(max(ck - reach, 0), min(ck + reach + 1, BRICK * table.shape[2])):
                row = table[i >> 4, j >> 4, k >> 4]
                n = heads[row, ((i & 15) << 8) + ((j & 15) << 4) + (k & 15)] if row >= 0 else -1
                while n >= 0:
                    if owner[n] < 0:
                        ax, ay, az = places[n, 0] - x, places[n, 1] - y, places[n, 2] - z
                        cosine = directions[n, 0] * dx + directions[n, 1] * dy + directions[n, 2] * dz
                        if ax * ax + ay * ay + az * az <= TAKEN * TAKEN and abs(cosine) >= turn:
                            owner[n] = number
                    n = following[n]


@numba.njit(cache=True)
def _trace(
    places, directions, table, heads, following, order, owner, at, last, number, step, turn, shortest, paths, lengths, ends
):  # fmt: skip
    """Segments from the seeds order[at:last], one after another: who comes first owns the points. Returns how far it came,
    the next segment's number, segments and points stored, seeds that were taken, segments that were too short."""
    ahead, back = np.empty((MOST_STEPS, 3), np.float32), np.empty((MOST_STEPS, 3), np.float32)
    found = stored = skipped = short = 0
    while at < last and stored + 2 * MOST_STEPS + 1 <= len(paths) and found < len(lengths):
        seed = order[at]
        at += 1
        if owner[seed] >= 0:
            skipped += 1
            continue
        x, y, z = float(places[seed, 0]), float(places[seed, 1]), float(places[seed, 2])
        dx, dy, dz = float(directions[seed, 0]), float(directions[seed, 1]), float(directions[seed, 2])
        _take(places, directions, table, heads, following, owner, number, x, y, z, dx, dy, dz, turn)
        forth, end = _walk(
            places, directions, table, heads, following, owner, number, x, y, z, dx, dy, dz, step, turn, ahead
        )  # fmt: skip
        behind, begin = _walk(
            places, directions, table, heads, following, owner, number, x, y, z, -dx, -dy, -dz, step, turn, back
        )  # fmt: skip
        number += 1
        size = behind + forth + 1
        if size < shortest:
            short += 1
            continue
        for m in range(behind):
            paths[stored + m] = back[behind - 1 - m]
        paths[stored + behind, 0], paths[stored + behind, 1], paths[stored + behind, 2] = x, y, z
        paths[stored + behind + 1 : stored + size] = ahead[:forth]
        ends[found, 0], ends[found, 1] = begin, end
        lengths[found] = size
        found += 1
        stored += size
    return at, number, found, stored, skipped, short


def fine_and_poor(segments: Strands, head: Head, settings: GuideSettings) -> tuple[Strands, Strands]:
    """Algorithm 1: (fine strands, root first and on the scalp; poor segments). mm, scan frame."""
    long = segments.lengths() >= settings.fine_length
    forward, place = _connected(segments, head, settings)
    backward, other = _connected(segments.reversed(), head, settings)
    forward, backward = long & forward, long & ~forward & backward
    fine = segments.reversed(backward).select(forward | backward)
    roots = np.where(forward[:, None], place, other)[forward | backward]
    return _with_roots(fine, roots), segments.select(~(forward | backward))


def _connected(strands: Strands, head: Head, settings: GuideSettings) -> tuple[np.ndarray, np.ndarray]:
    """ConnectedRootsSearch: (N,) bool, the first point is within tau_c of the scalp and leaves it within tau_a of its normal;
    (N, 3) the scalp's nearest point."""
    first = strands.offsets[:-1]
    near = head.closest_scalp(strands.roots)
    direction = normalized(strands.points[np.minimum(first + 1, strands.offsets[1:] - 1)] - strands.points[first])
    steep = (near.normal * direction).sum(axis=1) >= np.cos(np.radians(settings.scalp_angle))
    return (near.distance <= settings.scalp_reach) & steep, near.position


def _with_roots(strands: Strands, roots: np.ndarray) -> Strands:
    """The strands with the points `roots` (N, 3) put before them."""
    if not len(strands):
        return strands
    points = np.insert(strands.points, strands.offsets[:-1], roots, axis=0)
    return Strands(points, offsets_from_counts(strands.counts + 1))


def grow_poor(poor: Strands, fine: Strands, head: Head, settings: GuideSettings) -> tuple[Strands, np.ndarray, dict[str, int]]:
    """Supplement 2, Algorithm 1: poor segments re-directed and grown along their nearest fine strands (mm).

    Returns (grown strands, (G,) index of each one's segment, tally). A segment without a fine strand within tau_s of its root
    end is deleted, as the text says; one without at its tip does not grow there.
    """
    tally = {"deleted: no fine strand near": len(poor), "deleted: ends disagree": 0, "deleted: grows only forward": 0}
    if not len(poor) or not len(fine):
        return Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64)), np.zeros(0, np.int64), tally
    tree = cKDTree(fine.points)
    growing = fine.tangents()
    reach = settings.neighbour_radius
    (gap0, p0), (gap1, p1) = (tree.query(ends, distance_upper_bound=reach) for ends in (poor.roots, poor.tips))
    has0, has1 = np.isfinite(gap0), np.isfinite(gap1)
    p0, p1 = np.where(has0, p0, 0), np.where(has1, p1, 0)
    first, last = poor.offsets[:-1], poor.offsets[1:] - 1
    s0 = normalized(poor.points[first + 1] - poor.points[first])
    s1 = normalized(poor.points[last - 1] - poor.points[last])
    dot0, dot1 = (s0 * growing[p0]).sum(axis=1), (s1 * growing[p1]).sum(axis=1)
    disagree = has0 & has1 & (dot0 < 0) & (dot1 < 0)
    # where only the other end has a fine strand near, that one says which way the segment runs
    turned = np.where(has0, dot0 < 0, dot1 > 0)
    p0, p1 = np.where(turned, p1, p0), np.where(turned, p0, p1)
    has0, has1 = np.where(turned, has1, has0), np.where(turned, has0, has1)
    tally["deleted: no fine strand near"] = int((~has0 & ~has1).sum())
    tally["deleted: ends disagree"] = int(disagree.sum())
    tally["deleted: grows only forward"] = int((~has0 & has1).sum())
    kept = np.flatnonzero(has0 & ~disagree)
    body = poor.reversed(turned).select(kept)
    p0, p1, has1 = p0[kept], p1[kept], has1[kept]
    strand0, strand1 = fine.strand_index[p0], fine.strand_index[p1]
    before = _steps_to_scalp(body.roots, fine, p0, fine.offsets[strand0], head, settings.scalp_reach)
    after = np.where(has1, fine.offsets[strand1 + 1] - 1 - p1, 0)
    grown = Strands(
        _joined(body.points, body.offsets, fine.points, p0, before, p1, after),
        offsets_from_counts(before + body.counts + after),
    )
    return grown, kept, tally


def _steps_to_scalp(roots, fine: Strands, p0, firsts, head: Head, reach: float) -> np.ndarray:
    """(G,) int64: how many points the first loop of the algorithm pushes: until within `reach` of the scalp or p0 at 0."""
    most = p0 - firsts
    starts = offsets_from_counts(most + 1)
    index = np.repeat(np.arange(len(p0)), most + 1)
    step = np.arange(starts[-1]) - starts[:-1][index]
    places = roots[index] + fine.points[p0[index] - step] - fine.points[p0[index]]
    there = head.closest_scalp(places).distance <= reach
    steps = most.copy()
    np.minimum.at(steps, index[there], step[there])
    return steps


@numba.njit(cache=True, parallel=True)
def _joined(points, offsets, fine, p0, before, p1, after):
    """Each body with `before` shifted points of the fine strand at p0 ahead of it and `after` ones of that at p1 behind."""
    starts = np.zeros(len(p0) + 1, np.int64)
    for n in range(len(p0)):
        starts[n + 1] = starts[n] + before[n] + offsets[n + 1] - offsets[n] + after[n]
    out = np.empty((starts[-1], 3), np.float32)
    for n in numba.prange(len(p0)):
        at, size = starts[n], offsets[n + 1] - offsets[n]
        first, last = points[offsets[n]], points[offsets[n + 1] - 1]
        for axis in range(3):
            for m in range(before[n]):
                out[at + m, axis] = first[axis] + fine[p0[n] - before[n] + m, axis] - fine[p0[n], axis]
            for m in range(size):
                out[at + before[n] + m, axis] = points[offsets[n] + m, axis]
            for m in range(after[n]):
                out[at + before[n] + size + m, axis] = last[axis] + fine[p1[n] + 1 + m, axis] - fine[p1[n], axis]
    return out


def paper_guides(
    density: BrickVolume,
    direction: BrickVolume,
    confidence: BrickVolume,
    head: Head,
    settings: GuideSettings,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[Strands, dict[str, int]]:
    """Guide strands of the paper, mm, root first and on the scalp, with `support` and `root_uv`; and the tally.

    density gives the frame alone: the paper's points hold a place and an orientation, no density.
    A grown strand stops within tau_c of the scalp; the interpolation needs its root on it, so the scalp's nearest point is put
    before it, as Algorithm 1 does for fine strands. One that its fine strand leads no nearer is deleted.
    """
    points = filtered_points(direction, confidence, part(progress, 0.0, 0.6))
    size = confidence.table.shape
    found, tally = euler_segments(points, size, density.spacing, settings, seed, part(progress, 0.6, 0.9))
    tally = {"oriented points": len(points)} | tally
    segments = Strands(density.to_scan(found.points), found.offsets)
    fine, poor = fine_and_poor(segments, head, settings)
    progress(0.93, 1.0)
    grown, source, more = grow_poor(poor, fine, head, settings)
    tally |= {"fine segments": len(fine), "poor segments": len(poor)} | more
    traced = poor.lengths()[source]
    near = head.closest_scalp(grown.roots) if len(grown) else None
    rooted = near.distance <= settings.scalp_reach if near is not None else np.zeros(0, bool)
    tally["deleted: grew to no root"] = int((~rooted).sum())
    grown = _with_roots(grown.select(rooted), near.position[rooted]) if near is not None else grown
    strands = concatenate([fine, grown])
    traced = np.concatenate([fine.lengths(), traced[rooted]])
    support = np.clip(traced / np.maximum(strands.lengths(), 1e-6), 0.0, 1.0).astype(np.float32)
    uv = head.closest_scalp(strands.roots).uv if len(strands) else np.zeros((0, 2), np.float32)
    tally["guides"] = len(strands)
    progress(1.0, 1.0)
    return strands.with_attributes(support=support, root_uv=uv.astype(np.float32)), tally
