"""The built-in head: a shop mannequin as a smooth union of simple solids, sized by published anthropometry.

Sizes are rounded adult means, women and men together, after ISO/TR 7250-2:2010 (head length, breadth, bitragion, face length),
Gordon et al. 2014 ("2012 Anthropometric Survey of U.S. Army Personnel": tragion to top of head, menton to sellion,
interpupillary breadth, bigonial breadth, neck circumference, ear length) and Farkas 1994 ("Anthropometry of the Head and Face":
nose, lips, thirds of the face, hairline). The surface is found by surface nets (Gibson 1998) and then relaxed on the solid, so
that it comes as even quads. The distance bounds of the ellipsoids and the polynomial blends are Quilez's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components

from .flatten import unwrap
from .mesh import HeadMesh

EDGE = 3.5
"""Edge of the surface's quads, mm: fine enough for eyes and lips, coarse enough for some 20,000 quads."""
RELAXATION = 14
"""Rounds of relaxing the vertices on the surface: the staircase of the grid is gone after about 12."""


@dataclass(frozen=True)
class HeadForm:
    """What the mannequin is built from, mm. Heights are over the tragion, depths in front of it or behind it."""

    breadth: float = 152.0
    length: float = 192.0
    crown: float = 131.0
    glabella: float = 95.0
    bitragion: float = 142.0
    chin: float = 96.0
    pupils: float = 62.0
    bigonial: float = 108.0
    neck: float = 355.0
    ear: float = 62.0
    base: float = 185.0


Field = Callable[[np.ndarray], np.ndarray]


def _ellipsoid(p, centre, radii, tilt=(0.0, 0.0, 0.0)):
    """Distance bound of an ellipsoid, turned by `tilt` degrees about x, then y, then z."""
    q = (p - np.asarray(centre, float)) @ _rotation(tilt)
    radii = np.asarray(radii, float)
    k0 = np.linalg.norm(q / radii, axis=-1)
    k1 = np.linalg.norm(q / radii**2, axis=-1)
    return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)


def _rotation(tilt):
    cx, cy, cz = np.cos(np.radians(tilt))
    sx, sy, sz = np.sin(np.radians(tilt))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _capsule(p, a, b, ra, rb):
    """A capsule whose radius runs from `ra` at `a` to `rb` at `b`."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    along = b - a
    t = np.clip((p - a) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * along, axis=-1) - (ra + t * (rb - ra))


def _path(p, points, radii, k):
    """Capsules along a polyline, blended by `k`."""
    total = None
    for a, b, ra, rb in zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True):
        piece = _capsule(p, a, b, ra, rb)
        total = piece if total is None else _union(total, piece, k)
    return total


def _union(a, b, k):
    """Smooth minimum: the two solids grown together over `k` mm."""
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - h * h * k * 0.25


def _cut(a, b, k):
    """Solid `a` without `b`, the edge rounded over `k` mm."""
    return -_union(-a, b, k)


def _meet(a, b, k):
    return -_union(-a, -b, k)


def head_field(form: HeadForm) -> Field:
    """The mannequin's signed distance bound (negative inside) for points (..., 3) of the head frame, mm."""

    def field(points: np.ndarray) -> np.ndarray:
        p = np.array(points, float)
        p[..., 0] = np.abs(p[..., 0])
        return _solid(p, form)

    return field


def _solid(points, form):
    p = points.reshape(-1, 3)
    d = _bulk(p, form)
    # the small parts reach no farther than this: elsewhere the unions change nothing
    near = p[:, 1] < 50.0 - form.glabella
    d[near] = _face(p[near], d[near], form)
    near = (p[:, 0] > 40.0) & (np.abs(p[:, 1] - 15.0) < 60.0) & (np.abs(p[:, 2]) < form.ear + 20.0)
    d[near] = _union(d[near], _ear(p[near], form), 6)
    return d.reshape(points.shape[:-1])


