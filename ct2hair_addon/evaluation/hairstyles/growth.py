"""Hair grown strand by strand over a head: combing, gravity, layers, wisps, curls, cuts; kernels over all strands at once.

A strand leaves its root, follows the comb for a while and falls; the head (and what hair already lies on it: the layer)
pushes it out. Wisps then draw strands together, curls wind them round their own course, and scissors cut them.
"""

from __future__ import annotations

import numba
import numpy as np

from ..distance_field import distance_and_normal

STEP = 1.5
"""Largest step (mm) of the growth."""

CLEARANCE = 0.35
"""Free way (mm) between a strand and the skin, away from its root: more than the distance lattice is wrong by."""

ROOT_RISE = 0.15
"""How fast a strand must rise from the skin near its root, mm a mm."""


@numba.njit(cache=True, parallel=True)
def grow(
    roots, start, comb, comb_length, gravity, gravity_length, length, layer, tip, tip_length, wander, values, step, origin, out
):
    """Fill `out` (N, P, 3) with the courses of strands.

    roots, start (first direction), comb (where it is combed to), tip (direction that the last `tip_length` mm turn to; a
    vector of 0 for none): (N, 3). comb_length, gravity (1/mm), gravity_length, length, layer, tip_length: (N,) mm.
    wander: (N, 4, 3): two swaying directions (1/mm), then (wavelength, phase, unused) of each. values, step, origin: the
    distance field.
    """
    count = out.shape[1]
    for n in numba.prange(len(roots)):
        position = roots[n].copy()
        direction = start[n].copy()
        normal = np.zeros(3)
        out[n, 0] = position
        spacing = length[n] / (count - 1)
        parts = max(int(np.ceil(spacing / STEP)), 1)
        ds = spacing / parts
        s = 0.0
        for p in range(1, count):
            for _ in range(parts):
                fall = gravity[n] * (1.0 - np.exp(-s / gravity_length[n]))
                hold = np.exp(-s / comb_length[n]) * 4.0 / comb_length[n]
                for axis in range(3):
                    direction[axis] += ds * hold * (comb[n, axis] - direction[axis])
                    for w in range(2):
                        sway = np.sin(2.0 * np.pi * s / wander[n, 2 + w, 0] + wander[n, 2 + w, 1])
                        direction[axis] += ds * wander[n, w, axis] * sway
                direction[2] -= ds * fall
                left = length[n] - s
                if left < tip_length[n]:
                    for axis in range(3):
                        direction[axis] += ds * tip[n, axis] / tip_length[n] * 2.0
                norm = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
                direction /= norm
                ahead = position + ds * direction
                s += ds
                distance = distance_and_normal(values, step, origin, ahead[0], ahead[1], ahead[2], normal)
                wanted = min(layer[n] * (1.0 - np.exp(-s / (12.0 + 1.5 * layer[n]))), 0.4 * s) + min(0.3 * s, CLEARANCE)
                if distance < wanted:
                    ahead += normal * (wanted - distance)
                    moved = ahead - position
                    norm = np.sqrt(moved[0] ** 2 + moved[1] ** 2 + moved[2] ** 2)
                    if norm > 0.0:
                        moved /= norm
                    into = direction[0] * normal[0] + direction[1] * normal[1] + direction[2] * normal[2]
                    if into < 0.0:
                        direction -= into * normal
                        norm = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
                        if norm > 0.0:
                            direction /= norm
                    ahead = position + ds * moved
                position = ahead
            out[n, p] = position


@numba.njit(cache=True, parallel=True)
def clump(courses, length, guide, strength, power, out):
    """Draw each course towards its guide's, more and more towards the tip: `out` (N, P, 3).

    guide: (N,) the strand that leads the wisp. strength: (N,) 0 to 1 at the tip. power: how late it sets in. Points are
    held against the guide's at the same length from the root.
    """
    count = courses.shape[1]
    for n in numba.prange(len(courses)):
        lead = guide[n]
        ratio = length[n] / max(length[lead], 1e-6)
        for p in range(count):
            share = p / (count - 1)
            weight = strength[n] * share**power
            at = share * ratio * (count - 1)
            low = min(int(at), count - 2)
            t = min(at - low, 1.0)
            for axis in range(3):
                course = courses[lead, low, axis] * (1.0 - t) + courses[lead, low + 1, axis] * t
                if at > count - 1:
                    # beyond the guide's tip: go on beside it
                    left = (count - 1) / ratio
                    under = min(int(left), count - 2)
                    beside = courses[n, under, axis] + (left - under) * (courses[n, under + 1, axis] - courses[n, under, axis])
                    course += courses[n, p, axis] - beside
                out[n, p, axis] = courses[n, p, axis] + weight * (course - courses[n, p, axis])


