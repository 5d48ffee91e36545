"""Segments joined into whole strands: which tip goes on in which root end, for all of them at once (in place of 3.2.2).

A trace ends where strands touch and goes on, under another name, where they part. Every tip end is held against the root
ends that lie on its course; a joint costs what it bends more than hair does, what it bridges, and what the scan doesn't back.
The cheapest set of joints in which no end is used twice is an assignment problem, solved exactly. What it costs to leave a tip
loose says how many strands there are; where the knots of the hairnet tell that, it is as low as leaves no more of them.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..progress import Progress, part, silent
from ..strands import Strands, offsets_from_counts, point_tree, points_around
from ..volume.grid import BrickVolume
from .sampling import density_at

CUTS = (0.0, 4.0, 8.0, 12.0)
"""voxel; a trace may have gone too far, onto a neighbour: a joint may leave it this far before its end, and enter another
this far behind its beginning."""
CONTACT = 2.0
"""voxel; where a trace ends this close to another's side, the other is cut: it may have come over to the wrong strand there."""
NEAR_STATIONS = 3
"""Stations that are looked at from a cut: what goes on there lies near."""
SHORTEST = 12
"""voxel; no cut is made closer to an end or another cut."""
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
SPAN = 12.0
"""voxel; the length at an end that its course is fitted to."""
PLACE = (2.0, 0.1)
"""voxel, and voxel a voxel of gap: how far the two courses may miss each other in the middle of a gap."""
TURN = (0.5, 0.02)
"""radian, and radian a voxel of gap: by how much their directions may differ there."""
BEND = (0.08, 0.004)
"""1/voxel, and 1/voxel a voxel of gap: by how much their bends may differ: a curl's turns on as it came."""
KINK = 0.06
KINK_SPAN = 10
"""1/voxel; a trace is cut where its bend changes by more from one span (voxel) to the next: it may have left its strand."""
PER_VOXEL = 0.5
UNBACKED = 6.0
"""Cost of a voxel of gap, and of a gap that the scan does not back at all."""
PER_CUT = 0.1
"""Cost of a voxel that is cut off a trace: at a fifth of it nearly any bend was dearer, and a tied wig lost a tenth of its
hair."""
LOOSE_END = 30.0
"""Cost of a tip that goes on nowhere, where it is not known how many strands there are: dearer joints are not made."""
LOOSE_ENDS = (20.0, 25.0, 30.0, 40.0, 60.0)
"""Those tried in turn where it is known; the first alone where there may be more strands. Lower ones break good joints, higher
ones make none but bad ones."""
SPARE = 0.02
"""Share of strands more than are known that may be left: about as many prove to be nothing when they are rooted and fitted."""
STEP = 1.0
"""voxel between the points of a joint."""


@dataclass(frozen=True)
class _Joints:
    """Candidates: piece `tip` goes on in piece `root`; cut (J, 2): points left off the one's tip and the other's root."""

    tip: np.ndarray
    root: np.ndarray
    cut: np.ndarray
    cost: np.ndarray


@dataclass(frozen=True)
class Pieces:
    """Segments in pieces: strands (mm), points a voxel apart; onward (P,) int64: the piece that each went on in, or -1; parent
    (P,): the segment that each is of."""

    strands: Strands
    onward: np.ndarray
    parent: np.ndarray

    def turned(self, back: np.ndarray) -> Pieces:
        """The pieces with those of `back` (P,) bool turned; two that now run against each other don't go on in each other."""
        before = np.flatnonzero(self.onward >= 0)
        after = self.onward[before]
        ahead, behind = ~back[before] & ~back[after], back[before] & back[after]
        onward = np.full(len(self.onward), -1, np.int64)
        onward[before[ahead]] = after[ahead]
        onward[after[behind]] = before[behind]
        return Pieces(self.strands.reversed(back), onward, self.parent)

    def ends(self, fine: np.ndarray) -> np.ndarray:
        """(P,) int8: `fine` (N,) of the segments (1: the first point is a root, -1: the last one is) for the pieces."""
        out = np.zeros(len(self.onward), np.int8)
        first = np.ones(len(out), bool)
        first[self.onward[self.onward >= 0]] = False
        last = self.onward < 0
        out[first & (fine[self.parent] > 0)] = 1
        out[last & (fine[self.parent] < 0)] = -1
        return out


