"""What it costs to go on from a piece's tip in the root end of another, weighed for all that lie ahead of each other.

A joint costs what it bends more than hair does, what it bridges, and what the scan doesn't back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from ..progress import Progress, silent
from ..strands import Strands, nearest_points
from ..volume.grid import BrickVolume
from .pieces import STEP, Pieces
from .sampling import density_at

CUTS = (0.0, 4.0, 8.0, 12.0)
"""voxel; a trace may have gone too far, onto a neighbour: a joint may leave it this far before its end, and enter another
this far behind its beginning."""
NEAR_STATIONS = 3
"""Stations that are looked at from a cut: what goes on there lies near."""
ACROSS = 4.0
"""voxel to both sides of a cut that are left out when its going straight on is weighed: smoothing hides a hop."""
STATIONS = ((2.0, 3.5), (7.0, 4.5), (14.0, 5.5), (23.0, 7.0), (34.0, 8.5))
"""voxel; root ends are looked for around these points ahead of a tip, along its bend, within these radii."""
STRAIGHT = 10.0
"""voxel; and straight ahead of it as well where it is farther than this: nearer, both places are one."""
NEAREST = 12
"""Ends looked at around each station; twice as many where those of all CUTS lie there."""
MEETS = 16.0
"""Cost from which on a joint says nothing of which way its two pieces run."""
HELD = 96
"""Joints held of a tip, the cheapest: what they cost comes out within a ten-thousandth of what it does with all."""
BLOCK = 20_000
"""Tips looked at at once: what bounds memory."""
CELL = 16.0
"""voxel; along an edge of the cells that tips are looked at by."""
SPAN = 12.0
"""voxel; the length at an end that its course is fitted to."""
PLACE = (2.0, 0.1)
"""voxel, and voxel a voxel of gap: how far the two courses may miss each other in the middle of a gap."""
TURN = (0.5, 0.02)
"""radian, and radian a voxel of gap: by how much their directions may differ there."""
BEND = (0.08, 0.004)
"""1/voxel, and 1/voxel a voxel of gap: by how much their bends may differ: a curl's turns on as it came."""
PER_VOXEL = 0.5
UNBACKED = 6.0
"""Cost of a voxel of gap, and of a gap that the scan does not back at all."""
PER_CUT = 0.1
"""Cost of a voxel that is cut off a trace: at a fifth of it nearly any bend was dearer, and a tied wig lost a tenth of its
hair."""
LOOSE_END = 30.0
"""Cost of a tip that goes on nowhere, where it is not known how many strands there are: dearer joints are not made."""


@dataclass(frozen=True)
class Joints:
    """Candidates: piece `tip` goes on in piece `root`; cut (J, 2): points left off the one's tip and the other's root."""

    tip: np.ndarray
    root: np.ndarray
    cut: np.ndarray
    cost: np.ndarray


