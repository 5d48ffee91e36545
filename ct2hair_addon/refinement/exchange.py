"""Strands that went over to each other's course, told apart again: they exchange their tips.

Where hairs touch, a trace may go on along the other one. Whichever way it went, the scan is explained alike, so no fit to it
brings the strand back; and in a bundle one that is in its neighbour's place keeps others from theirs. But hair goes on as it
came. So wherever two strands meet, both are weighed as they are and with their tips exchanged, by how smooth a curve goes
through what lies to both sides of the place.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.spatial import cKDTree

from ..progress import Progress, part, silent
from ..strands import Strands, offsets_from_counts
from .curves import control_points, even_lines
from .motion import BAND, solve_bands, third

REACH = 2.0
"""voxel; strands that come this close may have gone over to each other."""
PARALLEL = 0.85
"""Cosine between them there, at least."""
WINDOW = 24
"""voxel to both sides of the place by which a curve is judged."""
HIDDEN = 5
"""voxel to both sides that are not looked at: there the strands were made to fit what they do."""
LEAST_SIDE = 4
"""voxel; a strand must go on for so long beyond those."""
SMOOTH, TURN = 6.0, 0.5
"""voxel; the length that a curve is smoothed by, and radians that hair turns over it at most: less where it bends more."""
LEAST_GAIN = 0.4
"""voxel^2; an exchange must make the two curves better by as much."""
ASKED_EVERY, KNOWN_EVERY = 4, 2
"""voxel along a strand from one place to the next where neighbours are looked for, and between the points of theirs known."""
NEAREST = 8
"""Points looked at there."""
ROUNDS = 12
CHUNK = 100_000
"""Places asked at once: what bounds memory."""


def exchange_tips(
    points: np.ndarray, offsets: np.ndarray, voxel: float, may: np.ndarray, most: int, progress: Progress = silent
) -> tuple[np.ndarray, np.ndarray, int]:
    """Control points (M, 3) mm and offsets (N + 1,) of the strands with tips exchanged, and how many exchanges were made.

    voxel: mm. may: (N,) bool, strands that take part. most: control points of a strand at most. Roots and their order stay.
    The same on any number of threads.
    """
    lines, starts = even_lines(points, offsets, voxel)
    lines /= voxel
    following, previous, owner = _linked(len(lines), starts)
    places = np.flatnonzero(np.repeat(may, np.diff(starts)))
    known = places[::KNOWN_EVERY]
    tree = cKDTree(lines[known])
    places = places[::ASKED_EVERY]
    asked, left = np.ones(len(lines), bool), np.zeros((0, 2), np.int64)
    made = 0
    for number in range(ROUNDS):
        # most of the work is in the first round, and half as much in each one that follows
        step = part(progress, 1.0 - 0.5**number, 1.0 - 0.5 ** (number + 1))
        pairs, gain = _worth_it(lines, following, previous, owner, tree, known, places, asked, left, step)
        if not len(pairs):
            break
        order = np.argsort(-gain, kind="stable")
        asked = np.zeros(len(lines), bool)
        done, waits = _exchange(lines, following, previous, owner, pairs[order], asked)
        made += done
        places, left = np.flatnonzero(asked)[::ASKED_EVERY], pairs[order][waits]
    chained, chained_starts = _chains(lines, following, starts)
    progress(1.0, 1.0)
    return *control_points(Strands((chained * voxel).astype(np.float32), chained_starts), most), made


def _linked(count: int, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(following, previous, owner), each (K,) int32: of each point the next and the last one, -1 at ends, and its strand."""
    following, previous = np.arange(1, count + 1, dtype=np.int32), np.arange(-1, count - 1, dtype=np.int32)
    following[starts[1:] - 1] = -1
    previous[starts[:-1]] = -1
    return following, previous, np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts))


