"""Loose hairstyles: each a recipe of combing, lengths, layers, wisps, curls and cuts over the same growth.

After the paper's ten wigs (Fig. 1): bangs, blowout, bob, curly, jewfro, jheri curl, mop top, pixie, wavy and wings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...strands import Strands, normalized
from .growth import clump, curl, cut, grow, settle
from .person import Person, strands_of, wisps

WISPS, LOCKS = 170, 1100
"""Wisps of the large and the small kind, at most: some 20 and 8 mm wide at the scalp."""


@dataclass
class Growth:
    """What a recipe says of each strand (N rows); `straight` gives the defaults. Lengths in mm of the built-in head.

    start, comb: (N, 3) unit: first direction, and where it is combed to over comb_length. gravity: 1/mm: how fast hair
    turns down, from gravity_length on. length; layer: height over the skin that it lies at; tip (N, 3), tip_length: a turn of
    the ends. sway (1/mm), sway_length: a wisp's own bends; stray: a strand's own, as a share. wisp, lock: 0 to 1, how far the
    two kinds of wisps close at the tips, lock_power: how late locks do. radius, wavelength, flat, ramp: curls (radius 0:
    none), own_phase: how much a strand's phase differs from its wisp's; phases: whether curls keep time over the `head`
    (waves), by `wisp`, or not (each `lock` a ringlet). lowest: z of the cut; shortest: mm kept at least. points: of a strand.
    """

    start: np.ndarray
    comb: np.ndarray
    comb_length: np.ndarray
    gravity: np.ndarray
    gravity_length: np.ndarray
    length: np.ndarray
    layer: np.ndarray
    tip: np.ndarray
    tip_length: np.ndarray
    lowest: np.ndarray
    radius: np.ndarray
    wavelength: np.ndarray
    flat: float = 1.0
    ramp: float = 40.0
    own_phase: float = 0.25
    sway: float = 0.004
    sway_length: float = 90.0
    stray: float = 0.5
    wisp: float = 0.45
    lock: float = 0.6
    lock_power: float = 0.8
    phases: str = "wisp"
    flyaways: float = 0.03
    shortest: float = 10.0
    points: int = 64


def straight(who: Person) -> Growth:
    """Hair that just falls: the ground that recipes change."""
    count = len(who.roots)
    ones = np.ones(count)
    return Growth(
        start=normalized(who.normals + 0.0),
        comb=who.along_scalp(np.tile([0.0, 0.0, -1.0], (count, 1))),
        comb_length=45.0 * ones,
        gravity=0.035 * ones,
        gravity_length=30.0 * ones,
        length=200.0 * ones,
        layer=3.0 + 10.0 * who.height**1.5,
        tip=np.zeros((count, 3)),
        tip_length=1.0 * ones,
        lowest=np.full(count, -1e9),
        radius=0.0 * ones,
        wavelength=50.0 * ones,
    )


def comb_from_parting(who: Person, x: float, back: float, sway: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((N, 3) directions, (N,) side) of hair parted at `x` mm left of the middle and falling to both sides and back.

    back: how much it is combed back as well. Behind the crown it falls all round. sway: (N,) mm: how the line wanders.
    """
    place = who.roots - who.middle
    line = x * who.unit * np.clip(1.2 - 0.9 * (1.0 - who.forward) * 2.0, 0.0, 1.0)
    side = np.where(place[:, 0] - line + sway > 0.0, 1.0, -1.0)
    aside = np.stack([side, np.full(len(side), back), np.full(len(side), -0.35)], axis=1)
    from_crown = who.roots - who.crown
    # behind the crown, hair radiates from it
    behind = np.clip((from_crown[:, 1] / who.unit + 10.0) / 30.0, 0.0, 1.0)[:, None]
    direction = aside * (1.0 - behind) + normalized(from_crown * [1.0, 1.0, 0.6]) * 1.2 * behind
    return who.along_scalp(direction), side