def _bulk(p, form):
    """Cranium, the face's mass, jaw, neck and base."""
    half, front, back = form.breadth / 2, -form.glabella, form.length - form.glabella
    crown, chin = form.crown, -form.chin
    # the vault behind, the forehead before, the temples narrower than the parietal bones
    d = _ellipsoid(p, (0, back - 86, crown - 90), (half, 86, 90))
    d = _union(d, _ellipsoid(p, (0, front + 68, crown - 86), (half - 10, 68.5, 76)), 22)
    d = _union(d, _ellipsoid(p, (0, back - 62, 12), (half - 13, 58, 52)), 20)
    # the face's mass down to the jaw
    d = _union(d, _ellipsoid(p, (0, front + 52, -14), (58, 50, 64)), 18)
    d = _union(d, _ellipsoid(p, (0, front + 40, -50), (36, 37, 42)), 16)
    d = _union(d, _ellipsoid(p, (0, front + 20, -44), (27, 21, 26)), 14)
    gonion = (form.bigonial / 2 - 13, front + 78, -56)
    d = _union(d, _capsule(p, (form.bitragion / 2 - 14, front + 86, -8), gonion, 13, 13), 16)
    d = _union(d, _capsule(p, gonion, (12, front + 20, chin + 14), 13, 13), 18)
    d = _union(d, _ellipsoid(p, (0, front + 13, chin + 15), (18, 13, 14)), 14)
    radius = form.neck / (2 * np.pi)
    d = _union(d, _capsule(p, (0, 16, -20), (0, 34, -form.base), radius - 3, radius + 1), 24)
    # the muscle from behind the ear to the breastbone
    d = _union(d, _capsule(p, (52, 28, -36), (14, -16, -form.base + 2), 9, 8), 22)
    d = _union(d, _ellipsoid(p, (0, 30, -form.base - 22), (128, 66, 44)), 44)
    return _meet(d, -form.base - p[..., 2], 6)


def _face(p, d, form):
    """Cheekbones, brow, eyes, nose and mouth on the bulk `d`."""
    front, eye = -form.glabella, form.pupils / 2
    d = _union(d, _ellipsoid(p, (46, front + 29, -3), (18, 18, 12), (0, 0, 25)), 18)
    d = _union(d, _path(p, [(0, front + 9.5, 30), (22, front + 11, 33), (45, front + 27, 27)], [8, 8.5, 7], 8), 14)
    d = _cut(d, _ellipsoid(p, (eye + 1, front + 4, 13), (18.5, 12.5, 11), (0, 0, 18)), 14)
    # eyeballs under closed lids
    d = _union(d, _ellipsoid(p, (eye, front + 24, 12), (15.5, 13.5, 12)), 5)
    lid = [(eye - 15, front + 17.5, 9), (eye - 6, front + 11.3, 7), (eye + 5, front + 11.8, 7), (eye + 15, front + 19, 10)]
    d = _cut(d, _path(p, lid, [1.0, 1.4, 1.4, 1.0], 2), 3)
    # nose: bridge, tip, wings, nostrils
    bridge = [(0, front + 8, 22), (0, front - 1, 6), (0, front - 13, -14)]
    d = _union(d, _path(p, bridge, [7.5, 7, 7.5], 8), 13)
    d = _union(d, _ellipsoid(p, (0, front - 14.5, -18), (8.5, 9, 8)), 6)
    d = _union(d, _ellipsoid(p, (11.5, front - 3, -21.5), (6, 9.5, 7), (0, 0, -18)), 5)
    d = _cut(d, _ellipsoid(p, (5.5, front - 9, -29), (3.2, 5, 4.5)), 3)
    # mouth: upper and lower lip, the line between, the philtrum, the hollow over the chin
    upper = _path(p, [(0, front - 1.5, -46), (7, front - 1.2, -44.8), (24, front + 8, -49)], [5.2, 5.2, 2.0], 4)
    lower = _path(p, [(0, front - 0.5, -54.5), (9, front + 0.5, -54), (23, front + 8.5, -50)], [5.8, 5.4, 1.6], 4)
    d = _union(_union(d, upper, 5), lower, 5)
    line = _path(p, [(0, front - 7.3, -49.7), (10, front - 5, -49.2), (25, front + 5, -49.7)], [1.5, 1.5, 1.1], 2)
    d = _cut(d, line, 3)
    d = _cut(d, _capsule(p, (0, front - 6, -66), (13, front - 1, -66), 5, 4), 9)
    return _cut(d, _capsule(p, (0, front - 5.6, -31), (0, front - 7.6, -40), 2.0, 2.2), 4)


