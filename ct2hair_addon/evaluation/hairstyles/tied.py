"""Tied hairstyles: hair drawn taut over the skull to a tie, layer over layer, and on as a ponytail, a braid or a bun.

Who lies over whom follows from where the roots are: hair passes over what is rooted nearer to the tie, and in the tie the
nearest-rooted hair is innermost, so that no strand has to cross another. Heights and radii come from the room that a full
head of hair needs (`PACKING`), and are the same for any number of strands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...strands import Strands, normalized
from .growth import CLEARANCE, bundle, clump, drape, grow, pull, settle
from .person import Person, strands_of, wisps

FULL_HEAD = 100_000
"""Strands on a human head, which all the room is reckoned for."""

PACKING = 62.0
"""Strands a mm^2 of a full head of hair where it lies on the skull; hairs of 0.08 mm would fill it at 200."""

TIE_RADIUS = 18.0
"""Radius (mm) of all hair in the tie: 98 strands a mm^2, half filled."""

LIFT = 17.0
"""Height (mm) of the tie over the skin: the hair round it lies up to 10 mm deep."""

SKULL_POINTS, TURN_POINTS, TAIL_POINTS = 48, 10, 160
"""Points of the way over the skull, of the turn into the tie, and behind it."""


@dataclass(frozen=True)
class Tie:
    """Hair gathered at a tie. centre (3,): on its axis, in the tie; axes (3, 3): rows left, up, out of the head.

    heads: (N, SKULL_POINTS + TURN_POINTS, 3) the courses from the roots into the tie. across: (N, 2) mm: where each strand
    lies in the tie. loose: (N,) bool: strands that are too short for the tie, at the hairline and flying away: they go the way
    of `heads` only in part; baby: (N,) bool: those of them at the hairline.
    """

    centre: np.ndarray
    axes: np.ndarray
    heads: np.ndarray
    across: np.ndarray
    loose: np.ndarray
    baby: np.ndarray

    def angle(self) -> np.ndarray:
        """(N,) radians: where round the tie's axis the strands lie."""
        return np.arctan2(self.across[:, 1], self.across[:, 0])


def gather(who: Person, elevation: float, generator: np.random.Generator, taut: float = 1.0) -> Tie:
    """Draw all hair to a tie at the back of the head, `elevation` degrees above its middle. taut: 1, looser below."""
    unit, count = who.unit, len(who.roots)
    up = np.radians(elevation)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(up), np.cos(up)], [0.0, np.cos(up), np.sin(up)]])
    reach = who.roots - who.middle
    radius = float(np.linalg.norm(reach, axis=1).mean())
    seen = normalized(reach) @ axes.T
    from_tie = np.arccos(np.clip(seen[:, 2], -1.0, 1.0))
    azimuth = np.arctan2(seen[:, 1], seen[:, 0])

    # places in the tie: equally many strands in every wedge, in a wedge the nearest-rooted innermost
    theta, inner = _places(from_tie, azimuth)
    large, small = wisps(who, 170, generator), wisps(who, 1100, generator, ragged=1.5)
    within = TIE_RADIUS * unit * np.sqrt(inner)
    theta = theta + 0.06 * small.shared(generator)
    across = within[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=1)

    # over the skull: along great circles, bent a little by wisp, as high as the hair beneath needs
    share = np.linspace(0.0, 1.0, SKULL_POINTS)
    end = np.minimum((within + 5.0 * unit) / radius, 0.75 * from_tie)
    angle = from_tie[:, None] + (end - from_tie)[:, None] * share
    bend = (0.03 * large.shared(generator) + 0.015 * small.shared(generator)) / taut
    over = azimuth[:, None] + bend[:, None] * np.sin(np.pi * share) + _turn(theta - azimuth)[:, None] * share**3
    area = 2.0 * np.pi * radius**2 * (1.0 - np.cos(from_tie.max()))
    beneath = FULL_HEAD / area * unit**2 * radius / unit * (np.cos(angle) - np.cos(from_tie)[:, None])
    height = beneath / np.maximum(np.sin(angle), 0.12) / PACKING
    loosened = np.exp(0.12 * large.shared(generator) + 0.08 * small.shared(generator) + 0.08 * generator.normal(size=count))
    slack = (1.5 / taut) * np.abs(large.shared(generator))[:, None] * np.sin(np.pi * share) ** 2
    height = np.minimum(height * loosened[:, None] + slack * inner[:, None], 11.0) * unit
    height += np.minimum(CLEARANCE, 20.0 * share) * (1.0 + generator.random(count))[:, None]
    field = who.field
    skull = np.empty((count, SKULL_POINTS, 3))
    drape(who.middle, axes, angle, over, height, field.values, field.step, field.origin, skull)
    # rays meet the skin a little beside the root
    skull += (who.roots - skull[:, 0])[:, None] * (1.0 - share[:, None]) ** 3
    pull(skull, field.values, field.step, field.origin, height, 24)

    ground = who.middle + axes[2] * _along(field, who.middle, axes[2])
    centre = ground + axes[2] * LIFT * unit
    turned = skull[:, -1] @ axes[2] - ground @ axes[2]
    corner = ground + across @ axes[:2] + np.maximum(turned, 1.0)[:, None] * axes[2]
    entry = centre + across @ axes[:2]
    t = np.linspace(0.0, 1.0, TURN_POINTS + 1)[1:, None]
    turn = (1 - t) ** 2 * skull[:, None, -1] + 2 * t * (1 - t) * corner[:, None] + t**2 * entry[:, None]

    baby = (inner > 0.955) & (generator.random(count) < 0.5)
    loose = baby | (generator.random(count) < 0.012)
    return Tie(centre, axes, np.concatenate([skull, turn], axis=1), across, loose, baby)