def comb_from_crown(who: Person, turn: float = 0.25) -> np.ndarray:
    """(N, 3) directions of hair that falls all round from the crown, turned a little as a whorl is."""
    away = who.roots - who.crown
    around = np.cross(who.normals, away)
    near = np.exp(-np.linalg.norm(away, axis=1, keepdims=True) / (45.0 * who.unit))
    return who.along_scalp(normalized(away) + normalized(around) * (turn + near))


def styled(who: Person, growth: Growth, generator: np.random.Generator, side: np.ndarray | None = None) -> Strands:
    """Strands of a recipe: grown, gathered into wisps, curled, cut, and kept out of the head."""
    count = len(who.roots)
    unit = who.unit
    large = wisps(who, WISPS, generator, side)
    small = wisps(who, LOCKS, generator, side, ragged=1.5)
    fly = generator.random(count) < growth.flyaways

    # bends: a wisp's, a lock's and the strand's own
    wander = np.zeros((count, 4, 3))
    for n in range(2):
        own = generator.normal(size=(count, 3)) * growth.stray * np.where(fly, 3.0, 1.0)[:, None]
        wander[:, n] = growth.sway / unit * (large.shared(generator, 3) + 0.6 * small.shared(generator, 3) + own)
        longer = (1.0, 0.45)[n] * growth.sway_length * unit
        wander[:, 2 + n, 0] = longer * np.exp(0.25 * large.shared(generator))
        wander[:, 2 + n, 1] = large.uniform(generator, 0.0, 2.0 * np.pi) + 0.4 * generator.normal(size=count)

    spread = 0.16 * large.shared(generator, 3) + 0.10 * small.shared(generator, 3) + 0.05 * generator.normal(size=(count, 3))
    comb = normalized(growth.comb + spread)
    length = growth.length * np.exp(0.05 * large.shared(generator) + 0.06 * small.shared(generator))
    length = length * (1.0 + 0.05 * generator.normal(size=count)).clip(0.75, 1.25) * np.where(fly, 0.85, 1.0)
    layer = growth.layer * np.exp(0.12 * large.shared(generator) + 0.1 * small.shared(generator))
    layer = layer * generator.uniform(0.55, 1.2, count) + np.where(fly, generator.uniform(0.0, 6.0, count), 0.0)
    field = who.field
    courses = np.empty((count, growth.points, 3))
    grow(
        who.roots,
        normalized(growth.start + 0.5 * comb + 0.15 * small.shared(generator, 3)),
        comb,
        growth.comb_length * unit,
        growth.gravity / unit,
        growth.gravity_length * unit,
        length * unit,
        layer * unit,
        growth.tip,
        growth.tip_length * unit,
        wander,
        field.values,
        field.step,
        field.origin,
        courses,
    )
    gathered = np.empty_like(courses)
    free = np.where(fly, 0.25, 1.0)
    clump(courses, length, small.lead, growth.lock * free * generator.uniform(0.7, 1.0, count), growth.lock_power, gathered)
    clump(gathered, length, large.lead, growth.wisp * free * large.uniform(generator, 0.5, 1.0), 1.4, courses)
    if (growth.radius > 0.0).any():
        wound = np.empty_like(courses)
        keeper = small if growth.phases == "lock" else large
        handed = np.where(keeper.uniform(generator) < 0.5, -1.0, 1.0)
        phase, across = keeper.uniform(generator, 0.0, 2.0 * np.pi), 0.4
        if growth.phases == "head":
            handed, phase, across = np.ones(count), 0.7 * large.shared(generator), 0.12
        curl(
            courses,
            handed * growth.radius * unit * np.exp(0.1 * small.shared(generator) + 0.06 * generator.normal(size=count)),
            growth.wavelength * unit * np.exp(0.06 * large.shared(generator) + 0.05 * small.shared(generator)),
            phase
            + (0.0 if growth.phases == "lock" else 0.4) * small.shared(generator)
            + growth.own_phase * generator.normal(size=count),
            handed * growth.flat,
            np.full(count, growth.ramp * unit),
            normalized(large.shared(generator, 3) * across + np.cross(who.normals, [0.0, 0.0, 1.0]) + 1e-3),
            wound,
        )
        courses = wound
    if (growth.lowest > -1e8).any():
        trimmed = np.empty_like(courses)
        ragged = 4.0 * large.shared(generator) + 2.5 * small.shared(generator) + 2.0 * generator.normal(size=count)
        cut(courses, growth.lowest + ragged * unit, np.full(count, growth.shortest * unit), trimmed)
        courses = trimmed
    # inner hair lies closer to the skin than outer hair even where it is pressed flat
    settle(courses, field.values, field.step, field.origin, generator.uniform(0.4, 1.6, count) * unit, 4)
    return strands_of(who, courses)