def _ear(p, form):
    """The auricle: a tilted disc with a rim, a hollow and a lobe; its front edge at the tragion."""
    size = form.ear / 62.0
    origin = np.array([form.bitragion / 2 - 1, 2.0, 0.0])
    # ear axes: turned out by 25 degrees, leaning back by 12 degrees
    q = (p - origin) @ _rotation((12, 0, 0)) @ _rotation((0, 0, -25)) / size
    disc = _ellipsoid(q, (2.0, 15, 3), (5.0, 17, 30))
    d = _cut(disc, _ellipsoid(q, (9.5, 13, -2), (8.5, 9, 12)), 4)
    d = _cut(d, _ellipsoid(q, (9, 15, 17), (5.5, 9.5, 9)), 4)
    rim = _path(
        q,
        [(5, 6, 8), (5.5, 3, 18), (6.5, 7, 28), (6.5, 18, 32), (7, 28, 24), (7, 31, 9), (6, 26, -8), (4, 15, -21)],
        [2.4, 2.7, 2.9, 3.0, 3.1, 3.0, 2.8, 4.0],
        3,
    )
    d = _union(d, rim, 4)
    d = _union(d, _ellipsoid(q, (3.5, 9, -24), (4.2, 7.5, 8)), 5)
    d = _union(d, _ellipsoid(q, (3, 1, -2), (4, 3.2, 5)), 4)
    return d * size


@functools.cache
def template_head(form: HeadForm = HeadForm()) -> HeadMesh:
    """The built-in mannequin in the head frame, mm: origin between the tragia, closed, mirror symmetric, deterministic.

    Some 20,000 quads; its scalp is unwrapped by `flatten.unwrap`.
    """
    field = head_field(form)
    vertices, quads, mirror = _surface_nets(field, form)
    vertices = _relaxed(vertices, quads, mirror, field)
    vertices, scalp = _hairline(vertices, quads, mirror, field, form)
    faces = _split(vertices, quads, scalp)
    offsets = np.arange(len(quads) + 1, dtype=np.int32) * 4
    uv = np.full((len(vertices), 2), np.nan, np.float32)
    return unwrap(HeadMesh(vertices, faces, scalp, uv, offsets, quads.ravel().astype(np.int32), name="built-in head"))


