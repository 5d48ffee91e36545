"""Stage 5: dense strands from the guides, blended over the scalp (paper 3.3.1, eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from ..progress import Progress, part, silent
from ..settings import InterpolationSettings
from ..strands import Strands, concatenate, normalized
from ..volume import BrickVolume
from ..volume.strand_signal import support_along
from .coder import SHAPE_POINTS, Coder, LinearCoder, blend, chosen_coder
from .phase import LEAST_SWING, in_phase, swing_share
from .texture import SIDE, drawn_texels, eq3_weights, texels_of

ANGLE_POINTS = 25
"""Points at which the directions of two strands are compared."""
ROOT_REACH = 0.5
"""A guide's root farther than this from the scalp, mm, is counted as off it (EVALUATION.md)."""
PAPER_SPACING = 6.6
"""Texels between neighbouring roots in the paper: 100,000 strands over a scalp that fills a 2048^2 texture. Where the
texture's size is left open, texels are scaled so that `count` strands lie as far apart."""
PAPER_SAMPLES = 100_000
"""Texels that are tried where no count is asked for (N_i)."""
CANDIDATES = 4
"""Places tried per strand wanted: enough for a blue-noise spectrum."""
CLEARANCE = 0.1
"""Distance from the head, mm, that points of new strands are brought to."""
PUSHES = 6
LOST_ANGLE = 12.0
"""Mean angle, degrees, between a guide and its decoding, from which on its curls are lost: errors of tracing make 3 to 8."""
RELAX = 0.9
"""By how much the distance between new roots gives way from one round to the next."""
CHUNK = 2000


@dataclass(frozen=True)
class Dense:
    """Strands over the whole scalp: the guides first, in their order, then the new ones.

    strands: mm, scan frame, root first, with `root_uv` (N, 2) float32, `support` (N,) float32 (0 made up .. 1 backed by the
    scan) and `guide` (N,) bool. tally: counts in plain English.
    """

    strands: Strands
    tally: dict[str, int]