def finished(who: Person, tie: Tie, tails: np.ndarray, points: int, generator: np.random.Generator) -> Strands:
    """Strands from a tie and the tails (N, T, 3) that go on from it; the loose ones are grown here."""
    courses = np.concatenate([tie.heads, tails[:, 1:]], axis=1)
    out = Strands.from_array(courses.astype(np.float32)).resampled(points).astype(np.float64)
    loose = np.flatnonzero(tie.loose)
    if len(loose):
        out[loose] = _loose(who, tie, loose, points, generator)
    field = who.field
    settle(out, field.values, field.step, field.origin, generator.uniform(0.4, 1.2, len(out)) * who.unit, 3)
    return strands_of(who, out)


def _loose(who: Person, tie: Tie, loose: np.ndarray, points: int, generator: np.random.Generator) -> np.ndarray:
    """(L, points, 3): baby hair at the hairline, and single strands that part from the rest on their way to the tie."""
    count, unit = len(loose), who.unit
    baby = tie.baby[loose]
    length = np.where(baby, generator.uniform(10.0, 32.0, count), generator.uniform(40.0, 120.0, count)) * unit
    ways = Strands.from_array(tie.heads[loose, :SKULL_POINTS].astype(np.float32))
    share = np.minimum(length / np.maximum(ways.lengths(), 1.0), 1.0)[:, None] * np.linspace(0.0, 1.0, points)
    at = share * (SKULL_POINTS - 1)
    low = np.minimum(at.astype(np.int64), SKULL_POINTS - 2)
    row = np.arange(count)[:, None]
    way = tie.heads[loose]
    out = way[row, low] + (at - low)[..., None] * (way[row, low + 1] - way[row, low])
    # they rise over the others, sideways as well, and sway
    s = np.linspace(0.0, 1.0, points)[:, None]
    away = normalized(out - who.middle)
    along = normalized(np.gradient(out, axis=1))
    aside = np.cross(away, along)
    rise = generator.uniform(1.0, 4.0, (count, 1, 1)) * np.where(baby, 1.0, 1.6)[:, None, None]
    lean = generator.normal(size=(count, 1, 1)) * np.where(baby, 4.0, 5.0)[:, None, None]
    swing = generator.normal(size=(count, 1, 1)) * np.where(baby, 1.0, 1.5)[:, None, None]
    waves = np.sin(2.0 * np.pi * (s * generator.uniform(0.6, 1.6, (count, 1, 1)) + generator.random((count, 1, 1))))
    return out + unit * (rise * s**1.5 * away + (lean * s**2 + swing * waves * s) * aside)