def weighed_joints(
    lines: Strands,
    rooted: np.ndarray,
    onward: np.ndarray,
    density: BrickVolume,
    strand: float,
    dearest: float,
    progress: Progress = silent,
) -> Joints:
    """The joints no dearer than `dearest`, of each tip the HELD cheapest; sorted by tip and root, each pair once.

    lines: P directed pieces, mm, scan frame, root end first. rooted: (P,) bool, those that begin on the scalp: nothing goes on
    into them. onward: (P,) int64, the piece that each went on in before it was cut, or -1: joints that heal such a cut are all
    held, and leave nothing off. density, strand: as for `link_segments`. The same on any number of threads.
    """
    voxel, count = density.spacing, len(lines)
    held = np.zeros(count, np.int32), np.empty((count, HELD), np.int32), np.empty((count, HELD), np.float32)
    number, roots, costs = held
    cuts = np.zeros((count, HELD, 2), np.int8)
    pair, healed = _healed(lines, onward, density, strand)
    tip = pair // count
    number[tip], roots[tip, 0], costs[tip, 0] = 1, pair % count, healed
    valid, *root_courses = (np.concatenate(of) for of in zip(*(_courses(lines, True, cut, voxel) for cut in CUTS), strict=True))
    # the number of a root end: its piece, and `count` more for each cut
    targets = np.flatnonzero(valid & ~np.tile(rooted, len(CUTS)))
    left = np.round(np.array(CUTS) / STEP).astype(np.int64)
    done = 0
    if len(targets):
        tree, found = cKDTree(root_courses[0][targets]), np.append(targets, -1)
        for cut, points in zip(CUTS, left, strict=True):
            valid, *courses = _courses(lines, False, cut, voxel)
            for wanted, stations in ((onward >= 0, STATIONS[:NEAR_STATIONS]), (onward < 0, STATIONS)):
                tips = _side_by_side(np.flatnonzero(valid & wanted), courses[0])
                for some in np.array_split(tips, max(-(-len(tips) // BLOCK), 1)):
                    ends = found[_ahead(tree, some, courses, stations, 2 * NEAREST)]
                    _hold(
                        some, ends, onward, *courses, *root_courses, density.table, density.bricks, density.origin / voxel,
                        np.float32(strand), dearest, points, left, *held, cuts,
                    )  # fmt: skip
                    done += len(some)
                    progress(done, count * len(CUTS))
    row = np.repeat(np.arange(count), number)
    column = np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)
    key = row * count + roots[row, column]
    order = np.argsort(key)
    row, column = row[order], column[order]
    return Joints(row, roots[row, column].astype(np.int64), cuts[row, column], costs[row, column].astype(np.float64))


def meeting_ends(pieces: Pieces, density: BrickVolume, strand: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of undirected pieces that one strand may run through, whichever way.

    density, strand: as for `link_segments`. Returns (pairs (J, 2) of pieces, sign (J,) 1 where a strand that runs through
    both runs along both or against both and -1 where not, cost (J,) of the joint).
    """
    voxel, lines, onward = density.spacing, pieces.strands, pieces.onward
    count = len(lines)
    both = zip(*(_courses(lines, first, 0.0, voxel) for first in (True, False)), strict=True)
    valid, *courses = (np.concatenate(ends) for ends in both)
    usable = np.flatnonzero(valid)
    tips = _side_by_side(usable, courses[0])
    near = _ahead(cKDTree(courses[0][usable]), tips, courses, STATIONS[:NEAR_STATIONS], NEAREST)
    row, column = np.nonzero(near < len(usable))
    one, other = tips[row], usable[near[row, column]]
    pair = np.unique(np.minimum(one, other) * (2 * count) + np.maximum(one, other))
    one, other = pair // (2 * count), pair % (2 * count)
    # an end of one piece at the beginning of the next is weighed as a cut
    kept = (one % count != other % count) & (onward[one % count] != other % count) & (onward[other % count] != one % count)
    one, other = one[kept], other[kept]
    cost = np.empty(len(one))
    _weigh(
        one, other, *courses, *courses, density.table, density.bricks, density.origin / voxel, np.float32(strand), MEETS, cost
    )  # fmt: skip
    kept = cost < MEETS
    one, other = one[kept], other[kept]
    sign = np.where((one < count) == (other < count), -1.0, 1.0)
    pair, healed = _healed(lines, onward, density, strand)
    pairs = np.stack([np.append(one % count, pair // count), np.append(other % count, pair % count)], axis=1)
    return pairs, np.append(sign, np.ones(len(pair))), np.append(cost[kept], healed)


def _courses(lines: Strands, from_root: bool, cut: float, voxel: float):
    """(valid (N,), place, tangent, bend (N, 3)): the course of each strand as it leaves its end, in voxels.

    A parabola is fitted to SPAN voxels before the end (for root ends: after it), and goes on to the end from its middle as the
    circle that bends as it does there; tangent and bend (second derivative) are those along the outward direction.
    """
    counts = lines.counts
    skip = round(cut / STEP)
    window = round(SPAN / STEP)
    valid = counts > max(skip + 4, 2 * skip)
    index = np.where(valid, (lines.offsets[:-1] + skip) if from_root else (lines.offsets[1:] - 1 - skip), lines.offsets[:-1])
    place = np.zeros((len(lines), 3))
    tangent = np.zeros((len(lines), 3))
    bend = np.zeros((len(lines), 3))
    _fit_ends(
        lines.points, lines.offsets, index, 1 if from_root else -1, window, STEP * voxel, valid, place, tangent, bend
    )  # fmt: skip
    return valid, place / voxel, tangent, bend * voxel


@numba.njit(cache=True, parallel=True)
def _fit_ends(points, offsets, index, way, window, step, valid, place, tangent, bend):
    for n in numba.prange(len(index)):
        if not valid[n]:
            continue
        room = offsets[n + 1] - 1 - index[n] if way > 0 else index[n] - offsets[n]
        size = min(window, room) + 1
        # t runs from 0 at the end into the strand; a parabola by least squares
        s0 = s1 = s2 = s3 = s4 = 0.0
        for m in range(size):
            t = m * step
            s0 += 1.0
            s1 += t
            s2 += t * t
            s3 += t * t * t
            s4 += t * t * t * t
        det = s0 * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s2 * s3) + s2 * (s1 * s3 - s2 * s2)
        for axis in range(3):
            m0 = m1 = m2 = 0.0
            for m in range(size):
                t = m * step
                value = points[index[n] + way * m, axis]
                m0 += value
                m1 += t * value
                m2 += t * t * value
            if size >= 4 and abs(det) > 1e-12:
                a = (m0 * (s2 * s4 - s3 * s3) - s1 * (m1 * s4 - m2 * s3) + s2 * (m1 * s3 - m2 * s2)) / det
                b = (s0 * (m1 * s4 - m2 * s3) - m0 * (s1 * s4 - s2 * s3) + s2 * (s1 * m2 - s2 * m1)) / det
                c = (s0 * (s2 * m2 - s3 * m1) - s1 * (s1 * m2 - s2 * m1) + m0 * (s1 * s3 - s2 * s2)) / det
            else:
                a = points[index[n], axis]
                b = (points[index[n] + way * (size - 1), axis] - a) / max((size - 1) * step, 1e-9)
                c = 0.0
            middle = 0.5 * (size - 1) * step
            place[n, axis], tangent[n, axis], bend[n, axis] = a + (b + c * middle) * middle, -b - 2.0 * c * middle, 2.0 * c
        speed = along = 0.0
        for axis in range(3):
            speed += tangent[n, axis] ** 2
            along += tangent[n, axis] * bend[n, axis]
        speed, square = max(np.sqrt(speed), 1e-9), 0.0
        for axis in range(3):
            tangent[n, axis] /= speed
            bend[n, axis] = (bend[n, axis] - along / speed * tangent[n, axis]) / speed
            square += bend[n, axis] ** 2
        far, aside, cosine = arc(np.sqrt(square), 0.5 * (size - 1) * step)
        for axis in range(3):
            t, b = tangent[n, axis], bend[n, axis]
            place[n, axis] += far * t + aside * b
            tangent[n, axis] = cosine * t + far * b
            bend[n, axis] = cosine * b - far * square * t


@numba.njit(cache=True, nogil=True, inline="always")
def arc(curvature, length):
    """(far, aside, cosine) of a circle after `length`: it lies far ahead along its tangent there and aside by so much of its
    bend, and goes on along cosine times the one and far times the other."""
    angle = curvature * length
    if angle < 0.02:
        return length, 0.5 * length * length, 1.0 - 0.5 * angle * angle
    cosine = np.cos(angle)
    return np.sin(angle) / curvature, (1.0 - cosine) / curvature**2, cosine


def _side_by_side(ends: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The ends, by their places (., 3) in voxels, cell by cell: those that follow each other have the same ends around them."""
    if not len(ends):
        return ends
    cell = (place[ends] / CELL).astype(np.int64)
    cell -= cell.min(axis=0)
    return ends[np.argsort(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)), kind="stable")]


def _ahead(
    tree: cKDTree,
    tips: np.ndarray,
    courses: Sequence[np.ndarray],
    stations: Sequence[tuple[float, float]],
    nearest: int,
) -> np.ndarray:
    """(T, K) int64: what of the tree lies around the stations ahead of each of the tips; its size where that is not so much."""
    near, (place, out, bend) = [], courses
    curvature = np.linalg.norm(bend[tips], axis=1)
    for ahead, radius in stations:
        turn = np.maximum(curvature * ahead, 1e-6)[:, None]
        far, aside = np.sin(turn) / turn, 2.0 * (np.sin(0.5 * turn) / turn) ** 2
        centres = [place[tips] + ahead * far * out[tips] + ahead**2 * aside * bend[tips]]
        if ahead >= STRAIGHT:
            centres.append(place[tips] + ahead * out[tips])
        near.extend(nearest_points(tree, centre, nearest, radius)[1] for centre in centres)
    return np.concatenate(near, axis=1)


@numba.njit(cache=True, parallel=True)
def _hold(
    tips, ends, onward, place, out, bend, root_place, root_out, root_bend, table, bricks, origin, strand, dearest, cut,
    root_cuts, number, roots, costs, cuts,
):  # fmt: skip
    """Weigh the joints of each tip with the root ends (T, K) beside it (each any number of times, -1 for none), and hold the
    cheapest: of a piece's tip `number` (P,), their `roots`, `costs` and `cuts` (P, HELD). The first stays if it heals a cut."""
    count, room = len(onward), roots.shape[1]
    for n in numba.prange(len(tips)):
        a, last = tips[n], -1
        first = 1 if onward[a] >= 0 else 0
        for end in np.sort(ends[n]):
            b = end % count
            if end == last or end < 0 or b == a or b == onward[a]:
                continue
            last = end
            slot, worst = -1, first
            for k in range(first, number[a]):
                if roots[a, k] == b:
                    slot = k
                if costs[a, k] > costs[a, worst]:
                    worst = k
            most = dearest
            if slot >= 0:
                most = float(costs[a, slot])
            elif number[a] == room:
                slot, most = worst, float(costs[a, worst])
            price = PER_CUT * STEP * (cut + root_cuts[end // count])
            cost = price + _joint(
                a, end, place, out, bend, root_place, root_out, root_bend, table, bricks, origin, strand, most - price
            )
            if cost >= most:
                continue
            if slot < 0:
                slot = number[a]
                number[a] += 1
            roots[a, slot], costs[a, slot] = b, cost
            cuts[a, slot, 0], cuts[a, slot, 1] = cut, root_cuts[end // count]


def _healed(lines: Strands, onward: np.ndarray, density: BrickVolume, strand: float):
    """The joints that heal a cut (pairs, cost), weighed by how the courses at some distance to both sides of it meet."""
    voxel = density.spacing
    tip = np.flatnonzero(onward >= 0)
    root = onward[tip]
    cost = np.zeros(len(tip))
    valid, place, out, bend = _courses(lines, False, ACROSS, voxel)
    root_valid, root_place, root_out, root_bend = _courses(lines, True, ACROSS, voxel)
    both = valid[tip] & root_valid[root]
    some = np.empty(int(both.sum()))
    _weigh(
        tip[both], root[both], place, out, bend, root_place, root_out, root_bend, density.table, density.bricks,
        density.origin / voxel, np.float32(strand), np.inf, some,
    )  # fmt: skip
    cost[both] = np.clip(some - PER_VOXEL * 2.0 * ACROSS, 0.0, 0.9 * LOOSE_END)
    return tip * len(lines) + root, cost


@numba.njit(cache=True, parallel=True)
def _weigh(tip, root, place, out, bend, root_place, root_out, root_bend, table, bricks, origin, strand, most, cost):
    """`_joint` of each of many."""
    for n in numba.prange(len(tip)):
        cost[n] = _joint(
            tip[n], root[n], place, out, bend, root_place, root_out, root_bend, table, bricks, origin, strand, most
        )


@numba.njit(cache=True, nogil=True)
def _joint(a, b, place, out, bend, root_place, root_out, root_bend, table, bricks, origin, strand, most):
    """The cost of joining tip a to root end b (see the constants): the two courses, extended to the middle of the gap, must
    meet. Of one dearer than `most` no more than that is told."""
    gap = 0.0
    forward = 0.0
    for axis in range(3):
        apart = root_place[b, axis] - place[a, axis]
        gap += apart * apart
        forward += apart * (out[a, axis] - root_out[b, axis]) * 0.5
    gap = np.sqrt(gap)
    if forward < -1.0 or forward < 0.5 * gap - 1.5:
        return 1e9
    if PER_VOXEL * gap > most:
        return PER_VOXEL * gap
    half = 0.5 * max(forward, 0.0)
    square = root_square = 0.0
    for axis in range(3):
        square += bend[a, axis] ** 2
        root_square += root_bend[b, axis] ** 2
    far, aside, cosine = arc(np.sqrt(square), half)
    root_far, root_aside, root_cosine = arc(np.sqrt(root_square), half)
    jump = miss = straight = dot = straight_dot = 0.0
    for axis in range(3):
        ta, ba, tb, bb = out[a, axis], bend[a, axis], root_out[b, axis], root_bend[b, axis]
        apart = place[a, axis] - root_place[b, axis]
        jump += (cosine * ba - far * square * ta - root_cosine * bb + root_far * root_square * tb) ** 2
        miss += (apart + far * ta + aside * ba - root_far * tb - root_aside * bb) ** 2
        dot -= (cosine * ta + far * ba) * (root_cosine * tb + root_far * bb)
        straight += (apart + half * (ta - tb)) ** 2
        straight_dot -= ta * tb
    apart = jump / (BEND[0] + BEND[1] * gap) ** 2 + PER_VOXEL * gap
    if apart > most:
        return apart
    # hair goes on bending as it did, or straight on
    best, place_off, turn_off = 1e9, (PLACE[0] + PLACE[1] * gap) ** 2, TURN[0] + TURN[1] * gap
    for off, along in ((miss, dot), (straight, straight_dot)):
        value = off / place_off
        if value < best and value + apart <= most:
            value += (np.arccos(min(max(along, -1.0), 1.0)) / turn_off) ** 2
        best = min(best, value)
    best += apart
    if best > most:
        return best
    backed = 0.0
    many = int(gap) + 1
    # a cubic piece with such ends runs along a circle as near as can be
    longer = 2.0 * gap / (1.0 + np.sqrt(max(0.5 + 0.5 * straight_dot, 0.0)))
    for m in range(many):
        t = (m + 0.5) / many
        wa, wb = 2 * t**3 - 3 * t**2 + 1, 3 * t**2 - 2 * t**3
        va, vb = (t**3 - 2 * t**2 + t) * longer, (t**3 - t**2) * longer
        x = wa * place[a, 0] + va * out[a, 0] + wb * root_place[b, 0] - vb * root_out[b, 0] - origin[0]
        y = wa * place[a, 1] + va * out[a, 1] + wb * root_place[b, 1] - vb * root_out[b, 1] - origin[1]
        z = wa * place[a, 2] + va * out[a, 2] + wb * root_place[b, 2] - vb * root_out[b, 2] - origin[2]
        backed += min(max(density_at(table, bricks, x, y, z) / strand, 0.0), 1.0)
    return best + UNBACKED * (1.0 - backed / many) * min(gap / 4.0, 1.0)