def _worth_it(lines, following, previous, owner, tree, known, places, asked, left, progress) -> tuple[np.ndarray, np.ndarray]:
    """(pairs (J, 2) of points whose strands are better with tips exchanged there, gain (J,)): of `left` and at `places`, some
    of the points that are `asked` (K,) bool."""
    found = [(np.zeros((0, 2), np.int64), np.zeros(0))]
    for start in range(0, max(len(places), 1), CHUNK):
        progress(start, len(places))
        some = places[start : start + CHUNK]
        distance, near = tree.query(lines[some], k=NEAREST, distance_upper_bound=REACH, workers=-1)
        row, column = np.nonzero(np.isfinite(distance))
        one, other = some[row], known[near[row, column]]
        # of two that are asked alike, one side will do
        apart = (owner[one] < owner[other]) | (~asked[other] & (owner[one] != owner[other]))
        one, other, distance = one[apart], other[apart], distance[row, column][apart]
        order = np.lexsort((distance, owner[other], one))
        one, other = one[order], other[order]
        nearest = np.ones(len(one), bool)
        nearest[1:] = (one[1:] != one[:-1]) | (owner[other[1:]] != owner[other[:-1]])
        pairs = np.stack([one[nearest], other[nearest]], axis=1)
        if start == 0:
            pairs = np.concatenate([left, pairs])
        gain = np.empty(len(pairs))
        _weigh(lines, following, previous, pairs, gain)
        kept = gain >= LEAST_GAIN
        found.append((pairs[kept], gain[kept]))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))


@numba.njit(cache=True, parallel=True)
def _weigh(lines, following, previous, pairs, gain):
    """How much better two strands are with tips exchanged at each of `pairs`, whose second is moved to where it is nearest to
    the first; -1 where they can't be, and anything below LEAST_GAIN where that is not worth it."""
    for n in numba.prange(len(pairs)):
        one = pairs[n, 0]
        other = _nearest(lines, one, pairs[n, 1], following, previous)
        pairs[n, 1] = other
        gain[n] = -1.0
        heads, tails = (_walk(one, previous), _walk(other, previous)), (_walk(one, following), _walk(other, following))
        if min(len(heads[0]), len(heads[1]), len(tails[0]), len(tails[1])) < HIDDEN + LEAST_SIDE:
            continue
        a, b = np.zeros(3), np.zeros(3)
        for axis in range(3):
            a[axis] = lines[tails[0][1], axis] - lines[heads[0][1], axis]
            b[axis] = lines[tails[1][1], axis] - lines[heads[1][1], axis]
        a, b = a / max(np.sqrt((a * a).sum()), 1e-9), b / max(np.sqrt((b * b).sum()), 1e-9)
        parallel = (a * b).sum()
        if parallel < PARALLEL:
            continue
        along = (a + b) / np.sqrt(2.0 + 2.0 * parallel)
        side = np.zeros(3)
        side[np.argmin(np.abs(along))] = 1.0
        side -= (side * along).sum() * along
        side /= np.sqrt((side * side).sum())
        basis = np.stack((side, np.cross(along, side)))
        stiff = min(_stiffness(lines, heads[0], tails[0]), _stiffness(lines, heads[1], tails[1]))
        worth = _roughness(lines, heads[0], tails[0], basis, stiff) + _roughness(lines, heads[1], tails[1], basis, stiff)
        # the roughness of what would be is not below 0: most places need no second look
        if worth >= LEAST_GAIN:
            worth -= _roughness(lines, heads[0], tails[1], basis, stiff)
        if worth >= LEAST_GAIN:
            worth -= _roughness(lines, heads[1], tails[0], basis, stiff)
        gain[n] = worth


@numba.njit(cache=True)
def _nearest(lines, one, other, following, previous):
    """The point nearest to `one` next to `other`."""
    best, least = other, np.square(lines[other] - lines[one]).sum()
    for near in (following[other], previous[other]):
        if near >= 0:
            square = np.square(lines[near] - lines[one]).sum()
            if square < least:
                best, least = near, square
    return best


@numba.njit(cache=True)
def _walk(start, onward):
    """The points from `start` on, WINDOW at most: itself, then those that follow."""
    found = np.empty(WINDOW, np.int64)
    count = 0
    while start >= 0 and count < WINDOW:
        found[count] = start
        start = onward[start]
        count += 1
    return found[:count]


@numba.njit(cache=True)
def _stiffness(lines, head, tail):
    """What third differences weigh, voxel^6, on a curve that bends as a strand does, by three points of its window."""
    span = min(len(head), len(tail)) - 1
    square = 0.0
    for axis in range(3):
        square += (lines[head[span], axis] - 2.0 * lines[head[0], axis] + lines[tail[span], axis]) ** 2
    return min(SMOOTH, TURN / max(np.sqrt(square) / span**2, 1e-6)) ** 6