def cut_segments(segments: Strands, voxel: float) -> Pieces:
    """Undirected segments (mm) in pieces, cut where another one's end lies beside them and where their bend changes at once."""
    lines = segments.resampled_by_step(STEP * voxel)
    if not len(lines):
        return Pieces(lines, np.zeros(0, np.int64), np.zeros(0, np.int64))
    tangents, index = lines.tangents(), lines.strand_index
    ends = np.concatenate([lines.offsets[:-1], lines.offsets[1:] - 1])
    some = points_around(lines.points, lines.points[ends], CONTACT * voxel)
    tree = point_tree(lines.points[some])
    near = tree.query(lines.points[ends], k=24, distance_upper_bound=CONTACT * voxel, workers=-1)[1]
    row, column = np.nonzero(near < len(some))
    place, end = some[near[row, column]], ends[row]
    beside = (index[place] != index[end]) & (np.abs(np.einsum("nc,nc->n", tangents[place], tangents[end])) > 0.7)
    place, row, column = place[beside], row[beside], column[beside]
    # of each line beside an end the nearest point, which the tree gives first
    order = np.lexsort((column, index[place], row))
    place, row = place[order], row[order]
    first = np.ones(len(place), bool)
    first[1:] = (row[1:] != row[:-1]) | (index[place[1:]] != index[place[:-1]])
    cuts = np.unique(
        np.concatenate([place[first], np.flatnonzero(_kinks(lines.points, lines.offsets, voxel, _bend_weights()))])
    )
    cuts = cuts[(cuts - lines.offsets[index[cuts]] >= SHORTEST) & (lines.offsets[index[cuts] + 1] - cuts > SHORTEST)]
    cuts = cuts[_apart(cuts, SHORTEST)]
    offsets = np.sort(np.concatenate([lines.offsets, cuts]))
    onward = np.where(np.isin(offsets[1:-1], cuts, assume_unique=True), np.arange(1, len(offsets) - 1), -1)
    return Pieces(Strands(lines.points, offsets), np.append(onward, -1).astype(np.int64), index[offsets[:-1]])


def _bend_weights() -> np.ndarray:
    """(KINK_SPAN + 1,): the second derivative of the parabola through as many places, a voxel apart, as their weighted sum."""
    t = np.arange(KINK_SPAN + 1, dtype=np.float64)
    return 2.0 * np.linalg.pinv(np.stack([np.ones_like(t), t, t * t], axis=1))[2]


@numba.njit(cache=True, parallel=True)
def _kinks(points, offsets, voxel, weights):
    """(M,) bool: where the bend before and the bend behind a point differ by more than KINK, and most for SHORTEST around."""
    out = np.zeros(len(points), np.bool_)
    span = len(weights) - 1
    for n in numba.prange(len(offsets) - 1):
        start, end = offsets[n], offsets[n + 1]
        if end - start <= 2 * span:
            continue
        jump = np.zeros(end - start)
        for m in range(start + span, end - span):
            square = 0.0
            for axis in range(3):
                bend = 0.0
                for k in range(span + 1):
                    bend += weights[k] * (points[m + k, axis] - points[m - k, axis])
                square += bend * bend
            jump[m - start] = np.sqrt(square) / voxel
        for m in range(span, end - start - span):
            if jump[m] > KINK:
                most = True
                for k in range(max(m - SHORTEST, 0), min(m + SHORTEST + 1, end - start)):
                    if jump[k] > jump[m]:
                        most = False
                        break
                out[start + m] = most
    return out


@numba.njit(cache=True)
def _apart(places, least):
    """(C,) bool: of rising places those that lie `least` behind the last one taken."""
    taken = np.zeros(len(places), np.bool_)
    last = -least
    for n in range(len(places)):
        if places[n] - last >= least:
            taken[n] = True
            last = places[n]
    return taken