def _random(who: Person, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, len(who.roots)])


def bangs(who: Person, seed: int) -> Strands:
    """Long straight hair from a middle parting, with a full fringe to the brows."""
    generator = _random(who, seed)
    growth = straight(who)
    growth.comb, side = comb_from_parting(who, 0.0, 0.1, 2.0 * generator.normal(size=len(who.roots)))
    place = (who.roots - who.middle) / who.unit
    fringe = (who.forward > 0.68) & (np.abs(place[:, 0]) < 46.0 + 4.0 * generator.normal(size=len(place))) & (who.height > 0.66)
    forward = who.along_scalp(np.stack([0.006 * place[:, 0], np.full(len(place), -1.0), np.full(len(place), -0.2)], axis=1))
    growth.comb[fringe] = forward[fringe]
    growth.length = np.where(fringe, 125.0, 255.0 + 15.0 * who.height)
    growth.layer = np.where(fringe, 2.5 + 15.0 * (1.0 - who.forward), 3.0 + 8.0 * who.height)
    growth.start = np.where(fringe[:, None], 0.6 * who.normals + growth.comb, growth.start)
    growth.gravity = np.where(fringe, 0.09, 0.045)
    growth.gravity_length = np.where(fringe, 8.0, 20.0)
    growth.comb_length = np.where(fringe, 30.0, 45.0)
    growth.lowest = np.where(fringe, who.brow - 2.0 + 0.12 * np.abs(place[:, 0]), who.nape - 105.0 * who.unit)
    growth.sway, growth.stray, growth.wisp, growth.lock = 0.0022, 0.4, 0.3, 0.55
    return styled(who, growth, generator, np.where(fringe, 0.0, side))


def bob(who: Person, seed: int) -> Strands:
    """Straight chin-length hair from a side parting, the ends turned in."""
    generator = _random(who, seed)
    growth = straight(who)
    growth.comb, side = comb_from_parting(who, 26.0, 0.05, 1.5 * generator.normal(size=len(who.roots)))
    growth.length = 165.0 + 75.0 * who.height
    growth.layer = 3.0 + 10.0 * who.height
    growth.gravity, growth.gravity_length = growth.gravity * 1.3, growth.gravity_length * 0.7
    growth.lowest = np.full(len(who.roots), who.chin + 22.0 * who.unit) - 10.0 * who.unit * who.forward
    growth.tip, growth.tip_length = -0.8 * who.outward(), growth.tip_length * 60.0
    growth.sway, growth.stray, growth.wisp, growth.lock = 0.0018, 0.35, 0.25, 0.5
    return styled(who, growth, generator, side)


def pixie(who: Person, seed: int) -> Strands:
    """Short layered hair: sides and nape close to the head, a longer top swept forward and aside in pieces."""
    generator = _random(who, seed)
    growth = straight(who)
    place = (who.roots - who.middle) / who.unit
    top = np.clip((who.height - 0.55) / 0.3, 0.0, 1.0)
    sweep = who.along_scalp(np.tile([0.75, -0.75, -0.15], (len(place), 1)))
    growth.comb = normalized(
        comb_from_crown(who) * (1.15 - top * who.forward)[:, None] + sweep * (top * who.forward * 1.6)[:, None]
    )
    growth.length = 26.0 + 20.0 * who.height + 36.0 * top * who.forward
    growth.comb_length = growth.comb_length * 0.6
    growth.gravity = growth.gravity * (0.55 - 0.2 * top)
    growth.layer = 2.5 + 9.0 * top
    growth.sway, growth.sway_length, growth.stray, growth.wisp, growth.lock = 0.014, 60.0, 0.35, 0.5, 0.75
    growth.flyaways, growth.points = 0.04, 32
    return styled(who, growth, generator)