def _places(from_tie: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((N,) angle, (N,) share inside) in the tie: even in area, angles as near the strands' own as that allows."""
    count = len(azimuth)
    wedges = int(np.clip(count // 40, 6, 64))
    rank = np.empty(count, np.int64)
    rank[np.argsort(azimuth, kind="stable")] = np.arange(count)
    theta = 2.0 * np.pi * (rank + 0.5) / count
    theta = theta + np.angle(np.exp(1j * (azimuth - theta)).mean())
    wedge = rank * wedges // count
    order = np.lexsort((from_tie, wedge))
    start = np.searchsorted(wedge[order], np.arange(wedges + 1))
    inner = np.empty(count)
    inner[order] = (np.arange(count) - start[wedge[order]] + 0.5) / np.diff(start)[wedge[order]]
    return theta, inner


def _turn(angle: np.ndarray) -> np.ndarray:
    """Angles in -pi to pi."""
    return np.angle(np.exp(1j * angle))


def _along(field, start: np.ndarray, ray: np.ndarray) -> float:
    """mm from `start` inside the head along `ray` to the skin."""
    reach = np.arange(20.0, 250.0, 0.25)
    # the outermost skin: a head may be hollow
    return float(reach[np.flatnonzero(field.sample(start + reach[:, None] * ray) <= 0.0)[-1]])


def _frames(centre: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, Q, 3) twice: directions across centre lines (K, Q, 3), carried along without twist from `first` (3,)."""
    tangent = normalized(np.gradient(centre, axis=1))
    one = np.empty_like(centre)
    carried = np.broadcast_to(first, centre[:, 0].shape)
    for q in range(centre.shape[1]):  # along a handful of lines; each point needs the one before
        carried = normalized(carried - (carried * tangent[:, q]).sum(axis=1, keepdims=True) * tangent[:, q])
        one[:, q] = carried
    return one, np.cross(one, tangent)


def _even(centre: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Centre lines (K, Q, 3) at `points` even points, and (K,) their spacing."""
    lines = Strands.from_array(centre.astype(np.float32))
    return lines.resampled(points).astype(np.float64), lines.lengths().astype(np.float64) / (points - 1)


def _hanging(who: Person, tie: Tie, rise: float, stiff: float, length: float, clear: float) -> np.ndarray:
    """(400, 3): the middle of a tail that leaves the tie outwards, turned up by `rise`, and falls within some `stiff` mm."""
    unit = who.unit
    out = np.empty((1, 400, 3))
    one = np.ones(1)
    still = np.zeros((1, 4, 3))
    still[:, 2:, 0] = 1.0
    grow(
        tie.centre[None],
        tie.axes[2:],
        normalized(tie.axes[2:] + [0.0, 0.0, rise]),
        stiff * unit * one,
        one / (1.05 * stiff * unit),
        0.6 * stiff * unit * one,
        length * unit * one,
        clear * unit * one,
        np.zeros((1, 3)),
        one,
        still,
        who.field.values,
        who.field.step,
        who.field.origin,
        out,
    )
    return out[0]


def _swaying(tie: Tie, groups: int, generator: np.random.Generator, wide: float, own: float, unit: float) -> np.ndarray:
    """(N, 2, 3) amplitude, wavelength, phase of bends that neighbours in the tie share: `wide` mm, and `own` mm of its own."""
    group = _groups(tie, groups)
    shared = generator.normal(size=(groups, 2, 3))[group]
    alone = generator.normal(size=(len(group), 2, 3))
    sway = np.empty((len(group), 2, 3))
    sway[..., 0] = (wide * shared[..., 0] + own * alone[..., 0]) * unit
    sway[..., 1] = 110.0 * unit * np.exp(0.25 * shared[..., 1] + 0.1 * alone[..., 1])
    sway[..., 2] = 2.0 * shared[..., 2] + 0.3 * alone[..., 2]
    return sway


def _groups(tie: Tie, count: int) -> np.ndarray:
    """(N,) int64: which of `count` wisps, even in area, each place of the tie belongs to."""
    n = np.arange(count) + 0.5
    turn = np.pi * (1.0 + 5.0**0.5) * n  # a sunflower's seeds lie evenly in a disc
    seeds = np.sqrt(n / count)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    size = np.maximum(np.linalg.norm(tie.across, axis=1).max(), 1e-6)
    return cKDTree(seeds).query(tie.across / size)[1].astype(np.int64)


def ponytail(who: Person, seed: int) -> Strands:
    """Hair drawn back to a tie behind the crown, and a tail that falls from it in wisps."""
    generator, unit, count = _random(who, seed), who.unit, len(who.roots)
    tie = gather(who, 24.0, generator)
    centre, spacing = _even(_hanging(who, tie, 0.55, 42.0, 330.0, 22.0)[None], 400)
    first, second = _frames(centre, tie.axes[0])
    s = np.linspace(0.0, 330.0, 400)
    swell = 1.0 + 0.55 * (1.0 - np.exp(-((s / 50.0) ** 2)))
    groups = 90
    group = _groups(tie, groups)
    outer = np.linalg.norm(tie.across, axis=1) / (TIE_RADIUS * unit)
    # hair from all over the head meets in the tie: the tail is layered
    length = (250.0 + 14.0 * generator.normal(size=groups)[group] + 16.0 * generator.normal(size=count)) * unit
    length -= 75.0 * unit * generator.random(count) ** 3
    drift = (2.6 * generator.normal(size=(groups, 2))[group] + 0.9 * generator.normal(size=(count, 2))) * unit
    fly = generator.random(count) < 0.02
    drift *= np.where(fly, 3.0, 0.6 + 0.5 * outer)[:, None]
    tails = np.empty((count, TAIL_POINTS, 3))
    length = np.clip(length, 90.0 * unit, 328.0 * unit)
    sway, whole = _swaying(tie, groups, generator, 1.6, 0.5, unit), np.zeros(count, np.int64)
    bundle(centre, first, second, spacing, swell[None], whole, tie.across, length, np.zeros(count), drift, sway, tails)
    lead = np.zeros(groups, np.int64)
    lead[group[::-1]] = np.arange(count)[::-1]
    wisped = np.empty_like(tails)
    clump(tails, length, lead[group], np.where(fly, 0.0, generator.uniform(0.2, 0.45, count)), 1.6, wisped)
    return finished(who, tie, wisped, 176, generator)


def braid(who: Person, seed: int) -> Strands:
    """Hair drawn back to the nape and plaited in three, with a tuft below the last tie."""
    generator, unit, count = _random(who, seed), who.unit, len(who.roots)
    tie = gather(who, 0.0, generator, taut=0.8)
    plaited, tuft = 215.0, 60.0
    s = np.linspace(0.0, plaited + tuft, 600)
    middle, spacing = _even(_hanging(who, tie, 0.0, 32.0, plaited + tuft, 30.0)[None], 600)
    first, second = _frames(middle, tie.axes[0])

    # hair of different lengths thins out: all sizes follow the root of what is left
    left = np.sqrt(1.0 - 0.6 * np.clip(s / plaited, 0.0, 1.0))
    phase = 0.5 * np.pi + np.cumsum(2.0 * np.pi / (104.0 * left)) * (s[1] - s[0])
    end = 1.0 - _smooth((s - plaited + 22.0) / 20.0)
    wide, deep = 18.0 * left * end * unit, 14.0 * left * end * unit
    third = phase[None] + 2.0 * np.pi / 3.0 * np.arange(3)[:, None]
    lines = middle + (wide * np.sin(third))[..., None] * first + (deep * np.sin(2.0 * third))[..., None] * second
    lines, spacings = _even(lines, 600)
    one, two = _frames(lines, tie.axes[0])
    merged = 1.0 + (np.sqrt(3.0) * 0.8 - 1.0) * (1.0 - end)
    brush = 1.0 + 0.9 * _smooth((s - plaited) / tuft)
    swell = np.tile(left * merged * brush, (3, 1))

    angle = np.mod(tie.angle(), 2.0 * np.pi)
    part = np.mod(np.floor(angle / (2.0 * np.pi / 3.0) + 0.5).astype(np.int64), 3)
    inside = np.linalg.norm(tie.across, axis=1) / (TIE_RADIUS * unit)
    turned = 3.0 * (angle - part * 2.0 * np.pi / 3.0)
    across = (12.2 * unit * inside)[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    lasting = generator.random(count) < 0.4
    ends = plaited * generator.uniform(0.15, 1.0, count)
    ends = np.where(lasting, plaited + tuft * generator.uniform(0.35, 1.0, count) ** 0.7, ends)
    fly = generator.random(count) < 0.015
    stretch = (spacings / spacing[0])[part]
    none = np.zeros((count, 2))
    sway = _swaying(tie, 120, generator, 0.5, 0.25, unit)
    sway[..., 1] *= 0.6
    sway[fly, :, 0] *= 6.0
    straight, plait = np.empty((count, TAIL_POINTS + 60, 3)), np.empty((count, TAIL_POINTS + 60, 3))
    untwisted, whole = np.zeros(count), np.zeros(count, np.int64)
    bundle(middle, first, second, spacing, np.ones((1, 600)), whole, tie.across, ends * unit, untwisted, none, sway, straight)
    bundle(lines, one, two, spacings, swell, part, across, ends * unit * stretch, untwisted, none, sway, plait)
    along = ends[:, None] * np.linspace(0.0, 1.0, TAIL_POINTS + 60)
    weight = _smooth(along / 40.0)[..., None]
    return finished(who, tie, straight + weight * (plait - straight), 160, generator)


def bun(who: Person, seed: int) -> Strands:
    """Hair drawn up behind the crown, twisted to a rope and wound round its own base."""
    generator, unit, count = _random(who, seed), who.unit, len(who.roots)
    tie = gather(who, 34.0, generator)
    turns = np.linspace(0.0, 1.32, 400)
    out = 34.0 * _smooth(turns / 0.36)
    high = 24.0 * _smooth(turns / 0.22) - 32.0 * _smooth((turns - 0.2) / 0.75)
    angle = 2.0 * np.pi * turns
    lines = tie.centre + unit * np.stack([out * np.cos(angle), out * np.sin(angle), high], axis=1) @ tie.axes
    lines, spacing = _even(lines[None], 400)
    whole = spacing[0] * 399
    first, second = _frames(lines, tie.axes[0])
    s = np.linspace(0.0, 1.0, 400)
    ends = whole * (1.0 - 0.75 * generator.random(count) ** 1.1)
    left = np.sqrt(1.0 - np.searchsorted(np.sort(ends), s * whole) / count)
    swell = np.maximum(left, 0.3) * (1.0 + 0.3 * _smooth(s / 0.3))
    groups = 60
    drift = 0.4 * generator.normal(size=(groups, 2))[_groups(tie, groups)] * unit
    fly = generator.random(count) < 0.02
    sway = _swaying(tie, groups, generator, 0.7, 0.3, unit)
    sway[..., 1] *= 0.5
    sway[fly, :, 0] *= 6.0
    tails = np.empty((count, TAIL_POINTS, 3))
    bundle(
        lines, first, second, spacing, swell[None], np.zeros(count, np.int64), tie.across, ends,
        np.full(count, 2.0 * np.pi / (95.0 * unit)), drift, sway, tails,
    )  # fmt: skip
    return finished(who, tie, tails, 144, generator)


def _smooth(x: np.ndarray) -> np.ndarray:
    """0 to 1 with level ends."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _random(who: Person, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, len(who.roots)])


TIED = {"ponytail": ponytail, "braid": braid, "bun": bun}