def fill_scalp(
    guides: Strands,
    head,
    count: int,
    settings: InterpolationSettings | None = None,
    seed: int = 0,
    progress: Progress = silent,
    density: BrickVolume | None = None,
    hair_level: float = 0.0,
    coder: Coder | None = None,
) -> Dense:
    """Dense strands: the guides and, where the scalp lacks them, blends of their neighbours.

    guides: mm, scan frame, root first, the root on the scalp. head: `ct2hair_addon.head.Head` (or its like) in the same frame.
    count: strands of the result, exactly (the best-backed guides stay where there are more); 0 keeps every
    guide and fills what the settings' distances allow. density, hair_level: give new strands their `support`;
    without them it is 0. coder: how strands are blended, in place of `settings.coder`. The same seed gives the same bits.

    New roots are blue noise on the scalp, not closer to a guide's root than `settings.nearest` nor farther than
    `settings.farthest` texels (the latter gives way, and is counted, where `count` could not be reached). With
    `settings.method` "texture" they are the paper's (`texture`): `count` texels are drawn (0: 100,000), those outside the two
    distances discarded, and the new strands left as the coder gives them, inside the head or not.
    """
    settings = settings or InterpolationSettings()
    progress(0.0, 1.0)
    if not len(guides):
        empty = Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
        return Dense(_attributed(empty, np.zeros((0, 2)), np.zeros(0), 0), {"guides": 0, "new strands": 0})
    drawn = settings.method == "texture"
    guides, tally = _thinned(guides, 0 if drawn else count)
    coder = coder or chosen_coder(settings, tally)
    rooted = head.closest_scalp(guides.roots)
    uv = np.asarray(guides.strand_attributes.get("root_uv", rooted.uv), np.float32)
    uv = np.where(np.isfinite(uv).all(axis=1, keepdims=True), uv, rooted.uv)
    tally["guides with their root off the scalp"] = int(np.count_nonzero(rooted.distance > ROOT_REACH))
    support = np.asarray(guides.strand_attributes.get("support", np.ones(len(guides))), np.float32)
    if drawn:
        places, more = drawn_texels(head, uv, count or PAPER_SAMPLES, settings, seed)
        tally |= more
    else:
        wanted = count - len(guides) if count > 0 else PAPER_SAMPLES
        places = _places(rooted.position, uv, head, wanted, count, settings, seed, tally)
    if not len(places.uv):
        return Dense(_attributed(guides, uv, support, len(guides)), tally | {"new strands": 0})
    progress(0.2, 1.0)

    frames = head.frames(rooted.face, rooted.bary).astype(np.float64)
    shapes = np.einsum("nij,npj->npi", frames, guides.resampled(coder.points) - guides.roots[:, None]).astype(np.float32)
    blending = Blending(shapes, uv, coder, settings)
    if not blending.held.all():
        tally["guides that the learned prior does not hold: blended by cosines"] = int(np.count_nonzero(~blending.held))
    new = np.empty((len(places.uv), SHAPE_POINTS, 3), np.float32)
    alone = 0
    for start in range(0, len(new), CHUNK):
        progress(0.2 + 0.4 * start / len(new), 1.0)
        rows = slice(start, start + CHUNK)
        made, weights = blending.at(places.uv[rows])
        alone += int(np.count_nonzero((weights > 0.0).sum(axis=1) == 1))
        turned = np.einsum("nij,npi->npj", head.frames(places.face[rows], places.bary[rows]), made)
        turned += places.position[rows][:, None]
        new[rows] = turned if coder.points == SHAPE_POINTS else Strands.from_array(turned).resampled(SHAPE_POINTS)
    tally |= {"new strands": len(new), "copied from one guide: its neighbours part ways": alone}
    if not drawn:
        new, pushed = _outside(new, head, part(progress, 0.6, 0.9))
        tally["new strands pushed out of the head"] = pushed
    made = Strands.from_array(new)
    backed = support_along(made, density, hair_level)[1] if density is not None else np.zeros(len(made), np.float32)
    guides = Strands(guides.points, guides.offsets)
    result = _attributed(
        concatenate([guides, made]), np.concatenate([uv, places.uv]), np.concatenate([support, backed]), len(guides)
    )
    progress(1.0, 1.0)
    return Dense(result, tally)


