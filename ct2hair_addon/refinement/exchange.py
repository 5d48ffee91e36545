"""Strands that went over to each other's course, told apart again: they exchange their tips.

Where hairs touch, a trace may go on along the other one. Whichever way it went, the scan is explained alike, so no fit to it
brings the strand back; and in a bundle one that is in its neighbour's place keeps others from theirs. But hair goes on as it
came. So wherever two strands meet, both are weighed as they are and with their tips exchanged, by how smooth a curve goes
through what lies to both sides of the place. Nor does hair end because another comes by: a strand that ends beside one that
would go on better from it takes that one's tip over, and has its own end there instead.
"""

from __future__ import annotations

import numba
import numpy as np

from ..progress import Progress, part, silent
from ..strands import Strands, nearest_points, offsets_from_counts, point_tree
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
BLOCK = 64
"""Pairs weighed by one thread at a time."""


def exchange_tips(
    points: np.ndarray, offsets: np.ndarray, voxel: float, may: np.ndarray, most: int, progress: Progress = silent
) -> tuple[np.ndarray, np.ndarray, int]:
    """Control points (M, 3) mm and offsets (N + 1,) of the strands with tips exchanged, and how often one or two changed hands.

    voxel: mm. may: (N,) bool, strands that take part. most: control points of a strand at most. Roots and their order stay.
    The same on any number of threads.
    """
    lines, starts = even_lines(points, offsets, voxel)
    lines /= voxel
    following, previous, owner = _linked(len(lines), starts)
    places = np.flatnonzero(np.repeat(may, np.diff(starts)))
    known = places[::KNOWN_EVERY]
    tree = point_tree(lines[known])
    places = _some(places, following)
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
        places, left = _some(np.flatnonzero(asked), following), pairs[order][waits]
    chained, chained_starts = _chains(lines, following, starts)
    progress(1.0, 1.0)
    return *control_points(Strands((chained * voxel).astype(np.float32), chained_starts), most), made


