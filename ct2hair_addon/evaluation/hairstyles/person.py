"""Who wears the hair: the roots on a scalp, its landmarks, its distance field, and the wisps of the roots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from ...head import Head, HeadMesh
from ...strands import Strands, normalized, offsets_from_counts
from ..distance_field import DistanceField

FIELD_STEP = 1.5
"""Lattice (mm) of the distance field."""

ROOM = 60.0
"""How far (mm) the distance field reaches beyond the head; farther off, its outer cells go on."""

LONGEST = 340.0
"""The field reaches this far (mm) below the top of the scalp."""

HOP = -2.0
"""An edge whose middle is deeper (mm) in the head than this goes through it."""


@dataclass(frozen=True)
class Person:
    """Roots (N, 3) with normals (N, 3) and scalp texture coordinates, the head's landmarks and its distance field.

    unit: size of the head against the built-in one (1). Heights (z) and places are in the head frame, mm: middle (3,) of the
    scalp's box, top, nape (its lowest), brow, chin, front and back (y), side (half width).
    """

    roots: np.ndarray
    normals: np.ndarray
    root_uv: np.ndarray
    field: DistanceField
    unit: float
    middle: np.ndarray
    side: float
    top: float
    nape: float
    front: float
    back: float
    hairline: float

    @property
    def brow(self) -> float:
        return self.hairline - 50.0 * self.unit

    @property
    def chin(self) -> float:
        return self.nape - 48.0 * self.unit

    @property
    def height(self) -> np.ndarray:
        """(N,) 0 at the nape to 1 at the top."""
        return np.clip((self.roots[:, 2] - self.nape) / (self.top - self.nape), 0.0, 1.0)

    @property
    def forward(self) -> np.ndarray:
        """(N,) 0 at the back of the scalp to 1 at its front."""
        return np.clip((self.back - self.roots[:, 1]) / (self.back - self.front), 0.0, 1.0)

    @property
    def crown(self) -> np.ndarray:
        """(3,): where the whorl is: behind the top."""
        return np.array([self.middle[0], self.middle[1] + 30.0 * self.unit, self.top - 6.0 * self.unit])

    def along_scalp(self, vectors: np.ndarray) -> np.ndarray:
        """(N, 3) unit: vectors (N, 3) laid into the tangent planes at the roots."""
        flat = vectors - (vectors * self.normals).sum(axis=1, keepdims=True) * self.normals
        return normalized(flat)

    def outward(self) -> np.ndarray:
        """(N, 3) unit, horizontal: away from the head's axis."""
        away = self.roots - self.middle
        away[:, 2] = 0.0
        return normalized(away)


@dataclass(frozen=True, eq=False)
class _Identity:
    """A head that equals itself alone: its arrays can be neither compared nor hashed as a whole."""

    mesh: HeadMesh

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and self.mesh is other.mesh

    def __hash__(self) -> int:
        return id(self.mesh)


@lru_cache(maxsize=1)
def _measured(of: _Identity) -> tuple[Head, DistanceField, float]:
    """A head, its distance field and its unit: kept, as one style after another is asked for on the same head."""
    head = Head(of.mesh)
    scalp = head.mesh.vertices[head.mesh.scalp].astype(np.float64)
    low, high = scalp.min(axis=0), scalp.max(axis=0)
    unit = 0.5 * float(high[0] - low[0]) / 76.0
    lowest = np.minimum(low - ROOM, [low[0] - ROOM, low[1] - ROOM, high[2] - LONGEST * unit])
    return head, DistanceField.around(head, lowest, high + ROOM, FIELD_STEP * unit), unit


def person(mesh: HeadMesh, strands: int, seed: int) -> Person:
    """Roots spread over a head's scalp (head frame), with everything that styles ask about it."""
    head, field, unit = _measured(_Identity(mesh))
    on = head.sample_scalp(strands, seed)
    scalp = head.mesh.vertices[head.mesh.scalp].astype(np.float64)
    low, high = scalp.min(axis=0), scalp.max(axis=0)
    middle = 0.5 * (low + high)
    central = np.abs(scalp[:, 0] - middle[0]) < 8.0 * unit
    at_front = central & (scalp[:, 1] < middle[1])
    hairline = scalp[at_front, 2].min() if at_front.any() else low[2] + 0.8 * (high[2] - low[2])
    return Person(
        on.position.astype(np.float64),
        on.normal.astype(np.float64),
        on.uv,
        field,
        float(unit),
        middle,
        float(0.5 * (high[0] - low[0])),
        float(high[2]),
        float(low[2]),
        float(low[1]),
        float(high[1]),
        float(hairline),
    )


@dataclass(frozen=True)
class Wisps:
    """Roots in groups. group: (N,) int64 number of each root's wisp; lead: (N,) int64 the root that leads it; count."""

    group: np.ndarray
    lead: np.ndarray
    count: int

    def shared(self, generator: np.random.Generator, *shape: int) -> np.ndarray:
        """(N, *shape) standard normal numbers, the same for all of a wisp."""
        return generator.normal(size=(self.count, *shape))[self.group]

    def uniform(self, generator: np.random.Generator, low: float = 0.0, high: float = 1.0) -> np.ndarray:
        """(N,) uniform numbers, the same for all of a wisp."""
        return generator.uniform(low, high, self.count)[self.group]


def wisps(
    who: Person, count: int, generator: np.random.Generator, side: np.ndarray | None = None, ragged: float = 3.0
) -> Wisps:
    """`count` wisps round as many evenly spread roots; `side` (N,) keeps those of different sides (of a parting) apart.

    ragged: mm by which the wisps' borders fray.
    """
    count = min(count, len(who.roots))
    # any first part of the roots is spread over the whole scalp
    places = who.roots + generator.normal(size=who.roots.shape) * ragged * who.unit
    places[:count] = who.roots[:count]
    if side is not None:
        places = np.column_stack([places, 1000.0 * side])
    _, group = cKDTree(places[:count]).query(places)
    return Wisps(group.astype(np.int64), group.astype(np.int64), count)


def strands_of(who: Person, courses: np.ndarray) -> Strands:
    """Strands from courses (N, P, 3), rooted exactly, with `root_uv`.

    One that hops through the head (a shoulder, say, that it was pushed out of on the far side) is cut before the hop.
    """
    courses = courses.astype(np.float32)
    courses[:, 0] = who.roots
    middles = 0.5 * (courses[:, 1:] + courses[:, :-1])
    through = who.field.sample(middles.reshape(-1, 3)).reshape(middles.shape[:2]) < HOP
    counts = np.where(through.any(axis=1), np.maximum(through.argmax(axis=1) + 1, 2), courses.shape[1])
    kept = courses[np.arange(courses.shape[1]) < counts[:, None]]
    return Strands(kept, offsets_from_counts(counts), {"root_uv": who.root_uv.astype(np.float32)})