class Blending:
    """Strands for places on the scalp texture, blended from the guides nearest there (eq. 3).

    shapes: (N, P, 3) mm, the guides in their roots' frames, P the coder's points. uv: (N, 2), their places on the texture.
    With `settings.method` "texture" distances and weights are the paper's, and every guide is blended by its code.
    """

    def __init__(self, shapes: np.ndarray, uv: np.ndarray, coder: Coder, settings: InterpolationSettings) -> None:
        self._shapes, self._coder, self._settings = shapes, coder, settings
        self._codes = coder.encode(shapes)
        self._directions = _directions(shapes)
        self._lengths = np.linalg.norm(np.diff(shapes, axis=1), axis=2).sum(axis=1)
        self._aligned = coder.in_phase and settings.phase == "aligned"
        self._swing = swing_share(shapes) if self._aligned else None
        self._drawn = settings.method == "texture"
        self._tree = cKDTree(self._measured(uv))
        # What a lossy code doesn't hold (more turns than it knows) is blended by cosines, lest it be flattened.
        self.held = self._held() if coder.lossy and not self._drawn else np.ones(len(shapes), bool)
        self._instead = None if self.held.all() else Blending(shapes, uv, LinearCoder(coder.points), settings)

    def _measured(self, uv: np.ndarray) -> np.ndarray:
        """Where distances are taken: on the texture, by the paper's way between whole texels."""
        return texels_of(uv, self._settings.texture or SIDE) if self._drawn else uv

    def _held(self) -> np.ndarray:
        """(N,) bool: guides whose code gives back their directions, to LOST_ANGLE in the mean."""
        held = np.empty(len(self._shapes), bool)
        for start in range(0, len(held), CHUNK):
            rows = slice(start, start + CHUNK)
            a, b = (np.diff(shapes, axis=1) for shapes in (self._shapes[rows], self._coder.decode(self._codes[rows])))
            size = np.linalg.norm(a, axis=2) * np.linalg.norm(b, axis=2)
            cosine = np.clip((a * b).sum(axis=2) / np.maximum(size, 1e-12), -1.0, 1.0)
            held[rows] = np.degrees(np.arccos(cosine)).mean(axis=1) < LOST_ANGLE
        return held

    def at(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M, P, 3) float32 mm, strands in the frames of the places `uv` (M, 2), and the weights (M, k) of the guides."""
        neighbours = min(self._settings.neighbours, len(self._shapes))
        distance, near = (found.reshape(len(uv), -1) for found in self._tree.query(self._measured(uv), k=neighbours))
        codes = self._codes[near]
        if self._drawn:
            weights = eq3_weights(distance, near, self._codes)
        else:
            weights = blend_weights(distance, near, self._directions, self._lengths, self._settings.similarity)
        if self._aligned and neighbours > 1:
            # Smooth neighbours have no phase, and one alone needs none.
            swinging = (self._swing[near] > LEAST_SWING).all(axis=1) & ((weights > 0.0).sum(axis=1) > 1)
            rows = np.flatnonzero(swinging)
            if len(rows):
                aligned = in_phase(self._shapes[near[rows]], weights[rows])
                codes[rows] = self._coder.encode(aligned.reshape(-1, *aligned.shape[2:])).reshape(len(rows), neighbours, -1)
        made = self._coder.decode(blend(codes, weights))
        lost = np.flatnonzero((~self.held[near] & (weights > 0.0)).any(axis=1))
        if len(lost):
            made[lost] = self._instead.at(uv[lost])[0]
        return made, weights


def blend_weights(
    distance: np.ndarray, near: np.ndarray, directions: np.ndarray, lengths: np.ndarray, least: float
) -> np.ndarray:
    """(M, k) float32 weights of eq. 3: by nearness on the texture and by likeness to the nearest guide, adding up to 1.

    distance, near: (M, k) on the texture and indices of guides, nearest first. directions: (N, Q, 3) unit; lengths: (N,) mm.
    A neighbour whose directions agree with the nearest guide's by less than `least` (mean cosine over both, the whole way,
    in the root's frame) or whose length is off by more than as much parts ways with it and gets no weight: a mean of the
    two would be a strand that neither is (a curl flattened, a parting crossed).
    """
    first = near[:, :1]
    likeness = np.einsum("mkqc,mkqc->mkq", directions[near], directions[first]).mean(axis=2)
    ratio = lengths[near] / np.maximum(lengths[first], 1e-6)
    likeness = likeness * np.minimum(ratio, 1.0 / np.maximum(ratio, 1e-6))
    weight = np.where(likeness >= least, likeness, 0.0) / np.maximum(distance, 1e-9)
    weight[:, 0] = np.maximum(weight[:, 0], 1e-9)
    return (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


def _directions(shapes: np.ndarray) -> np.ndarray:
    """(N, Q, 3) float32 unit directions of shapes (N, P, 3) at ANGLE_POINTS places along them."""
    step = np.diff(shapes, axis=1)
    return normalized(step[:, np.linspace(0, step.shape[1] - 1, ANGLE_POINTS).astype(np.int64)])


def _thinned(guides: Strands, count: int) -> tuple[Strands, dict[str, int]]:
    """The `count` guides that the scan backs best, in their order; all where count is 0 or not exceeded."""
    if count <= 0 or len(guides) <= count:
        return guides, {"guides": len(guides)}
    support = np.asarray(guides.strand_attributes.get("support", np.ones(len(guides))))
    kept = np.sort(np.argsort(-support, kind="stable")[:count])
    return guides.select(kept), {
        "guides": count,
        "guides left out: more than strands wanted, least backed": len(guides) - count,
    }


def _places(rooted, uv, head, wanted, count, settings, seed, tally):
    """Scalp points for new strands: blue noise among the guides' roots, within the settings' distances on the texture."""
    candidates = head.sample_scalp(max(CANDIDATES * wanted, 64), seed)
    if wanted <= 0:
        return candidates.select(np.zeros(0, np.int64))
    spacing = float(np.sqrt(head.scalp_area / max(count or wanted, 1) * 2.0 / np.sqrt(3.0)))
    texel = 1.0 / settings.texture if settings.texture else spacing / PAPER_SPACING / _texture_scale(candidates)
    distance = cKDTree(uv).query(candidates.uv)[0] / texel
    near, far = distance < settings.nearest, distance > settings.farthest
    allowed = np.flatnonzero(~near & ~far)
    if count > 0 and len(allowed) < wanted:
        # The count stands above the distances: those a little too far first, then the least of those too near.
        far, near = np.flatnonzero(far), np.flatnonzero(near)
        others = [far[np.argsort(distance[far], kind="stable")], near[np.argsort(-distance[near], kind="stable")]]
        allowed = np.concatenate([allowed, np.concatenate(others)[: wanted - len(allowed)]])
    allowed = allowed[np.random.default_rng(seed).permutation(len(allowed))]
    # Where no count is asked for, roots that would crowd a guide are not taken at all.
    closest = 0.0 if count > 0 else settings.nearest * texel * _texture_scale(candidates)
    taken = spread_out(candidates.position[allowed].astype(np.float64), rooted.astype(np.float64), spacing, closest, wanted)
    chosen = allowed[taken]
    tally["new roots beyond the farthest texel"] = int(np.count_nonzero(distance[chosen] > settings.farthest))
    return candidates.select(chosen)


def _texture_scale(candidates) -> float:
    """Millimetres on the scalp per unit of texture coordinates: the median over neighbouring scalp points."""
    distance, near = cKDTree(candidates.position).query(candidates.position, k=2)
    apart = np.linalg.norm(candidates.uv - candidates.uv[near[:, 1]], axis=1)
    usable = (apart > 0.0) & (distance[:, 1] > 0.0)
    return float(np.median(distance[usable, 1] / apart[usable])) if usable.any() else 1.0


def _outside(strands: np.ndarray, head, progress: Progress) -> tuple[np.ndarray, int]:
    """New strands (M, P, 3) with no point but the root inside the head, and how many had some.

    Points are pushed out along the distance's gradient; the push is spread along the strand, so that it bows and has no kink.
    """
    strands = strands.astype(np.float64)
    found = np.zeros(len(strands), bool)
    rows = np.arange(len(strands))
    for attempt in range(PUSHES):
        still = []
        for start in range(0, len(rows), CHUNK):
            progress(attempt + start / max(len(rows), 1), PUSHES)
            some = rows[start : start + CHUNK]
            points = strands[some, 1:]
            distance = np.asarray(head.signed_distance(points.reshape(-1, 3).astype(np.float32), CLEARANCE), np.float64)
            distance = distance.reshape(points.shape[:2])
            # The root lies on the surface: its neighbours are given a few points to rise.
            rise = CLEARANCE * np.minimum(np.arange(1, points.shape[1] + 1) / 4.0, 1.0)
            depth = np.maximum(rise - distance, 0.0)
            inside = np.flatnonzero((distance < 0.0).any(axis=1))
            if not len(inside):
                continue
            still.append(some[inside])
            push = np.zeros((len(inside), *points.shape[1:]))
            deep = depth[inside] > 0.0
            push[deep] = depth[inside][deep][:, None] * head.outward(points[inside][deep])
            # The last rounds push point by point: what spreading leaves inside must come out, too.
            strands[some[inside], 1:] += _spread_along(push) if attempt < PUSHES - 2 else push
        rows = np.concatenate(still) if still else np.zeros(0, np.int64)
        found[rows] = True
        if not len(rows):
            break
    return strands.astype(np.float32), int(np.count_nonzero(found))


def _spread_along(push: np.ndarray) -> np.ndarray:
    """Pushes (M, P, 3) made smooth along the strand without falling short of themselves: a widening maximum, then a mean."""
    size = np.linalg.norm(push, axis=2, keepdims=True)
    smooth, weight = push.copy(), size.copy()
    for _ in range(8):
        for array in (smooth, weight):
            array[:, 1:-1] = (array[:, :-2] + 2.0 * array[:, 1:-1] + array[:, 2:]) / 4.0
    direction = smooth / np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-12)
    return direction * np.maximum(weight, size)


def _attributed(strands: Strands, uv: np.ndarray, support: np.ndarray, guides: int) -> Strands:
    """Strands with the attributes of `Dense`; the first `guides` are guides."""
    return strands.with_attributes(
        root_uv=np.asarray(uv, np.float32).reshape(-1, 2),
        support=np.asarray(support, np.float32),
        guide=np.arange(len(strands)) < guides,
    )


@numba.njit(cache=True)
def spread_out(candidates, taken, spacing, closest, wanted):
    """Up to `wanted` indices of candidates (M, 3), far from one another and from `taken` (K, 3): the first in order that
    keep `spacing`, then ever less, down to `closest` (dart throwing with a relaxed distance, McCool and Fiume 1992)."""
    low, size = np.empty(3), np.empty(3, np.int64)
    for axis in range(3):
        low[axis] = candidates[:, axis].min() if len(candidates) else 0.0
        high = candidates[:, axis].max() if len(candidates) else 0.0
        size[axis] = int((high - low[axis]) / spacing) + 1
    heads = np.full(size[0] * size[1] * size[2], -1, np.int64)
    following = np.full(len(taken) + wanted, -1, np.int64)
    placed = np.empty((len(taken) + wanted, 3))
    for n in range(len(taken)):
        placed[n] = taken[n]
        cell = 0
        for axis in range(3):
            cell = cell * size[axis] + min(max(int((taken[n, axis] - low[axis]) / spacing), 0), size[axis] - 1)
        following[n] = heads[cell]
        heads[cell] = n
    used = np.zeros(len(candidates), np.bool_)
    chosen = np.empty(wanted, np.int64)
    total = 0
    distance = spacing
    while total < wanted and total < len(candidates):
        for n in range(len(candidates)):
            if total == wanted:
                break
            if used[n]:
                continue
            i = min(int((candidates[n, 0] - low[0]) / spacing), size[0] - 1)
            j = min(int((candidates[n, 1] - low[1]) / spacing), size[1] - 1)
            k = min(int((candidates[n, 2] - low[2]) / spacing), size[2] - 1)
            free = True
            for a in range(max(i - 1, 0), min(i + 2, size[0])):
                for b in range(max(j - 1, 0), min(j + 2, size[1])):
                    for c in range(max(k - 1, 0), min(k + 2, size[2])):
                        item = heads[(a * size[1] + b) * size[2] + c]
                        while free and item >= 0:
                            apart = 0.0
                            for axis in range(3):
                                apart += (placed[item, axis] - candidates[n, axis]) ** 2
                            free = apart >= distance * distance
                            item = following[item]
            if free:
                used[n] = True
                cell = (i * size[1] + j) * size[2] + k
                placed[len(taken) + total] = candidates[n]
                following[len(taken) + total] = heads[cell]
                heads[cell] = len(taken) + total
                chosen[total] = n
                total += 1
        if distance <= closest:
            break
        distance = max(distance * RELAX, closest) if distance > 1e-3 * spacing else 0.0
    return chosen[:total]