def link_segments(
    pieces: Pieces,
    rooted: np.ndarray,
    density: BrickVolume,
    strand: float,
    progress: Progress = silent,
    known: int = 0,
    at_least: bool = False,
) -> tuple[Strands, np.ndarray, np.ndarray, dict[str, int]]:
    """Chains of directed pieces of segments (mm, scan frame, root end first).

    rooted: (P,) bool, pieces whose first point is a root on the scalp: nothing goes on into them. density: the scan; strand:
    a lone strand's density on its centre line as trilinear reads see it. known: how many strands there are, or are `at_least`;
    0 where nobody knows. Returns (chains, (C,) bool rooted, (C,) float32 mm bridged in each, tally).
    """
    voxel, lines, onward = density.spacing, pieces.strands, pieces.onward
    count = len(lines)
    rooted = np.asarray(rooted, bool)
    if count < 2:
        return lines, rooted, np.zeros(count, np.float32), {"segments joined": 0}
    prices = (LOOSE_ENDS[:1] if at_least else LOOSE_ENDS) if known else (LOOSE_END,)
    joints = _candidates(lines, rooted, onward, density, strand, prices[-1], part(progress, 0.0, 0.5))
    following, cut, price = _assigned(count, joints, prices, int((1.0 + SPARE) * known))
    progress(0.9, 1.0)
    following, broken = _without_rings(following, joints)
    chain, position, length = _chains(following)
    points, offsets, bridged = _joined(lines, following, cut, chain, position, length, voxel)
    firsts = np.flatnonzero(position == 0)
    order = np.argsort(chain[firsts])
    healed = (following == onward) & (onward >= 0)
    tally = {
        "cuts of segments: an end beside them, or a kink": len(pieces.parent) - len(np.unique(pieces.parent)),
        "cuts that were healed": int(healed.sum()),
        "joints weighed": len(joints.cost),
        "dearest joint allowed": round(price),
        "joints made": int(((following >= 0) & ~healed).sum()),
        "joints undone: they closed a ring": broken,
        "strands after joining": len(offsets) - 1,
    }
    progress(1.0, 1.0)
    return Strands(points, offsets), rooted[firsts[order]], bridged, tally