def mop_top(who: Person, seed: int) -> Strands:
    """Straight hair combed down all round from the crown: over the forehead, over the ears, to the collar."""
    generator = _random(who, seed)
    growth = straight(who)
    growth.comb = comb_from_crown(who)
    around = np.arctan2(who.roots[:, 0] - who.middle[0], -(who.roots[:, 1] - who.middle[1]))
    to_back = 0.5 - 0.5 * np.cos(around)
    growth.length = 120.0 + 90.0 * who.height
    growth.layer = 4.0 + 9.0 * who.height
    growth.gravity, growth.gravity_length = growth.gravity * 1.6, growth.gravity_length * 0.6
    growth.lowest = who.brow + 8.0 - (who.brow - who.nape + 24.0 * who.unit) * np.clip(to_back * 1.35 - 0.12, 0.0, 1.0) ** 1.3
    growth.sway, growth.stray, growth.wisp, growth.lock = 0.004, 0.4, 0.45, 0.6
    growth.shortest = 28.0
    return styled(who, growth, generator)


def wavy(who: Person, seed: int) -> Strands:
    """Long layered hair in loose waves from a side parting: the usual complex case."""
    generator = _random(who, seed)
    growth = straight(who)
    growth.comb, side = comb_from_parting(who, 20.0, 0.25, 2.5 * generator.normal(size=len(who.roots)))
    growth.length = 205.0 + 75.0 * who.height
    growth.layer = 4.0 + 16.0 * who.height
    growth.radius = np.full(len(who.roots), 7.5)
    growth.wavelength = np.full(len(who.roots), 66.0)
    growth.flat, growth.ramp, growth.own_phase, growth.phases = 0.5, 70.0, 0.2, "head"
    growth.sway, growth.wisp, growth.lock = 0.004, 0.6, 0.65
    return styled(who, growth, generator, side)


def curly(who: Person, seed: int) -> Strands:
    """Shoulder-length spiral curls of 5 to 8 mm radius from a middle parting, full of volume."""
    generator = _random(who, seed)
    growth = straight(who)
    growth.comb, side = comb_from_parting(who, 5.0, 0.2, 4.0 * generator.normal(size=len(who.roots)))
    growth.length = 105.0 + 65.0 * who.height
    growth.layer = 6.0 + 22.0 * who.height
    growth.gravity = growth.gravity * 0.75
    growth.radius = generator.uniform(5.0, 7.5, len(who.roots))
    growth.wavelength = np.full(len(who.roots), 25.0)
    growth.flat, growth.ramp, growth.own_phase, growth.phases = 1.0, 28.0, 0.16, "lock"
    growth.sway, growth.stray, growth.wisp, growth.lock, growth.points = 0.008, 0.4, 0.35, 0.92, 160
    growth.lock_power = 0.4
    return styled(who, growth, generator, side)


def jewfro(who: Person, seed: int) -> Strands:
    """A ball of tight coils of 4 to 6 mm radius standing out all round."""
    generator = _random(who, seed)
    growth = straight(who)
    away = normalized(who.roots - who.middle + [0.0, 0.0, 8.0 * who.unit])
    # a ball, not a peak over the forehead
    away = normalized(away + np.array([0.0, 0.35, 0.55]) * np.clip(2.0 * who.forward - 1.0, 0.0, 1.0)[:, None])
    growth.start = normalized(who.normals + away)
    growth.comb = normalized(away + 0.35 * who.normals + [0.0, 0.0, 0.05])
    growth.comb_length = growth.comb_length * 2.0
    growth.gravity = growth.gravity * 0.12
    growth.length = 52.0 + 14.0 * who.height - 8.0 * who.forward
    growth.layer = 0.0 * growth.layer + 1.0
    growth.radius = generator.uniform(4.0, 5.5, len(who.roots))
    growth.wavelength = np.full(len(who.roots), 12.0)
    growth.flat, growth.ramp, growth.own_phase, growth.phases = 1.0, 10.0, 0.25, "lock"
    growth.sway, growth.sway_length, growth.stray, growth.wisp, growth.lock = 0.02, 45.0, 0.6, 0.3, 0.88
    growth.lock_power = 0.5
    growth.points = 128
    return styled(who, growth, generator)