@numba.njit(cache=True, parallel=True)
def curl(courses, radius, wavelength, phase, flat, ramp, across, out):
    """Wind each course (N, P, 3) into a helix round itself: `out`.

    radius, wavelength (mm along the course), phase: (N,). flat: (N,) 1 for a round helix, towards 0 for a flat wave.
    ramp: (N,) mm from the root over which the radius grows. across: (N, 3) the direction that the first axis starts near.
    """
    count = courses.shape[1]
    for n in numba.prange(len(courses)):
        first = across[n].copy()
        second = np.zeros(3)
        tangent = np.zeros(3)
        s = 0.0
        for p in range(count):
            # over some points: where a wisp's strands meet, two can all but coincide
            a, b = max(p - 3, 0), min(p + 3, count - 1)
            norm = 0.0
            for axis in range(3):
                tangent[axis] = courses[n, b, axis] - courses[n, a, axis]
                norm += tangent[axis] ** 2
            tangent /= max(np.sqrt(norm), 1e-9)
            if p > 0:
                d = courses[n, p] - courses[n, p - 1]
                s += np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
            # the first axis is carried along: what of it points along the strand is taken away
            along = first[0] * tangent[0] + first[1] * tangent[1] + first[2] * tangent[2]
            first -= along * tangent
            norm = np.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
            if norm < 1e-6:
                first[0], first[1], first[2] = tangent[1], -tangent[0], 0.0
                norm = max(np.sqrt(first[0] ** 2 + first[1] ** 2), 1e-6)
            first /= norm
            second[0] = tangent[1] * first[2] - tangent[2] * first[1]
            second[1] = tangent[2] * first[0] - tangent[0] * first[2]
            second[2] = tangent[0] * first[1] - tangent[1] * first[0]
            size = radius[n] * (1.0 - np.exp(-((s / ramp[n]) ** 2)))
            angle = 2.0 * np.pi * s / wavelength[n] + phase[n]
            for axis in range(3):
                out[n, p, axis] = courses[n, p, axis] + size * (
                    np.cos(angle) * first[axis] + flat[n] * np.sin(angle) * second[axis]
                )


@numba.njit(cache=True, parallel=True)
def settle(courses, values, step, origin, clearance, smoothing):
    """Push the points of courses (N, P, 3) out of the head, in place; roots stay.

    clearance: (N,) mm, reached soon after the root. smoothing: rounds in which the pushed parts are smoothed again.
    """
    count = courses.shape[1]
    for n in numba.prange(len(courses)):
        normal = np.zeros(3)
        for turn in range(smoothing + 1):
            s = 0.0
            pushed = False
            for p in range(1, count):
                d = courses[n, p] - courses[n, p - 1]
                s += np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
                x, y, z = courses[n, p, 0], courses[n, p, 1], courses[n, p, 2]
                distance = distance_and_normal(values, step, origin, x, y, z, normal)
                wanted = min(clearance[n], ROOT_RISE * s)
                if distance < wanted:
                    courses[n, p] += normal * (wanted - distance)
                    pushed = True
            if not pushed or turn == smoothing:
                break
            before = courses[n, 0].copy()
            for p in range(1, count - 1):
                here = courses[n, p].copy()
                courses[n, p] = 0.25 * before + 0.5 * here + 0.25 * courses[n, p + 1]
                before = here


@numba.njit(cache=True, parallel=True)
def cut(courses, height, shortest, out):
    """Cut each course (N, P, 3) where it first falls below `height` (N,) mm (z), but not shorter than `shortest` (N,) mm;
    one that is rooted below is cut to that.

    `out` (N, P, 3): what is left, at points of equal arc length.
    """
    count = courses.shape[1]
    for n in numba.prange(len(courses)):
        arc = np.zeros(count)
        for p in range(1, count):
            d = courses[n, p] - courses[n, p - 1]
            arc[p] = arc[p - 1] + np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
        end = arc[count - 1]
        if courses[n, 0, 2] < height[n]:
            end = min(shortest[n], end)
        for p in range(1, count):
            a, b = courses[n, p - 1, 2], courses[n, p, 2]
            if b < height[n] and a >= height[n]:
                end = max(arc[p - 1] + (a - height[n]) / (a - b) * (arc[p] - arc[p - 1]), min(shortest[n], end))
                break
        at = 0
        for p in range(count):
            wanted = end * p / (count - 1)
            while at < count - 2 and arc[at + 1] < wanted:
                at += 1
            span = arc[at + 1] - arc[at]
            t = min((wanted - arc[at]) / span, 1.0) if span > 0.0 else 0.0
            for axis in range(3):
                out[n, p, axis] = courses[n, at, axis] * (1.0 - t) + courses[n, at + 1, axis] * t