def meeting_ends(pieces: Pieces, density: BrickVolume, strand: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of undirected pieces that one strand may run through, whichever way.

    density, strand: as for `link_segments`. Returns (pairs (J, 2) of pieces, sign (J,) 1 where a strand that runs through
    both runs along both or against both and -1 where not, cost (J,) of the joint).
    """
    voxel, lines, onward = density.spacing, pieces.strands, pieces.onward
    count = len(lines)
    ends = [np.concatenate(two) for two in zip(*(_courses(lines, first, 0.0, voxel) for first in (True, False)), strict=True)]
    valid, place, out, bend = ends
    usable = np.flatnonzero(valid)
    tree = cKDTree(place[usable])
    near = _ahead(tree, usable, (place, out, bend), STATIONS[:NEAR_STATIONS], NEAREST)
    row, column = np.nonzero(near < len(usable))
    one, other = usable[row], usable[near[row, column]]
    pair = np.unique(np.minimum(one, other) * (2 * count) + np.maximum(one, other))
    one, other = pair // (2 * count), pair % (2 * count)
    # an end of one piece at the beginning of the next is weighed as a cut
    kept = (one % count != other % count) & (onward[one % count] != other % count) & (onward[other % count] != one % count)
    one, other = one[kept], other[kept]
    cost = np.empty(len(one))
    _weigh(
        one, other, place, out, bend, place, out, bend, density.table, density.bricks, density.origin / voxel,
        np.float32(strand), MEETS, cost,
    )  # fmt: skip
    kept = cost < MEETS
    one, other = one[kept], other[kept]
    sign = np.where((one < count) == (other < count), -1.0, 1.0)
    pair, healed = _healed(lines, onward, density, strand)
    pairs = np.stack([np.append(one % count, pair // count), np.append(other % count, pair % count)], axis=1)
    return pairs, np.append(sign, np.ones(len(pair))), np.append(cost[kept], healed)


def _courses(lines: Strands, from_root: bool, cut: float, voxel: float):
    """(valid (N,), place, tangent, bend (N, 3)): the course of each strand as it leaves its end, in voxels.

    A parabola is fitted to SPAN voxels before the end (for root ends: after it); tangent and bend (second derivative) are
    those along the outward direction.
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
            place[n, axis], tangent[n, axis], bend[n, axis] = a, -b, 2.0 * c
        norm = np.sqrt(tangent[n, 0] ** 2 + tangent[n, 1] ** 2 + tangent[n, 2] ** 2)
        for axis in range(3):
            tangent[n, axis] /= max(norm, 1e-9)


def _candidates(
    lines: Strands,
    rooted: np.ndarray,
    onward: np.ndarray,
    density: BrickVolume,
    strand: float,
    dearest: float,
    progress: Progress,
) -> _Joints:
    """The joints no dearer than `dearest`, the HELD cheapest of each tip; those that heal a cut are all held and leave nothing
    off. Of a pair that may be joined by more than one cut, the cheapest."""
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
        tree = cKDTree(root_courses[0][targets])
        for cut in CUTS:
            valid, *courses = _courses(lines, False, cut, voxel)
            for wanted, stations in ((onward >= 0, STATIONS[:NEAR_STATIONS]), (onward < 0, STATIONS)):
                tips = np.flatnonzero(valid & wanted)
                for some in np.array_split(tips, max(-(-len(tips) // BLOCK), 1)):
                    ends = np.append(targets, -1)[_ahead(tree, some, courses, stations, 2 * NEAREST)]
                    _hold(
                        some, ends, onward, *courses, *root_courses, density.table, density.bricks, density.origin / voxel,
                        np.float32(strand), dearest, round(cut / STEP), left, *held, cuts,
                    )  # fmt: skip
                    done += len(some)
                    progress(done, count * len(CUTS))
    row = np.repeat(np.arange(count), number)
    column = np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)
    key = row * count + roots[row, column]
    order = np.argsort(key)
    row, column = row[order], column[order]
    return _Joints(row, roots[row, column].astype(np.int64), cuts[row, column], costs[row, column].astype(np.float64))


def _ahead(tree: cKDTree, tips: np.ndarray, course: Sequence[np.ndarray], stations, nearest: int) -> np.ndarray:
    """(T, K) int64: what of the tree lies around the stations ahead of each of the tips; its size where that is not so much."""
    near, (place, out, bend) = [], course
    for ahead, radius in stations:
        for bent in (0.5,) if ahead < STRAIGHT else (0.5, 0.0):
            centre = place[tips] + ahead * out[tips] + bent * ahead**2 * bend[tips]
            near.append(tree.query(centre, k=nearest, distance_upper_bound=radius, workers=-1)[1])
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
    half = 0.5 * max(forward, 0.0)
    best = 1e9
    for curved in range(2):
        miss = turn = 0.0
        norm_a = norm_b = dot = 0.0
        for axis in range(3):
            pa, ta = place[a, axis] + half * out[a, axis], out[a, axis]
            pb, tb = root_place[b, axis] + half * root_out[b, axis], root_out[b, axis]
            if curved:
                pa += 0.5 * half * half * bend[a, axis]
                pb += 0.5 * half * half * root_bend[b, axis]
                ta += half * bend[a, axis]
                tb += half * root_bend[b, axis]
            miss += (pa - pb) ** 2
            norm_a += ta * ta
            norm_b += tb * tb
            dot -= ta * tb
        turn = np.arccos(min(max(dot / np.sqrt(max(norm_a * norm_b, 1e-12)), -1.0), 1.0))
        value = miss / (PLACE[0] + PLACE[1] * gap) ** 2 + (turn / (TURN[0] + TURN[1] * gap)) ** 2
        best = min(best, value)
    jump = 0.0
    for axis in range(3):
        jump += (bend[a, axis] - root_bend[b, axis]) ** 2
    best += jump / (BEND[0] + BEND[1] * gap) ** 2 + PER_VOXEL * gap
    if best > most:
        return best
    backed = 0.0
    many = int(gap) + 1
    for m in range(many):
        t = (m + 0.5) / many
        wa, wb = 2 * t**3 - 3 * t**2 + 1, 3 * t**2 - 2 * t**3
        va, vb = (t**3 - 2 * t**2 + t) * gap, (t**3 - t**2) * gap
        x = wa * place[a, 0] + va * out[a, 0] + wb * root_place[b, 0] - vb * root_out[b, 0] - origin[0]
        y = wa * place[a, 1] + va * out[a, 1] + wb * root_place[b, 1] - vb * root_out[b, 1] - origin[1]
        z = wa * place[a, 2] + va * out[a, 2] + wb * root_place[b, 2] - vb * root_out[b, 2] - origin[2]
        backed += min(max(density_at(table, bricks, x, y, z) / strand, 0.0), 1.0)
    return best + UNBACKED * (1.0 - backed / many) * min(gap / 4.0, 1.0)


def _assigned(count: int, joints: _Joints, prices: tuple[float, ...], known: int) -> tuple[np.ndarray, np.ndarray, float]:
    """(following (N,): the piece that each goes on in, -1 for none; cut (N, 2): points left off its root and its tip; the price
    of a loose tip) at the least cost: at the first of `prices` that leaves no more than `known` tips loose, or the last."""
    following, cut = np.full(count, -1, np.int64), np.zeros((count, 2), np.int64)
    if not len(joints.cost):
        return following, cut, prices[0]
    starts = np.searchsorted(joints.tip, np.arange(count + 1))
    price = assign(starts, joints.root, joints.cost, prices, following, known)
    tip = np.flatnonzero(following >= 0)
    root = following[tip]
    key = joints.tip * count + joints.root
    chosen = joints.cut[np.searchsorted(key, tip * count + root)]
    cut[tip, 1], cut[root, 0] = chosen[:, 0], chosen[:, 1]
    return following, cut, price


def assign(
    starts: np.ndarray, columns: np.ndarray, costs: np.ndarray, prices: tuple[float, ...], chosen: np.ndarray, most: int = 0
) -> float:
    """Fill `chosen` (R,) int64: each row's column, or -1, at the least sum of costs, a price for a row without one.

    Row r may have the columns `columns[starts[r]:starts[r + 1]]`, at `costs`, none below 0. Of the rising `prices` the first
    that leaves no more than `most` rows without a column is taken, else the last, and returned. Shortest augmenting paths over
    reduced costs (Jonker and Volgenant 1987); each search ends where leaving somebody loose is cheapest, so it stays among
    neighbours, and looks at a row's columns, cheapest first, no farther than its end may lie. What is best at one price is
    where the next one starts: only rows without a column are looked at again.
    """
    order = np.empty(len(costs), np.int32 if len(costs) < 2**31 else np.int64)
    _by_cost(starts, costs, order)
    columns, costs = columns[order].astype(np.int32), costs[order]
    chosen[:] = -1
    owner = np.full(len(chosen), -1, np.int64)
    row_price, column_price = np.zeros(len(chosen)), np.zeros(len(chosen))  # of columns none is above 0
    for price in prices:
        _assign(starts, columns, costs, price, chosen, owner, row_price, column_price)
        if np.count_nonzero(chosen < 0) <= most:
            break
    return price


@numba.njit(cache=True, parallel=True)
def _by_cost(starts, costs, order):
    """Each row's joints, cheapest first."""
    for row in numba.prange(len(starts) - 1):
        low, high = starts[row], starts[row + 1]
        order[low:high] = low + np.argsort(costs[low:high], kind="mergesort")


@numba.njit(cache=True)
def _assign(starts, columns, costs, loose, chosen, owner, row_price, column_price):
    """`assign` of joints that are sorted by row and cost, going on from what was best where `loose` was less.

    owner (R,): each column's row, -1 for none; row_price, column_price (R,): what costs are reduced by.
    """
    rows = len(chosen)
    distance, before = np.empty(rows), np.empty(rows, np.int64)
    seen, done = np.full(rows, -1, np.int64), np.full(rows, -1, np.int64)
    for first in np.flatnonzero(chosen < 0):
        heap = [(0.0, np.int64(-1)) for _ in range(0)]
        scanned = [np.int64(0) for _ in range(0)]
        row, far = first, 0.0
        nearest, last_row, last_column = np.inf, first, -1
        while True:
            if far + loose - row_price[row] < nearest:
                nearest, last_row, last_column = far + loose - row_price[row], row, -1
            start = far - row_price[row]
            for k in range(starts[row], starts[row + 1]):
                if start + costs[k] >= nearest:
                    break  # nor is any that is dearer
                column = np.int64(columns[k])
                if done[column] == first:
                    continue
                way = start + costs[k] - column_price[column]
                if way < nearest and (seen[column] != first or way < distance[column]):
                    seen[column], distance[column], before[column] = first, way, row
                    heapq.heappush(heap, (way, column))
            column = np.int64(-1)
            while len(heap):
                far, column = heapq.heappop(heap)
                if done[column] != first and far <= distance[column]:
                    break
                column = np.int64(-1)
            if column < 0 or far >= nearest:
                break
            if owner[column] < 0:
                nearest, last_column = far, column
                break
            done[column] = first
            scanned.append(column)
            row = owner[column]
        for column in scanned:
            less = nearest - distance[column]
            column_price[column] -= less
            row_price[owner[column]] += less
        row_price[first] += nearest
        if last_column < 0:
            row, column = last_row, chosen[last_row]
            chosen[row] = -1
        else:
            row, column = np.int64(-1), last_column
        while row != first:
            row = before[column]
            freed = chosen[row]
            chosen[row], owner[column] = column, row
            column = freed


def _without_rings(following: np.ndarray, joints: _Joints) -> tuple[np.ndarray, int]:
    """The joints without rings: each ring is opened at its dearest joint."""
    count = len(following)
    linked = np.flatnonzero(following >= 0)
    graph = coo_matrix((np.ones(len(linked)), (linked, following[linked])), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    # a component with as many joints as members is a ring
    rings = np.bincount(label[linked], minlength=number) == np.bincount(label, minlength=number)
    inside = linked[rings[label[linked]]]
    if not len(inside):
        return following, 0
    key = joints.tip * count + joints.root
    cost = joints.cost[np.searchsorted(key, inside * count + following[inside])]
    order = np.lexsort((inside, -cost, label[inside]))
    inside = inside[order]
    dearest = inside[np.unique(label[inside], return_index=True)[1]]
    following = following.copy()
    following[dearest] = -1
    return following, len(dearest)


def _chains(following: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(chain (N,), position (N,) in it, length (C,)): pointers doubled until every segment knows its chain's first."""
    count = len(following)
    before = np.full(count, -1, np.int64)
    linked = np.flatnonzero(following >= 0)
    before[following[linked]] = linked
    first, steps = np.arange(count), (before >= 0).astype(np.int64)
    jump = np.where(before >= 0, before, first)
    while True:
        further = jump[jump]
        more = steps[jump]
        if (further == jump).all():
            break
        steps, jump = steps + more, further
    firsts = np.flatnonzero(before < 0)
    chain = np.searchsorted(firsts, jump)
    return chain, steps, np.bincount(chain, minlength=len(firsts))


def _joined(lines: Strands, following, cut, chain, position, length, voxel):
    """(points, offsets, bridged (C,) mm) of the chains: their segments in order, with a cubic Hermite piece in each gap."""
    order = np.lexsort((position, chain))
    tips = lines.offsets[1:] - 1 - cut[:, 1]
    roots = lines.offsets[:-1] + cut[:, 0]
    linked = following[order] >= 0
    gap = np.zeros(len(order))
    after = following[order][linked]
    gap[linked] = np.linalg.norm(lines.points[roots[after]] - lines.points[tips[order][linked]], axis=1)
    gap = np.maximum(gap - STEP * voxel, 0.0)  # what heals a cut bridges nothing
    between = np.where(linked, np.ceil(gap / (STEP * voxel)).astype(np.int64), 0)
    kept = tips[order] - roots[order] + 1
    starts = offsets_from_counts(kept + between)
    points = np.empty((starts[-1], 3), np.float32)
    tangents = lines.tangents()
    _lay(lines.points, tangents, roots, tips, order, following, between, starts, points)
    ends = np.cumsum(length)
    offsets = np.concatenate([[0], starts[ends]]).astype(np.int64)
    bridged = np.add.reduceat(gap, np.concatenate([[0], ends[:-1]])).astype(np.float32)
    return points, offsets, bridged


@numba.njit(cache=True, parallel=True)
def _lay(points, tangents, roots, tips, order, following, between, starts, out):
    for n in numba.prange(len(order)):
        at = starts[n]
        segment = order[n]
        for m in range(roots[segment], tips[segment] + 1):
            out[at] = points[m]
            at += 1
        if following[segment] < 0:
            continue
        a, b = tips[segment], roots[following[segment]]
        gap = 0.0
        for axis in range(3):
            gap += (points[b, axis] - points[a, axis]) ** 2
        gap = np.sqrt(gap)
        for m in range(between[n]):
            t = (m + 1.0) / (between[n] + 1.0)
            for axis in range(3):
                out[at, axis] = (
                    (2 * t**3 - 3 * t**2 + 1) * points[a, axis]
                    + (t**3 - 2 * t**2 + t) * gap * tangents[a, axis]
                    + (3 * t**2 - 2 * t**3) * points[b, axis]
                    + (t**3 - t**2) * gap * tangents[b, axis]
                )
            at += 1