@numba.njit(cache=True)
def _roughness(lines, head, tail, basis, stiff):
    """What is left, voxel^2, of the misfit and change of bend of a smooth curve through a head, and a tail beyond its place."""
    size = len(head) + len(tail) - 1
    given, weight = np.empty((size, len(basis))), np.ones(size)
    for m in range(size):
        point = lines[head[len(head) - 1 - m]] if m < len(head) else lines[tail[m - len(head) + 1]]
        for axis in range(len(basis)):
            given[m, axis] = (point * basis[axis]).sum()
        if abs(m - len(head) + 1) <= HIDDEN:
            weight[m] = 0.0
    return _smooth_curve(given, weight, stiff, np.empty_like(given))


@numba.njit(cache=True)
def _smooth_curve(given, weight, stiff, curve):
    """Fill `curve` (n, c) with the least of sum weight |curve - given|^2 + stiff |third difference|^2, and return that."""
    size, axes = given.shape
    band = np.zeros((size, BAND + 1))
    for i in range(size):
        band[i, 0] = weight[i] + 1e-9
        for axis in range(axes):
            curve[i, axis] = weight[i] * given[i, axis]
    for i in range(size - BAND):
        for p in range(BAND + 1):
            for q in range(p, BAND + 1):
                band[i + p, q - p] += stiff * third(p) * third(q)
    solve_bands(band, curve)
    total = 0.0
    for axis in range(axes):
        for i in range(size):
            total += weight[i] * (curve[i, axis] - given[i, axis]) ** 2
        for i in range(size - BAND):
            change = 0.0
            for p in range(BAND + 1):
                change += third(p) * curve[i + p, axis]
            total += stiff * change**2
    return total


@numba.njit(cache=True)
def _exchange(lines, following, previous, owner, pairs, touched):
    """Exchange the tips of strands at `pairs`, best first, where nothing was `touched` (K,) bool yet: (how many, (J,) bool:
    those that were, to be weighed anew). The points of both by the place are laid on the curve that now goes through."""
    done, waits = 0, np.zeros(len(pairs), np.bool_)
    for n in range(len(pairs)):
        one, other = pairs[n]
        if touched[one] or touched[other]:
            waits[n] = True
            continue
        if owner[one] == owner[other]:
            continue
        done += 1
        ahead, beyond = following[one], following[other]
        following[one], following[other] = beyond, ahead
        previous[beyond], previous[ahead] = one, other
        first, second = owner[one], owner[other]
        while ahead >= 0:
            owner[ahead] = second
            ahead = following[ahead]
        while beyond >= 0:
            owner[beyond] = first
            beyond = following[beyond]
        for place in (one, other):
            head, tail = _walk(place, previous), _walk(following[place], following)
            _mend(lines, head, tail)
            touched[head] = True
            touched[tail] = True
    return done, waits


@numba.njit(cache=True)
def _mend(lines, head, tail):
    """Lay the points up to HIDDEN from a head's first and a tail's first point on a smooth curve through the others."""
    size = len(head) + len(tail)
    given, weight, curve = np.empty((size, 3)), np.ones(size), np.empty((size, 3))
    index = np.concatenate((head[::-1], tail))
    for m in range(size):
        given[m] = lines[index[m]]
        if -HIDDEN <= m - len(head) + 1 <= HIDDEN + 1:
            weight[m] = 0.0
    _smooth_curve(given, weight, _stiffness(lines, head, tail), curve)
    for m in range(size):
        if weight[m] == 0.0:
            lines[index[m]] = curve[m]


def _chains(lines, following, starts) -> tuple[np.ndarray, np.ndarray]:
    """(points, starts) of the strands in the order of their roots."""
    out, counts = np.empty_like(lines), np.empty(len(starts) - 1, np.int64)
    _lay(lines, following, starts, out, counts)
    return out, offsets_from_counts(counts)


@numba.njit(cache=True)
def _lay(lines, following, starts, out, counts):
    at = 0
    for n in range(len(counts)):
        begin, place = at, starts[n]
        while place >= 0:
            out[at] = lines[place]
            at += 1
            place = following[place]
        counts[n] = at - begin