def _linked(count: int, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(following, previous, owner), each (K,) int32: of each point the next and the last one, -1 at ends, and its strand."""
    following, previous = np.arange(1, count + 1, dtype=np.int32), np.arange(-1, count - 1, dtype=np.int32)
    following[starts[1:] - 1] = -1
    previous[starts[:-1]] = -1
    return following, previous, np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts))


def _some(places: np.ndarray, following: np.ndarray) -> np.ndarray:
    """Every ASKED_EVERY-th of `places`, and the tips among them."""
    chosen = following[places] < 0
    chosen[::ASKED_EVERY] = True
    return places[chosen]


def _worth_it(lines, following, previous, owner, tree, known, places, asked, left, progress) -> tuple[np.ndarray, np.ndarray]:
    """(pairs (J, 2) of points whose strands are better with tips exchanged there, gain (J,)): of `left` and at `places`, some
    of the points that are `asked` (K,) bool."""
    found = [(np.zeros((0, 2), np.int64), np.zeros(0))]
    for start in range(0, max(len(places), 1), CHUNK):
        progress(start, len(places))
        some = places[start : start + CHUNK]
        distance, near = nearest_points(tree, lines[some], NEAREST, REACH)
        other = _others(some, np.isfinite(distance), near, known, owner, asked, following)
        row, column = np.nonzero(other >= 0)
        pairs = np.stack([some[row], other[row, column]], axis=1)
        if start == 0:
            pairs = np.concatenate([left, pairs])
        gain = np.empty(len(pairs))
        _weigh(lines, following, previous, pairs, gain)
        kept = gain >= LEAST_GAIN
        found.append((pairs[kept], gain[kept]))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))


@numba.njit(cache=True, parallel=True)
def _others(places, found, near, known, owner, asked, following):
    """(P, NEAREST) int64: of the points `near` each place, nearest first, the first of each other strand, -1 for the rest: of
    two places that are asked alike, one side will do, but of a tip and a place that one is asked."""
    out = np.full(near.shape, -1, np.int64)
    for n in numba.prange(len(places)):
        own, tip = owner[places[n]], following[places[n]] < 0
        for k in range(near.shape[1]):
            if not found[n, k]:
                break
            other = known[near[n, k]]
            strand = owner[other]
            if strand == own or (strand < own and asked[other] and not tip):
                continue
            first = True
            for before in range(k):
                first &= out[n, before] < 0 or owner[out[n, before]] != strand
            if first:
                out[n, k] = other
    return out


@numba.njit(cache=True, parallel=True)
def _weigh(lines, following, previous, pairs, gain):
    """How much better two strands are with tips exchanged at each of `pairs`, whose second is moved to where it is nearest to
    the first; -1 where they can't be, and anything below LEAST_GAIN where that is not worth it. Where the first is a tip, one
    curve is weighed against the other: the second strand as it goes on, and the first going on as that."""
    for block in numba.prange(-(-len(pairs) // BLOCK)):
        walks, seen = np.empty((4, WINDOW), np.int64), np.empty((4, WINDOW, 2))
        factor, known = np.empty((2 * WINDOW - 1, BAND + 1)), (0, 0, 0.0)
        for n in range(block * BLOCK, min((block + 1) * BLOCK, len(pairs))):
            one = pairs[n, 0]
            other = _nearest(lines, one, pairs[n, 1], following, previous)
            pairs[n, 1] = other
            gain[n] = -1.0
            heads = _walk(one, previous, walks[0]), _walk(other, previous, walks[1])
            tails = _walk(one, following, walks[2]), _walk(other, following, walks[3])
            ends = following[one] < 0
            shortest = min(heads[0], heads[1], tails[1])
            if ends:
                walks[2, 1] = one  # at its tip a strand goes the way of its last two points
            else:
                shortest = min(shortest, tails[0])
            if shortest < HIDDEN + LEAST_SIDE:
                continue
            if not _across(lines, walks, (heads[0], heads[1], tails[0], tails[1]), seen):
                continue
            stiff = _stiffness(lines, walks[1], walks[3], min(heads[1], tails[1]) - 1)
            if not ends:
                stiff = min(stiff, _stiffness(lines, walks[0], walks[2], min(heads[0], tails[0]) - 1))
            known = _factor(heads[1], tails[1], stiff, factor, known)
            worth = _roughness(seen[1], heads[1], seen[3], tails[1], factor)
            if not ends:
                known = _factor(heads[0], tails[0], stiff, factor, known)
                worth += _roughness(seen[0], heads[0], seen[2], tails[0], factor)
            # the roughness of what would be is not below 0: most places need no second look
            if worth >= LEAST_GAIN:
                known = _factor(heads[0], tails[1], stiff, factor, known)
                worth -= _roughness(seen[0], heads[0], seen[3], tails[1], factor)
            if worth >= LEAST_GAIN and not ends:
                known = _factor(heads[1], tails[0], stiff, factor, known)
                worth -= _roughness(seen[1], heads[1], seen[2], tails[0], factor)
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
def _walk(start, onward, found):
    """Fill `found` with the points from `start` on, itself, then those that follow; returns how many there are."""
    count = 0
    while start >= 0 and count < len(found):
        found[count] = start
        start = onward[start]
        count += 1
    return count


@numba.njit(cache=True)
def _across(lines, walks, counts, seen):
    """Fill `seen` with the points of `walks`, the heads of two strands and their tails, as they lie across the way of both,
    voxels from the first's place; False where the two do not run one way."""
    a, b = np.empty(3), np.empty(3)
    for axis in range(3):
        a[axis] = lines[walks[2, 1], axis] - lines[walks[0, 1], axis]
        b[axis] = lines[walks[3, 1], axis] - lines[walks[1, 1], axis]
    a /= max(np.sqrt((a * a).sum()), 1e-9)
    b /= max(np.sqrt((b * b).sum()), 1e-9)
    parallel = (a * b).sum()
    if parallel < PARALLEL:
        return False
    a += b
    a /= np.sqrt(2.0 + 2.0 * parallel)
    b[:] = 0.0
    b[np.argmin(np.abs(a))] = 1.0
    b -= (b * a).sum() * a
    b /= np.sqrt((b * b).sum())
    ux, uy, uz = b[0], b[1], b[2]
    vx, vy, vz = a[1] * uz - a[2] * uy, a[2] * ux - a[0] * uz, a[0] * uy - a[1] * ux
    middle = walks[0, 0]
    for which in range(4):
        for m in range(counts[which]):
            point = walks[which, m]
            x, y, z = lines[point, 0] - lines[middle, 0], lines[point, 1] - lines[middle, 1], lines[point, 2] - lines[middle, 2]
            seen[which, m, 0] = x * ux + y * uy + z * uz
            seen[which, m, 1] = x * vx + y * vy + z * vz
    return True


@numba.njit(cache=True)
def _stiffness(lines, head, tail, span):
    """What third differences weigh, voxel^6, on a curve that bends as a strand does, by three points `span` steps apart."""
    square = 0.0
    for axis in range(3):
        square += (lines[head[span], axis] - 2.0 * lines[head[0], axis] + lines[tail[span], axis]) ** 2
    return min(SMOOTH, TURN / max(np.sqrt(square) / span**2, 1e-6)) ** 6


@numba.njit(cache=True)
def _factor(head, tail, stiff, factor, known):
    """Fill the rows of `factor` with L D L' of what a smooth curve through a head, and a tail beyond its place, is the solution
    of: 1 / D, then L one, two and three to the left. known: what it holds by now; returns what it holds then."""
    if known == (head, tail, stiff):
        return known
    size = head + tail - 1
    for m in range(size):
        c1 = c2 = c3 = 0.0
        whole = 1e-9 + (0.0 if abs(m - head + 1) <= HIDDEN else 1.0) + stiff * _thirds(m, 0, size)
        if m >= 3:
            c3 = stiff * _thirds(m, 3, size)
        if m >= 2:
            c2 = stiff * _thirds(m, 2, size) - c3 * factor[m - 2, 1]
        if m >= 1:
            c1 = stiff * _thirds(m, 1, size) - c3 * factor[m - 1, 2] - c2 * factor[m - 1, 1]
        for k, c in ((1, c1), (2, c2), (3, c3)):
            factor[m, k] = 0.0
            if m >= k:
                factor[m, k] = c * factor[m - k, 0]
                whole -= c * factor[m, k]
        factor[m, 0] = 1.0 / whole
    return head, tail, stiff


@numba.njit(cache=True)
def _thirds(m, k, size):
    """How third differences of `size` points couple the m-th with the one k before."""
    total = 0.0
    for i in range(max(m - BAND, 0), min(m - k, size - BAND - 1) + 1):
        total += third(m - i) * third(m - k - i)
    return total


@numba.njit(cache=True)
def _roughness(head, heads, tail, tails, factor):
    """What is left, voxel^2, of the misfit and change of bend of a smooth curve through a head, and a tail beyond its place.

    It is g' W g - g' W c, where the curve c solves A c = W g, A = W + K: with A = L D L' and y = L^-1 W g, g' W g - y' D^-1 y.
    """
    total = 0.0
    u1 = u2 = u3 = v1 = v2 = v3 = 0.0
    for m in range(heads + tails - 1):
        u = v = 0.0
        if abs(m - heads + 1) > HIDDEN:
            if m < heads:
                u, v = head[heads - 1 - m, 0], head[heads - 1 - m, 1]
            else:
                u, v = tail[m - heads + 1, 0], tail[m - heads + 1, 1]
            total += u * u + v * v
        u -= factor[m, 1] * u1 + factor[m, 2] * u2 + factor[m, 3] * u3
        v -= factor[m, 1] * v1 + factor[m, 2] * v2 + factor[m, 3] * v3
        total -= (u * u + v * v) * factor[m, 0]
        u1, u2, u3, v1, v2, v3 = u, u1, u2, v, v1, v2
    return total


@numba.njit(cache=True)
def _exchange(lines, following, previous, owner, pairs, touched):
    """Exchange the tips of strands at `pairs`, best first, where nothing was `touched` (K,) bool yet: (how many, (J,) bool:
    those that were, to be weighed anew). The points of each that goes on by the place are laid on the curve through it."""
    done, waits, walks = 0, np.zeros(len(pairs), np.bool_), np.empty((2, WINDOW), np.int64)
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
        previous[beyond] = one
        if ahead >= 0:
            previous[ahead] = other
        first, second = owner[one], owner[other]
        while ahead >= 0:
            owner[ahead] = second
            ahead = following[ahead]
        while beyond >= 0:
            owner[beyond] = first
            beyond = following[beyond]
        for place in (one, other):
            head = walks[0][: _walk(place, previous, walks[0])]
            tail = walks[1][: _walk(following[place], following, walks[1])]
            touched[head] = True
            if len(tail):
                _mend(lines, head, tail)
                touched[tail] = True
    return done, waits


@numba.njit(cache=True)
def _mend(lines, head, tail):
    """Lay the points up to HIDDEN from a head's first and a tail's first point on a smooth curve through the others."""
    size = len(head) + len(tail)
    curve, band = np.empty((size, 3)), np.zeros((size, BAND + 1))
    stiff = _stiffness(lines, head, tail, min(len(head), len(tail)) - 1)
    index = np.concatenate((head[::-1], tail))
    hidden = np.zeros(size, np.bool_)
    for m in range(size):
        hidden[m] = -HIDDEN <= m - len(head) + 1 <= HIDDEN + 1
        weight = 0.0 if hidden[m] else 1.0
        for k in range(min(BAND, size - 1 - m) + 1):
            band[m, k] = stiff * _thirds(m + k, k, size)
        band[m, 0] += weight + 1e-9
        curve[m] = weight * lines[index[m]]
    solve_bands(band, curve)
    for m in range(size):
        if hidden[m]:
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
