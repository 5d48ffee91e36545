"""Single strands by the thousand to train the prior on: bent rods, waves, kinks, helices, coils and noise, each from its seed.

They stand beside the hairstyles' own strands, which show how hair lies on a head, and widen what the prior knows: the shapes
are those of a rod bent by its own weight (a clamped elastica's course), with the curls of Bertails et al. 2006 wound round it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ..strands import Strands, normalized

KINDS = ("rod", "wave", "kink", "helix", "coil", "noise")
"""What a strand is: bent only; a flat wave; a flat wave with corners; a drawn-out helix; a tight one; bent at random."""
SHORTEST, LONGEST = 10.0, 400.0
"""Lengths of strands, mm: even in the logarithm for one half, even in mm for the other."""
SMALLEST, LARGEST = 2.0, 40.0
"""Radii of curls, mm."""
COURSE_POINTS = 1024
"""Points that a strand is drawn with before it is resampled: 30 a turn in the tightest coil."""
SHARPEST, MOST_TURN = 1.0, 40.0
"""A strand that bends within less than this radius, mm, or by more than these degrees from one point to the next, is drawn
anew: hair doesn't, and 256 points don't show it."""
MOST_WAVES, MOST_TURNS = 12.0, 20.0
"""Waves or kinks, and turns of a curl, on one strand at most: what 256 points show well."""
NOISE_BANDS = 4


@dataclass(frozen=True)
class Specimens:
    """Strands of known kinds. shapes: (N, P, 3) float32 mm, root at 0, in the root's tangent frame (the normal is z), points of
    equal arc length. kind: (N,) int64 into KINDS."""

    shapes: np.ndarray
    kind: np.ndarray


def procedural_strands(count: int, seed: int, points: int = 256) -> Specimens:
    """`count` strands, the kinds in turn; the same count and seed give the same strands.

    A strand leaves its root within 80 degrees of the normal, bends under gravity from any side with a stiffness of its own,
    sways with a few slow waves, and is wound with a radius of SMALLEST..LARGEST mm (evenly in the logarithm), whose size,
    wavelength and flatness drift along it.
    """
    kind = np.arange(count, dtype=np.int64) % len(KINDS)
    shapes = np.empty((count, points, 3), np.float32)
    generator = np.random.default_rng([seed, count])
    missing = np.arange(count)
    while len(missing):
        drawn = _drawn(kind[missing], generator, points)
        good = _natural(drawn)
        shapes[missing[good]] = drawn[good]
        missing = missing[~good]
    return Specimens(shapes, kind)


def _natural(shapes: np.ndarray) -> np.ndarray:
    """(N,) bool: strands of a length from SHORTEST to LONGEST that bend no sharper than hair."""
    moves = np.diff(shapes, axis=1)
    size = np.linalg.norm(moves, axis=2)
    moves = moves / np.maximum(size, 1e-9)[:, :, None]
    turn = np.arccos(np.clip((moves[:, 1:] * moves[:, :-1]).sum(axis=2), -1.0, 1.0)).max(axis=1)
    length = size.sum(axis=1)
    smooth = (turn < np.radians(MOST_TURN)) & (turn * SHARPEST < length / size.shape[1])
    return smooth & (length > 0.99 * SHORTEST) & (length < 1.01 * LONGEST)


def _drawn(kind: np.ndarray, generator: np.random.Generator, points: int) -> np.ndarray:
    """(N, points, 3) float32: a strand of each kind (N,), whatever becomes of it."""
    count = len(kind)
    name = np.array(KINDS)[kind]
    log_length = generator.uniform(np.log(SHORTEST), np.log(LONGEST), count)
    length = np.where(generator.random(count) < 0.5, np.exp(log_length), generator.uniform(SHORTEST, LONGEST, count))

    tilt = np.radians(80.0) * np.sqrt(generator.random(count))
    start = _spherical(tilt, generator.uniform(0.0, 2.0 * np.pi, count))
    pull = normalized(generator.normal(size=(count, 3)))
    # bending over the strand's length, radians: from stiff to limp
    weight = generator.uniform(0.0, 6.0, count) * (generator.random(count) < 0.85) / length
    onset = length * generator.uniform(0.02, 0.6, count)

    radius = np.exp(generator.uniform(np.log(SMALLEST), np.log(LARGEST), count))
    # a curl's pitch angle: how much of a turn's length leads onward
    onward = np.select(
        [name == "coil", name == "helix"], [generator.uniform(0.08, 0.5, count), generator.uniform(0.5, 0.95, count)], 0.9
    )
    turn = 2.0 * np.pi * radius / np.sqrt(1.0 - onward**2)  # length of hair in a turn
    flat = np.where(
        (name == "coil") | (name == "helix"), generator.uniform(0.6, 1.0, count), generator.uniform(0.0, 0.25, count)
    )
    swing = generator.uniform(0.15, 1.0, count)  # of a flat wave: steepness
    is_flat = (name == "wave") | (name == "kink")
    wave_turn = np.maximum(radius * generator.uniform(4.0, 10.0, count), length / MOST_WAVES)
    wave_size = np.minimum(0.25 * wave_turn * swing, LARGEST)
    turn = np.where(is_flat, wave_turn, turn)
    radius = np.where(is_flat, wave_size, np.where((name == "rod") | (name == "noise"), 0.0, radius))
    length = np.where(is_flat | (radius == 0.0), length, np.minimum(length, MOST_TURNS * turn))
    handed = np.where(generator.random(count) < 0.5, -1.0, 1.0)
    wavelength = np.where(is_flat, turn, turn * onward)  # along the course
    course = np.where(is_flat, length * 0.8, np.where(radius > 0.0, length * onward, length))
    corner = np.where(name == "kink", generator.uniform(0.4, 1.0, count), 0.0)
    ramp = np.maximum(course * generator.uniform(0.02, 0.5, count), radius * generator.uniform(1.0, 3.0, count))
    ramp = np.where(generator.random(count) < 0.7, ramp, 0.0)  # 0: wound from the root on
    winding = np.stack(
        [
            handed * radius,
            wavelength,
            generator.uniform(0.0, 2.0 * np.pi, count),
            flat,
            corner,
            ramp,
            generator.normal(0.0, 0.12, count).clip(-0.3, 0.3),  # drift of the radius
            generator.normal(0.0, 0.06, count).clip(-0.15, 0.15),  # drift of the wavelength
        ],
        axis=1,
    )
    # slow random bends, per band: an axis with its strength (radians over a quarter wave), wavelength, phase
    strength = np.where(name == "noise", generator.uniform(0.2, 1.2, count), generator.uniform(0.0, 0.4, count))
    cycles = np.exp(generator.uniform(np.log(0.4), np.log(7.0), (count, NOISE_BANDS)))
    sway = np.empty((count, NOISE_BANDS, 5))
    sway[:, :, :3] = normalized(generator.normal(size=(count, NOISE_BANDS, 3)))
    sway[:, :, :3] *= (strength[:, None] * np.minimum(cycles, 2.5) * generator.random((count, NOISE_BANDS)) * 2.0)[:, :, None]
    sway[:, :, :3] /= length[:, None, None]
    sway[:, :, 3] = course[:, None] / cycles
    sway[:, :, 4] = generator.uniform(0.0, 2.0 * np.pi, (count, NOISE_BANDS))

    shapes = np.empty((count, points, 3), np.float32)
    for first in range(0, count, 4096):
        rows = slice(first, first + 4096)
        drawn = np.empty((len(course[rows]), COURSE_POINTS, 3))
        _draw(start[rows], pull[rows], weight[rows], onset[rows], course[rows], winding[rows], sway[rows], drawn)
        shapes[rows] = Strands.from_array(drawn.astype(np.float32)).resampled(points)
    # winding and swaying change the length: it is set again by scale
    actual = np.linalg.norm(np.diff(shapes, axis=1), axis=2).sum(axis=1)
    scale = np.where(radius > 0.0, np.clip(length / actual, 0.7, 1.4), length / actual)
    return (shapes * scale[:, None, None]).astype(np.float32)


def _spherical(polar, around):
    return np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=1)


@numba.njit(cache=True, parallel=True)
def _draw(start, pull, weight, onset, course, winding, sway, out):
    """Fill `out` (N, P, 3): the course of each strand from 0, bent step by step, with the curl wound round it."""
    count = out.shape[1]
    for n in numba.prange(len(course)):
        tangent = start[n].copy()
        first = np.zeros(3)
        first[0], first[1] = -tangent[2], 0.0
        first[2] = tangent[0]
        second = np.zeros(3)
        position = np.zeros(3)
        radius, wavelength, phase, flat, corner, ramp, grows, stretches = winding[n]
        ds = course[n] / (count - 1)
        angle = phase
        for p in range(count):
            s = p * ds
            # the frame is carried along the course
            along = first[0] * tangent[0] + first[1] * tangent[1] + first[2] * tangent[2]
            first -= along * tangent
            norm = np.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
            first /= max(norm, 1e-9)
            second[0] = tangent[1] * first[2] - tangent[2] * first[1]
            second[1] = tangent[2] * first[0] - tangent[0] * first[2]
            second[2] = tangent[0] * first[1] - tangent[1] * first[0]
            share = s / course[n]
            size = radius * (1.0 + grows * (2.0 * share - 1.0))
            if ramp > 0.0:
                size *= 1.0 - np.exp(-((s / ramp) ** 2))
            across = np.cos(angle) - corner * (-np.cos(3.0 * angle) / 9.0 - np.cos(5.0 * angle) / 25.0)
            aside = flat * np.sin(angle)
            for axis in range(3):
                out[n, p, axis] = position[axis] + size * (across * first[axis] + aside * second[axis])
            angle += 2.0 * np.pi * ds / (wavelength * (1.0 + stretches * (2.0 * share - 1.0)))
            bend = weight[n] * (1.0 - np.exp(-s / onset[n]))
            for axis in range(3):
                tangent[axis] += ds * bend * pull[n, axis]
                for w in range(sway.shape[1]):
                    tangent[axis] += ds * sway[n, w, axis] * np.sin(2.0 * np.pi * s / sway[n, w, 3] + sway[n, w, 4]) * 4.0
            norm = np.sqrt(tangent[0] ** 2 + tangent[1] ** 2 + tangent[2] ** 2)
            tangent /= max(norm, 1e-9)
            position += ds * tangent
        root = out[n, 0].copy()
        for p in range(count):
            out[n, p] -= root