@numba.njit(cache=True, parallel=True)
def pull(courses, values, step, origin, height, rounds):
    """Pull courses (N, P, 3) taut over the head, in place, both ends held: the way of hair that is tied up.

    height: (N, P) mm over the skin that the points keep: what hair already lies beneath. Hollows are bridged.
    """
    count = courses.shape[1]
    for n in numba.prange(len(courses)):
        normal = np.zeros(3)
        for _ in range(rounds):
            for p in range(1, count - 1):
                courses[n, p] = 0.5 * (courses[n, p - 1] + courses[n, p + 1])
                x, y, z = courses[n, p, 0], courses[n, p, 1], courses[n, p, 2]
                distance = distance_and_normal(values, step, origin, x, y, z, normal)
                if distance < height[n, p]:
                    courses[n, p] += normal * (height[n, p] - distance)


@numba.njit(cache=True, parallel=True)
def drape(centre, axes, angle, azimuth, height, values, step, origin, out):
    """Lay courses over the head: `out` (N, P, 3), each point out from `centre` (3,) to its `height` (N, P) mm over the skin.

    axes: (3, 3) rows u, v, w; angle: (N, P) from w, azimuth: (N, P) from u to v, radians.
    """
    for n in numba.prange(out.shape[0]):
        normal = np.zeros(3)
        ray = np.zeros(3)
        reach = 80.0
        for p in range(out.shape[1]):
            u = np.sin(angle[n, p]) * np.cos(azimuth[n, p])
            v = np.sin(angle[n, p]) * np.sin(azimuth[n, p])
            ray[:] = u * axes[0] + v * axes[1] + np.cos(angle[n, p]) * axes[2]
            for _ in range(12):
                x, y, z = centre[0] + reach * ray[0], centre[1] + reach * ray[1], centre[2] + reach * ray[2]
                distance = distance_and_normal(values, step, origin, x, y, z, normal)
                rise = max(ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2], 0.4)
                reach += (height[n, p] - distance) / rise
                if abs(height[n, p] - distance) < 0.01:
                    break
            out[n, p] = centre + reach * ray


@numba.njit(cache=True, parallel=True)
def bundle(centre, first, second, spacing, swell, which, across, length, twist, drift, sway, out):
    """Lay strands along the centre lines of bundles, side by side and square to them: `out` (N, P, 3).

    centre, first, second: (K, Q, 3) points `spacing` (K,) mm apart and the two directions across; swell: (K, Q) factor on
    `across` (N, 2) mm. which: (N,) the bundle; length: (N,) mm of the centre line that the strand goes along; twist: (N,)
    radians a mm; drift: (N, 2) mm gained sideways over each 100 mm; sway: (N, 2, 3) amplitude (mm, reached after 40 mm),
    wavelength, phase of a strand's own bends.
    """
    count, last = out.shape[1], centre.shape[1] - 2
    for n in numba.prange(len(out)):
        k = which[n]
        for p in range(count):
            s = length[n] * p / (count - 1)
            low = min(int(s / spacing[k]), last)
            t = s / spacing[k] - low
            size = swell[k, low] + t * (swell[k, low + 1] - swell[k, low])
            c, d = np.cos(twist[n] * s), np.sin(twist[n] * s)
            a = size * (across[n, 0] * c - across[n, 1] * d) + drift[n, 0] * s / 100.0
            b = size * (across[n, 0] * d + across[n, 1] * c) + drift[n, 1] * s / 100.0
            grown = 1.0 - np.exp(-((s / 40.0) ** 2))
            a += grown * sway[n, 0, 0] * np.sin(2.0 * np.pi * s / sway[n, 0, 1] + sway[n, 0, 2])
            b += grown * sway[n, 1, 0] * np.sin(2.0 * np.pi * s / sway[n, 1, 1] + sway[n, 1, 2])
            for axis in range(3):
                middle = centre[k, low, axis] + t * (centre[k, low + 1, axis] - centre[k, low, axis])
                one = first[k, low, axis] + t * (first[k, low + 1, axis] - first[k, low, axis])
                two = second[k, low, axis] + t * (second[k, low + 1, axis] - second[k, low, axis])
                out[n, p, axis] = middle + a * one + b * two