def _surface_nets(field, form):
    """Quads around the zero level on a grid that is symmetric in x: (V, 3) vertices, (Q, 4) quads, (V,) mirror partner."""
    x_half = EDGE * np.ceil(145.0 / EDGE)
    x = (np.arange(2 * int(x_half / EDGE)) - int(x_half / EDGE) + 0.5) * EDGE
    y = np.arange(-form.glabella - 35.0, form.length - form.glabella + 25.0, EDGE)
    z = np.arange(-form.base - 2.5 * EDGE, form.crown + 12.0, EDGE)
    # the flat base lies halfway between two layers of the grid
    z += (-form.base - z[2]) - 0.5 * EDGE
    size = (len(x), len(y), len(z))
    value = _half_grid(field, x[len(x) // 2 :], y, z)
    value = np.concatenate([value[::-1], value], axis=0)
    inside = value < 0
    total = np.zeros(tuple(n - 1 for n in size), np.int32)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                total += inside[a : a + size[0] - 1, b : b + size[1] - 1, c : c + size[2] - 1]
    cells = np.argwhere((total > 0) & (total < 8))
    index = np.full(total.shape, -1, np.int64)
    index[tuple(cells.T)] = np.arange(len(cells))
    origin = np.array([x[0], y[0], z[0]])
    vertices = origin + (cells + 0.5) * EDGE
    mirror = index[total.shape[0] - 1 - cells[:, 0], cells[:, 1], cells[:, 2]]
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        low = [slice(1, n - 1) for n in size]
        low[axis] = slice(0, size[axis] - 1)
        high = list(low)
        high[axis] = slice(1, size[axis])
        change = inside[tuple(low)].astype(np.int8) - inside[tuple(high)]
        for sign in (1, -1):
            where = np.argwhere(change == sign)
            for other in (u, v):
                where[:, other] += 1
            corners = []
            for du, dv in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
                at = where.copy()
                at[:, u] += du
                at[:, v] += dv
                corners.append(index[tuple(at.T)])
            quad = np.stack(corners, axis=1)
            quads.append(quad if sign > 0 else quad[:, ::-1])
    return _outer_surface(vertices, np.concatenate(quads), mirror)


def _outer_surface(vertices, quads, mirror):
    """The largest piece of the surface alone: cuts and blends leave bubbles of a cell inside the solid."""
    sides = np.stack([quads.ravel(), np.roll(quads, -1, axis=1).ravel()])
    graph = coo_matrix((np.ones(sides.shape[1]), sides), (len(vertices),) * 2)
    label = connected_components(graph, directed=False)[1]
    kept = label == np.bincount(label).argmax()
    number = np.cumsum(kept) - 1
    return vertices[kept], number[quads[kept[quads[:, 0]]]], number[mirror[kept]]


def _half_grid(field, x, y, z):
    """The field's values on a grid: exact near the surface, of the right sign elsewhere (from every fourth node)."""
    size, step = (len(x), len(y), len(z)), 4
    coarse = field(np.stack(np.meshgrid(x[::step], y[::step], z[::step], indexing="ij"), axis=-1))
    value = coarse.repeat(step, 0).repeat(step, 1).repeat(step, 2)[: size[0], : size[1], : size[2]]
    # a node lies within three grid steps a side of its coarse node, and blends make the bound up to a third too short
    near = np.argwhere(np.abs(value) < 2.0 * np.sqrt(3.0) * 3 * EDGE)
    value[tuple(near.T)] = field(np.stack([x[near[:, 0]], y[near[:, 1]], z[near[:, 2]]], axis=-1))
    return value


TETRAHEDRON = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
"""Directions of the four samples that give a field's value and gradient at once."""


def _projected(vertices, field, rounds):
    """The vertices moved along the field's gradient onto its zero level."""
    step = 0.05
    for _ in range(rounds):
        samples = field(vertices[:, None] + step * TETRAHEDRON)
        value = samples.mean(axis=1)
        gradient = samples @ TETRAHEDRON / (4.0 * step)
        move = value[:, None] * gradient / np.maximum((gradient**2).sum(axis=1, keepdims=True), 0.05)
        # a step never longer than the grid's edge: the bound's gradient is small near creases
        length = np.linalg.norm(move, axis=1, keepdims=True)
        vertices = vertices - move * np.minimum(1.0, EDGE / np.maximum(length, 1e-9))
    return vertices


def _mean_of_neighbours(quads, count):
    """(V, V) sparse matrix: the mean over the neighbours along the quads' edges."""
    a, b = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    graph = coo_matrix((np.ones(2 * len(a)), (np.concatenate([a, b]), np.concatenate([b, a]))), (count, count)).tocsr()
    graph.data[:] = 1.0
    return (diags(1.0 / np.asarray(graph.sum(axis=1)).ravel()) @ graph).tocsr()


def _relaxed(vertices, quads, mirror, field):
    """The vertices spread evenly on the surface: smoothed along it and put back onto it, one half mirrored to the other."""
    mean = _mean_of_neighbours(quads, len(vertices))
    left = np.flatnonzero(np.arange(len(vertices)) <= mirror)

    def settled(moved, rounds):
        out = np.empty_like(moved)
        half = _projected(moved[left], field, rounds)
        half[left == mirror[left], 0] = 0.0
        out[mirror[left]] = half * [-1.0, 1.0, 1.0]
        out[left] = half
        return out

    vertices = settled(vertices, 3)
    for _ in range(RELAXATION):
        vertices = settled(vertices + 0.6 * (mean @ vertices - vertices), 1)
    return settled(vertices, 3)


HAIRLINE = (
    # azimuth from the front (0 = face, 180 = back) and elevation, degrees, seen from the middle of the cranium
    (0.0, 33.0),
    (14.0, 33.5),
    (26.0, 36.0),
    (35.0, 37.0),
    (45.0, 30.0),
    (55.0, 18.0),
    (63.0, 9.0),
    (69.0, -4.0),
    (74.0, -20.0),
    (78.0, -24.0),
    (82.0, -18.0),
    (85.0, -3.0),
    (91.0, 5.0),
    (101.0, 7.0),
    (112.0, 3.0),
    (121.0, -14.0),
    (127.0, -33.0),
    (135.0, -47.0),
    (150.0, -52.0),
    (180.0, -52.5),
)
"""The hairline: a third of the face over the brow, temples, sideburns, around the ears, nape (Farkas 1994)."""
CENTRE = np.array([0.0, 5.0, 40.0])
"""The middle of the cranium: where the hairline's angles are measured."""
EAR_GAP = 3.0
"""No hair on the ear, nor closer to it than this, mm."""
HAIRLINE_ROUNDS = 8
"""Rounds of smoothing the scalp's edge along the surface: the quads' staircase is gone."""


def _over_hairline(vertices):
    """(V,) degrees of elevation over the hairline; positive on the scalp."""
    azimuth, elevation = np.array(HAIRLINE).T
    line = PchipInterpolator(azimuth, elevation)
    q = vertices - CENTRE
    angle = np.degrees(np.arctan2(np.abs(q[:, 0]), -q[:, 1]))
    height = np.degrees(np.arctan2(q[:, 2], np.hypot(q[:, 0], q[:, 1])))
    return height - line(np.clip(angle, 0.0, 180.0))


def _hairline(vertices, quads, mirror, field, form):
    """The vertices with the scalp's edge smoothed, and (V,) bool scalp: whole quads over the hairline, off the ears."""
    aside = np.abs(vertices) * [1, 0, 0] + vertices * [0, 1, 1]
    scalp = (_over_hairline(vertices) > 0) & (_ear(aside, form) > EAR_GAP)
    scalp &= scalp[mirror]
    # teeth off, notches filled: the edge is to run along the quads without zigzag
    for _ in range(2):
        full = scalp[quads].all(axis=1)
        scalp = np.bincount(quads[full].ravel(), minlength=len(vertices)) >= 2
        scalp[quads[scalp[quads].sum(axis=1) == 3]] = True
    full = scalp[quads].all(axis=1)
    scalp = np.bincount(quads[full].ravel(), minlength=len(vertices)) > 0
    full = scalp[quads].all(axis=1)
    sides = np.stack([quads[full].ravel(), np.roll(quads[full], -1, axis=1).ravel()], axis=1)
    pairs, count = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    rim = pairs[count == 1]
    ends = np.concatenate([rim, rim[:, ::-1]])
    along = coo_matrix((np.full(len(ends), 0.5), (ends[:, 0], ends[:, 1])), (len(vertices),) * 2).tocsr()
    on_rim = np.unique(rim)
    mean = _mean_of_neighbours(quads, len(vertices))
    moving = np.setdiff1d(np.unique(mean[on_rim].indices), on_rim)
    for _ in range(HAIRLINE_ROUNDS):
        moved = vertices.copy()
        moved[on_rim] += 0.5 * (along @ vertices - vertices)[on_rim]
        moved[moving] += 0.5 * (mean @ vertices - vertices)[moving]
        changed = np.concatenate([on_rim, moving])
        moved[changed] = _projected(moved[changed], field, 1)
        vertices = 0.5 * (moved + moved[mirror] * [-1.0, 1.0, 1.0])
    return vertices, scalp


def _split(vertices, quads, scalp):
    """(2 Q, 3) int32 triangles, each quad along its shorter diagonal; one with a single corner off the scalp through that
    corner, so that triangles are scalp only where their quads are."""
    a = np.linalg.norm(vertices[quads[:, 0]] - vertices[quads[:, 2]], axis=1)
    b = np.linalg.norm(vertices[quads[:, 1]] - vertices[quads[:, 3]], axis=1)
    on = scalp[quads]
    single = on.sum(axis=1) == 3
    # ties go to the first diagonal, with room for rounding: the same mesh on every machine
    first = np.where(single, ~(on[:, 0] & on[:, 2]), a <= b + 1e-6)[:, None]
    one = np.where(first, quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    two = np.where(first, quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    return np.stack([one, two], axis=1).reshape(-1, 3).astype(np.int32)