def jheri_curl(who: Person, seed: int) -> Strands:
    """Loose glossy curls of 4 to 6 mm radius hanging all round from the crown, over the forehead as well."""
    generator = _random(who, seed)
    growth = straight(who)
    growth.comb = comb_from_crown(who, 0.1)
    growth.length = 72.0 + 48.0 * who.height
    growth.layer = 4.0 + 9.0 * who.height
    growth.gravity, growth.gravity_length = growth.gravity * 1.3, growth.gravity_length * 0.6
    growth.radius = generator.uniform(4.0, 5.5, len(who.roots))
    growth.wavelength = np.full(len(who.roots), 19.0)
    growth.flat, growth.ramp, growth.own_phase, growth.phases = 1.0, 18.0, 0.12, "lock"
    growth.lowest = np.where(who.forward > 0.75, who.brow - 6.0 * who.unit, -1e9)
    growth.sway, growth.stray, growth.wisp, growth.lock, growth.points = 0.008, 0.35, 0.3, 0.94, 140
    growth.lock_power = 0.35
    growth.shortest = 35.0
    return styled(who, growth, generator)


def blowout(who: Person, seed: int) -> Strands:
    """Hair dried up and back with a round brush: high off the roots, soft large waves, the ends turned out."""
    generator = _random(who, seed)
    growth = straight(who)
    parted, side = comb_from_parting(who, 14.0, 0.9, 3.0 * generator.normal(size=len(who.roots)))
    growth.comb = normalized(
        parted + who.along_scalp(np.tile([0.0, 1.0, 0.35], (len(parted), 1))) * (0.9 * who.forward)[:, None]
    )
    growth.start = normalized(who.normals * 1.4 + [0.0, 0.0, 0.4])
    growth.comb_length = growth.comb_length * 1.4
    growth.length = 175.0 + 50.0 * who.height
    growth.layer = 9.0 + 20.0 * who.height
    growth.gravity = growth.gravity * 0.9
    growth.radius = np.full(len(parted), 9.0)
    growth.wavelength = np.full(len(parted), 125.0)
    growth.flat, growth.ramp, growth.own_phase, growth.phases = 0.4, 80.0, 0.15, "head"
    growth.tip, growth.tip_length = 0.3 * who.outward() + [0.0, 0.1, 0.05], growth.tip_length * 45.0
    growth.sway, growth.stray, growth.wisp, growth.lock = 0.003, 0.3, 0.5, 0.6
    return styled(who, growth, generator, side)


def wings(who: Person, seed: int) -> Strands:
    """Feathered hair from a middle parting: the sides swept back in wings, their ends flipped up and out."""
    generator = _random(who, seed)
    growth = straight(who)
    parted, side = comb_from_parting(who, 0.0, 0.75, 2.0 * generator.normal(size=len(who.roots)))
    growth.comb = parted
    growth.start = normalized(who.normals + 0.5 * parted)
    growth.comb_length = growth.comb_length * 1.3
    growth.length = 110.0 + 60.0 * who.height - 20.0 * who.forward
    growth.layer = 7.0 + 17.0 * who.height
    outward = who.outward()
    growth.tip = normalized(outward + [0.0, 0.5, 0.45]) * (0.45 + 0.5 * who.forward)[:, None]
    growth.tip_length = growth.tip_length * (45.0 + 15.0 * who.forward)
    growth.gravity = growth.gravity * 1.1
    growth.sway, growth.stray, growth.wisp, growth.lock = 0.003, 0.3, 0.5, 0.55
    return styled(who, growth, generator, side)


LOOSE = {
    "bangs": bangs,
    "blowout": blowout,
    "bob": bob,
    "curly": curly,
    "jewfro": jewfro,
    "jheri_curl": jheri_curl,
    "mop_top": mop_top,
    "pixie": pixie,
    "wavy": wavy,
    "wings": wings,
}
