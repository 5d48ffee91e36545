"""The template head brought onto the scanned wig: which way it faces, rigid ICP, then a smooth fit (supplement 1).

Pose: the spheres of the template's scalp and of the knots are laid on each other in each axis orientation in question, and a
trimmed ICP (weights of Geman-McClure, point to plane, after Chen and Medioni 1991) refines each; the best by knots, mannequin
surface and hair mass wins. Fit: a B-spline deformation of space with a bending penalty that is relaxed round by round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.spatial import cKDTree

from ..errors import HeadError
from ..progress import Progress, part, silent
from ..settings import AXES, HeadSettings
from ..volume import BrickVolume
from .deformation import Lattice, least_squares
from .flatten import unwrap
from .mesh import HeadMesh, edges, largest_component, through_skin, vertex_normals
from .nearest import TriangleTree
from .obj import AXIS
from .scalp_surface import scalp_sphere, scalp_surface
from .surface import Head

LEAST_POINTS = 200
"""Fewer scalp points than this don't show a scalp."""
CELL = 3.0
"""Points are thinned to a few a cell of this edge, mm, so that area counts and not density."""
PER_CELL = 3
SCALP_BAND = 8.0
"""Knots farther than this from the radial surface are loose strands, mm."""
SCALES = (0.8, 1.3)
"""Heads from a child's to the largest adult's against the built-in one."""
SEARCH_POINTS = 900
"""Points of each kind that an orientation is tried with."""
SEARCH_REACHES = (20.0, 16.0, 12.0, 10.0, 8.0, 8.0, 6.0, 6.0, 6.0, 6.0)
FINE_POINTS = 6000
FINE_REACHES = (8.0, 6.0, 5.0, 4.0, 4.0, 4.0, 4.0, 4.0)
"""Reach of the robust weight, mm, round by round."""
ALONG = 0.3
"""Weight of a residual along the surface against one across it: it says where the scalp ends."""
COVERAGE = 0.5
"""Weight of template points against their nearest knots: without it a scalp may be too wide."""
MATCH = 6.0
"""A point that lies within about this of the other surface matches it, mm."""
TILT = 25.0
"""Heads lean by some degrees against the scan's axes; by this many an orientation has lost all its advantage."""
CERTAIN = 0.08
"""A lead of the best orientation over the next at which the certainty is 63 %."""
LEVELS = (
    # lattice spacing mm, bending, slope, reach of the robust weight mm in each round
    (45.0, 1000.0, 0.3, (12.0, 10.0, 8.0, 7.0)),
    (28.0, 100.0, 0.2, (6.0, 5.0, 4.0, 3.5)),
    (18.0, 20.0, 0.2, (3.0, 2.5, 2.0, 1.7)),
)
"""The smooth fit, lattice upon lattice: at these bending weights waves of 100, 50 and 30 mm follow the points by half."""
SKIN_ROUNDS = (1.5, 1.2, 1.0)
"""Reach of the robust weight in the last rounds, mm, which move the scalp's vertices themselves."""
SKIN_STIFFNESS = 8.0
"""Weight of the last rounds' squared slope: waves of 18 mm follow the points by half, noise of single points doesn't show."""
ROOTS_REACH, ROOTS_STIFFNESS = 4.0, 1.5
"""The same where all points are roots, with no junk among them: creases of a coarse mesh are followed, too."""
INWARD = 5.0
"""Points under the fitted surface count from this many times farther: hair is no way to be inside a head."""
SURROUNDINGS = 35.0
"""The knots may also pull skin this close to the template's scalp, mm: hairlines and necks differ."""
ASIDE = 3.0
"""A point farther aside of the patch than this, mm, says little about its place."""
INLIER = 2.0
"""Knots this close to the fitted surface lie on it, mm."""
GROWTH = 30.0
"""The scalp may grow this far past the template's hairline, mm."""
GROWTH_RADIUS = 5.0
GROWTH_DENSITY = 0.4
"""Skin becomes scalp where, within GROWTH_RADIUS mm, knots are at least so dense compared with the scalp's own."""


@dataclass(frozen=True)
class Registration:
    """The head in the scan.

    head: HeadMesh in the scan frame, mm. matrix: (4, 4) float64 similarity, head frame -> scan frame (before the smooth fit).
    certainty: 0 to 1, how far the chosen face and up axes lead over the next best; 1 where both were given.
    face_axis, up_axis: scan axes along which the face looks and the crown points, "-y", "+z". residual_mm: median distance
    of the scalp's knots to the fitted scalp. tally: counts of points kept and left out. warnings: what to look at.
    """

    head: HeadMesh
    matrix: np.ndarray
    certainty: float
    face_axis: str
    up_axis: str
    residual_mm: float
    tally: dict[str, int]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Cloud:
    """Thinned points (M, 3) in the scan frame and their weights (M,), about 1 for each CELL^2 of surface."""

    points: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def some(self, count: int) -> _Cloud:
        if len(self) <= count:
            return self
        chosen = np.sort(np.random.default_rng(1).permutation(len(self))[:count])
        return _Cloud(self.points[chosen], self.weights[chosen])


def axis_rotation(face: str, up: str) -> np.ndarray:
    """(3, 3): head frame -> a frame where the face looks along `face` and the crown points along `up`."""
    back, top = -np.array(AXIS[face]), np.array(AXIS[up])
    return np.stack([np.cross(back, top), back, top], axis=1)


def orientations(face: str = "auto", up: str = "auto") -> list[tuple[str, str]]:
    """The (face, up) pairs of the 24 axis orientations that agree with what is given. Raises HeadError if none does."""
    axes = [axis for axis in AXES if axis != "auto"]
    pairs = [(f, u) for f in axes for u in axes if f[1] != u[1] and face in ("auto", f) and up in ("auto", u)]
    if not pairs:
        raise HeadError(f"the face ({face}) and up ({up}) axes must be at right angles; change head.face or head.up")
    return pairs


def register_head(
    template: HeadMesh,
    knots: np.ndarray,
    solid_points: np.ndarray,
    density: BrickVolume,
    hair_level: float,
    settings: HeadSettings,
    progress: Progress = silent,
) -> Registration:
    """Fit the template (head frame, mm) to a scanned wig.

    knots: (K, 3) points of knots and hairnet, scan frame, mm; up to 40 % may be something else. solid_points: (S, 3) on the
    mannequin's surface, may be empty. density, hair_level: the hair, which falls down and leaves the face free.
    Where `settings.place` says where the head stands, it is only refined. Raises HeadError where there are too few points,
    or they lie on no head.
    """
    solid = np.asarray(solid_points, np.float64).reshape(-1, 3)
    hair, mass = _hair_mass(density, hair_level)
    candidates = orientations(settings.face, settings.up)
    knots, start = np.asarray(knots, np.float64).reshape(-1, 3), placed_by_hand(settings.place)
    return _registered(template, knots, solid, hair, mass, candidates, False, progress, start)


def fit_to_roots(
    template: HeadMesh, roots: np.ndarray, face: str = "-y", up: str = "+z", progress: Progress = silent
) -> Registration:
    """Fit the template to the root points (N, 3), mm, of strands that come without a head; `face`, `up` as in the settings.

    Raises HeadError where they are too few, or show no head.
    """
    nothing = np.zeros((0, 3))
    roots = np.asarray(roots, np.float64).reshape(-1, 3)
    if len(roots) < LEAST_POINTS:
        raise HeadError(f"{len(roots)} strands are too few to fit a head to, {LEAST_POINTS} are needed: give the head's mesh")
    return _registered(template, roots, nothing, nothing, np.zeros(0), orientations(face, up), True, progress)


def placed_by_hand(text: str) -> np.ndarray | None:
    """The (4, 4) matrix of `HeadSettings.place`, None where it is empty. Raises HeadError for what is no similarity."""
    if not text.strip():
        return None
    try:
        matrix = np.array([float(word) for word in text.replace(",", " ").split()]).reshape(4, 4)
    except ValueError:
        raise HeadError("head.place must be the 16 numbers of a matrix, or empty; place the head again") from None
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not 0.2 < scale < 5.0 or not np.allclose(matrix[:3, :3].T @ matrix[:3, :3] / scale**2, np.eye(3), atol=1e-3):
        raise HeadError("head.place must be a rotation, a shift and one scale of 0.2 to 5; place the head again")
    return matrix


def _registered(template, knots, solid_points, hair, mass, candidates, only_roots, progress, start=None):
    finite = np.isfinite(knots).all(axis=1)
    knots = knots[finite]
    if len(knots) < LEAST_POINTS:
        raise HeadError(
            f"only {len(knots)} points of knots or hairnet were found, at least {LEAST_POINTS} are needed to place the head. "
            "Set scan.knots lower, so that the hairnet and the roots are above it"
        )
    progress(0, 1)
    cloud = _thinned(knots)
    surface = scalp_surface(cloud.points, cloud.weights)
    near = np.abs(surface.distance(cloud.points)) < SCALP_BAND
    scalp_cloud = _Cloud(cloud.points[near], cloud.weights[near])
    solid = _thinned(solid_points)
    head = Head(template)
    progress(0.05, 1)
    matrix, certainty, (face, up), warnings = _pose(
        head, scalp_cloud, solid, hair, mass, candidates, part(progress, 0.05, 0.4), start
    )
    vertices = _fitted(head, matrix, scalp_cloud, solid, only_roots, part(progress, 0.4, 0.9))
    mesh, grown = _with_grown_scalp(template, vertices, matrix, scalp_cloud)
    mesh = mesh.transformed(matrix)
    progress(0.95, 1)
    distance = TriangleTree.build(mesh.vertices, mesh.faces[mesh.scalp_faces]).nearest(scalp_cloud.points)[0]
    on = distance < INLIER
    residual = float(np.median(distance[distance < SCALP_BAND])) if (distance < SCALP_BAND).any() else float("inf")
    tally = {
        "knot and net points": len(knots),
        "kept after thinning": len(cloud),
        "left out: far from the scalp's surface": int((~near).sum()),
        "left out: no scalp of the fitted head near": int((~on).sum()),
        "used: on the fitted scalp": int(on.sum()),
        "mannequin surface points": len(solid_points),
        "vertices added to the scalp": grown,
    }
    progress(1, 1)
    return Registration(mesh, matrix, certainty, face, up, residual, tally, (*warnings, *template.warnings))


def _thinned(points) -> _Cloud:
    """At most PER_CELL points of each cell, chosen by a fixed shuffle; each cell weighs the same."""
    points = np.asarray(points, np.float64)
    if not len(points):
        return _Cloud(points.reshape(-1, 3), np.zeros(0))
    cell = np.floor((points - points.min(axis=0)) / CELL).astype(np.int64)
    size = cell.max(axis=0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    shuffled = np.random.default_rng(0).permutation(len(points))
    order = shuffled[np.argsort(key[shuffled], kind="stable")]
    sorted_key = key[order]
    start = np.flatnonzero(np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]]))
    count = np.diff(np.append(start, len(order)))
    rank = np.arange(len(order)) - np.repeat(start, count)
    kept = rank < PER_CELL
    weight = np.repeat(1.0 / np.minimum(count, PER_CELL), count)
    return _Cloud(points[order[kept]], weight[kept])


def _hair_mass(density, hair_level):
    """(B, 3) brick centres in the scan frame and (B,) hair voxels in each."""
    count = np.empty(len(density.bricks), np.int64)
    for start in range(0, len(count), 2048):
        part = slice(start, start + 2048)
        count[part] = (density.bricks[part] > hair_level).sum(axis=(1, 2, 3))
    centres = density.to_scan(density.brick_index * 16 + 7.5)
    return centres[count > 0], count[count > 0].astype(np.float64)


def _pose(head, knots, solid, hair, mass, candidates, progress, placed=None):
    """The best similarity head -> scan over the candidates, or from `placed`: (matrix, certainty, (face, up), warnings)."""
    template = head.sample_scalp(SEARCH_POINTS // 2, 0)
    template_centre, template_radius, _ = scalp_sphere(template.position, np.ones(len(template)))
    centre, radius, _ = scalp_sphere(knots.points, knots.weights)
    scale = float(np.clip(radius / template_radius, *SCALES))
    few, few_solid = knots.some(SEARCH_POINTS), solid.some(SEARCH_POINTS)
    tree = cKDTree(few.points)
    solid_tree = cKDTree(few_solid.points) if len(few_solid) else None
    outer = _outer_samples(head.mesh)
    tried = []
    if placed is not None:
        turn = placed[:3, :3] / np.cbrt(np.linalg.det(placed[:3, :3]))
        candidates = [max(orientations(), key=lambda pair: np.trace(axis_rotation(*pair).T @ turn))]
    for number, (face, up) in enumerate(candidates):
        matrix = np.eye(4)
        matrix[:3, :3] = axis_rotation(face, up) * scale
        matrix[:3, 3] = centre - matrix[:3, :3] @ template_centre
        if placed is not None:
            matrix = placed
        start = matrix
        for reach in SEARCH_REACHES:
            matrix = _icp_step(head, template, matrix, few, tree, few_solid, reach)
        score = _score(head, template, outer, matrix, start, few, tree, few_solid, solid_tree, hair, mass)
        tried.append((score, -number, matrix))
        progress(number + 1, len(candidates) + 1)
    tried.sort(key=lambda item: item[:2], reverse=True)
    score, number, matrix = tried[0]
    face, up = candidates[-number]
    certainty, warnings = 1.0, []
    if len(tried) > 1:
        certainty = float(1.0 - np.exp(-(score - tried[1][0]) / CERTAIN))
        if certainty < 0.5:
            other = candidates[-tried[1][1]]
            warnings.append(
                f"the head's direction is uncertain ({certainty:.0%}): taken as face {face}, up {up}; face {other[0]}, up "
                f"{other[1]} is nearly as good. Look at it, and set head.face and head.up where it is wrong"
            )
    many, many_solid = knots.some(FINE_POINTS), solid.some(FINE_POINTS)
    tree = cKDTree(many.points)
    for reach in FINE_REACHES:
        matrix = _icp_step(head, template, matrix, many, tree, many_solid, reach)
    return matrix, certainty, (face, up), warnings


def _outer_samples(mesh):
    """(M, 3) vertices of the template's skin, a few hundred, above the neck's lower end."""
    low = mesh.vertices[mesh.scalp, 2].min() - 60.0
    kept = np.flatnonzero(mesh.vertices[:, 2] > low)
    return mesh.vertices[kept[:: max(len(kept) // 600, 1)]].astype(np.float64)


def _into(matrix, points):
    """Scan frame -> head frame."""
    return (points - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T


def _out_of(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _weights(residual, reach):
    """Geman-McClure: 1 at 0, a quarter at `reach`."""
    return 1.0 / (1.0 + (residual / reach) ** 2) ** 2


def _icp_step(head, template, matrix, knots, tree, solid, reach):
    """One Gauss-Newton step of the similarity towards the scan's points, in the head frame."""
    rows, wanted, weights = [], [], []

    def add(points, target, normal, weight, along):
        """The points move; residuals across (and, by `along`, also along) the surface."""
        apart = target - points
        directions = [(normal, 1.0)] + ([(axis, along) for axis in np.eye(3)] if along else [])
        for direction, factor in directions:
            direction = np.broadcast_to(direction, points.shape)
            rows.append(
                np.concatenate(
                    [np.cross(points, direction), direction, (points * direction).sum(axis=1, keepdims=True)], axis=1
                )
            )
            wanted.append((apart * direction).sum(axis=1))
            weights.append(weight * factor)

    local = _into(matrix, knots.points)
    nearest = head.closest_scalp(local)
    weight = knots.weights * _weights(nearest.distance, reach)
    add(local, nearest.position.astype(np.float64), nearest.normal, weight / max(weight.sum(), 1e-9), ALONG)
    # the template's own points against their nearest knots
    position = template.position.astype(np.float64)
    distance, index = tree.query(_out_of(matrix, position))
    weight = _weights(distance, reach) * COVERAGE / len(position)
    add(_into(matrix, knots.points[index]), position, template.normal, weight, ALONG)
    if len(solid):
        local = _into(matrix, solid.points)
        distance, position, normal = _on_skin(head, local)
        weight = solid.weights * _weights(distance, reach)
        add(local, position, normal, weight / max(weight.sum(), 1e-9), 0.0)
    rows, wanted, weights = np.concatenate(rows), np.concatenate(wanted), np.concatenate(weights)
    # a breath of damping: a sphere's rotation is free, and a step is small
    damping = np.diag([5.0, 5.0, 5.0, 1e-4, 1e-4, 1e-4, 5.0])
    normal = np.einsum("ij,i,ik->jk", rows, weights, rows) + damping
    step = np.linalg.solve(normal, np.einsum("ij,i,i->j", rows, weights, wanted))
    return _moved(matrix, np.round(step, 9))


def _moved(matrix, step):
    """The similarity after the points moved by `step` (rotation, translation, log scale) in the head frame."""
    angle = np.linalg.norm(step[:3])
    axis = step[:3] / max(angle, 1e-12)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    now = np.cbrt(np.linalg.det(matrix[:3, :3]))
    factor = now / np.clip(now / np.exp(step[6]), *SCALES)
    moving = np.eye(4)
    moving[:3, :3], moving[:3, 3] = rotation * factor, step[3:6]
    return matrix @ np.linalg.inv(moving)


def _on_skin(head, points):
    """(distance, closest point, smooth normal) on the whole head mesh."""
    distance, face, bary = head.skin_tree.nearest(points)
    corner = head.mesh.faces[face]
    position = (head.mesh.vertices[corner] * bary[:, :, None]).sum(axis=1)
    normal = (head.normals[corner] * bary[:, :, None]).sum(axis=1)
    return distance, position, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _score(head, template, outer, matrix, start, knots, tree, solid, solid_tree, hair, mass):
    """How well a pose explains the scan: shares of matching points, hair mass where hair is, little tilt; higher is better."""

    def matching(distance, weights):
        return float((np.exp(-((distance / MATCH) ** 2)) * weights).sum() / max(weights.sum(), 1e-9))

    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    score = matching(head.closest_scalp(_into(matrix, knots.points)).distance * scale, knots.weights)
    score += matching(tree.query(_out_of(matrix, template.position.astype(np.float64)))[0], np.ones(len(template)))
    if len(solid):
        score += matching(head.skin_tree.nearest(_into(matrix, solid.points))[0] * scale, solid.weights)
        score += matching(solid_tree.query(_out_of(matrix, outer))[0], np.ones(len(outer)))
    if len(hair):
        local = _into(matrix, hair)
        middle = head.mesh.vertices[head.mesh.scalp].mean(axis=0)
        size = 0.5 * np.ptp(head.mesh.vertices[head.mesh.scalp], axis=0)
        relative = (local - middle) / size
        share = mass / mass.sum()
        before = (relative[:, 1] < -0.6) & (np.abs(relative[:, 0]) < 0.6) & (relative[:, 2] < -0.3)
        score -= 0.5 * float((share * before).sum())
        score -= 0.15 * float(np.tanh((share * relative[:, 2]).sum()))
    turned = (matrix[:3, :3].T @ start[:3, :3]) / (scale * np.cbrt(np.linalg.det(start[:3, :3])))
    tilt = np.degrees(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)))
    return score - 0.2 * (tilt / TILT) ** 2


def _fitted(head, matrix, knots, solid, only_roots, progress):
    """(V, 3) float64 vertices in the head frame: the template bent smoothly onto the points."""
    mesh = head.mesh
    vertices = mesh.vertices.astype(np.float64)
    patch = mesh.faces[_near_scalp(head)]
    local, local_solid = _into(matrix, knots.points), _into(matrix, solid.points)
    knot_weights, solid_weights = knots.weights * CELL**2, solid.weights * CELL**2
    patch_tree, skin_tree = TriangleTree.build(vertices, patch), TriangleTree.build(vertices, mesh.faces)

    def targets(vertices, reach, every=1):
        """Where the points want the surface: (corners, bary, displacement across it, weights)."""
        normals = vertex_normals(vertices, mesh.faces).astype(np.float64)
        parts = []
        for points, weights, faces, tree, outward, inward in (
            (local, knot_weights, patch, patch_tree, reach, INWARD * reach),
            (local_solid, solid_weights, mesh.faces, skin_tree, 2.0 * reach, 2.0 * reach),
        ):
            if not len(points):
                continue
            points, weights = points[::every], weights[::every] * every
            distance, face, bary = tree.refitted(vertices, faces).nearest(points)
            corner = faces[face]
            normal = (normals[corner] * bary[:, :, None]).sum(axis=1)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
            found = (vertices[corner] * bary[:, :, None]).sum(axis=1)
            across = ((points - found) * normal).sum(axis=1)
            aside = np.sqrt(np.maximum(distance**2 - across**2, 0.0))
            weight = weights * _weights(across, np.where(across < 0.0, inward, outward)) * _weights(aside, ASIDE + reach)
            parts.append((corner, bary, across[:, None] * normal, weight))
        return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))

    rounds, done = sum(len(level[3]) for level in LEVELS) + len(SKIN_ROUNDS), 0
    for spacing, bending, slope, reaches in LEVELS:
        rest = vertices
        lattice = Lattice.over(rest, spacing)
        coefficients = np.zeros((lattice.rows.shape[1], 3))
        for reach in reaches:
            every = max(min(int(spacing / LEVELS[-1][0]), max(len(local), len(local_solid)) // 3000), 1)
            corner, bary, across, weight = targets(vertices, max(reach, ROOTS_REACH) if only_roots else reach, every)
            wanted = across + ((vertices - rest)[corner] * bary[:, :, None]).sum(axis=1)
            blend = _blend(corner, bary, len(rest))
            coefficients = lattice.fitted(blend, wanted, weight, bending, slope, coefficients)
            vertices = np.round(rest + lattice.rows @ coefficients, 6)
            done += 1
            progress(done, rounds)
    # last, what is finer than the lattice, in the scalp's own vertices, fading out over the skin around
    slope = _mesh_slope(mesh.faces, len(vertices)) * (ROOTS_STIFFNESS if only_roots else SKIN_STIFFNESS)
    held = diags(1e-3 + 1.0 * (~_touched(patch, len(vertices))))
    rest, moved = vertices, np.zeros_like(vertices)
    for reach in SKIN_ROUNDS:
        corner, bary, across, weight = targets(vertices, max(reach, ROOTS_REACH) if only_roots else reach)
        blend = _blend(corner, bary, len(rest))
        wanted = across + blend @ moved
        moved = least_squares(blend, wanted, weight, slope + held, moved)
        vertices = np.round(rest + moved, 6)
        done += 1
        progress(done, rounds)
    return np.round(vertices, 4)


def _touched(faces, count):
    touched = np.zeros(count, bool)
    touched[faces] = True
    return touched


def _mesh_slope(faces, count):
    """(V, V) sparse: the integral of a vertex function's squared slope over an even mesh."""
    pairs, _ = edges(faces)
    a, b = pairs.T
    # 1 / sqrt(3) is the cotangent weight of equilateral triangles
    weight = np.full(len(a), 1.0 / np.sqrt(3.0))
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
    return coo_matrix((np.concatenate([weight, weight, -weight, -weight]), (rows, columns)), (count, count)).tocsr()


def _blend(corner, bary, count):
    """(M, V) sparse rows that blend vertices into points."""
    row = np.repeat(np.arange(len(corner)), corner.shape[1])
    return coo_matrix((bary.ravel(), (row, corner.ravel())), shape=(len(corner), count)).tocsr()


def _near_scalp(head):
    """(F,) bool: the scalp's faces and those within SURROUNDINGS of it that look the same way (ears don't)."""
    mesh = head.mesh
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    nearest = head.closest_scalp(middle, SURROUNDINGS)
    normal = head.normals[mesh.faces].mean(axis=1)
    alike = (normal * np.nan_to_num(nearest.normal)).sum(axis=1) > 0.6
    on_scalp = np.zeros(len(mesh.faces), bool)
    on_scalp[mesh.scalp_faces] = True
    return on_scalp | (nearest.valid & alike)


def _with_grown_scalp(template, vertices, matrix, knots):
    """The template at the fitted `vertices` (head frame), its scalp grown to skin that is full of knots; and by how many."""
    mesh = template.with_vertices(vertices)
    points = _into(matrix, knots.points)
    tree = TriangleTree.build(mesh.vertices, mesh.faces)
    on_head = tree.nearest(points)[0] < INLIER
    points, weights = points[on_head], knots.weights[on_head]
    if not len(points):
        return mesh, 0
    scalp_points = mesh.vertices[mesh.scalp].astype(np.float64)
    near = cKDTree(points)
    # weight of knots in a ball around each vertex, against the scalp's usual
    usual = np.median(_ball_weight(near, weights, scalp_points[:: max(len(scalp_points) // 500, 1)]))
    border = np.flatnonzero(~mesh.scalp)
    border = border[cKDTree(scalp_points).query(mesh.vertices[border], distance_upper_bound=GROWTH)[0] < GROWTH]
    dense = np.zeros(len(mesh.vertices))
    dense[mesh.scalp] = 1.0
    dense[border] = _ball_weight(near, weights, mesh.vertices[border]) > GROWTH_DENSITY * usual
    pairs, _ = edges(mesh.faces)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(dense))
    # three rounds of averaging: no teeth, no lone vertices
    for _ in range(3):
        dense = 0.5 * dense + 0.5 * np.bincount(both[:, 0], dense[both[:, 1]], len(dense)) / np.maximum(degree, 1)
    scalp = mesh.scalp | (dense > 0.5)
    patch = np.flatnonzero(scalp[mesh.faces].all(axis=1))
    kept = largest_component(mesh.faces[patch], np.ones(len(patch)))
    scalp = np.zeros(len(scalp), bool)
    scalp[mesh.faces[patch[kept]]] = True
    scalp |= mesh.scalp
    added = int(np.count_nonzero(scalp & ~mesh.scalp))
    if not added:
        return mesh, 0
    try:
        return unwrap(through_skin(replace(mesh, scalp=scalp))), added
    except HeadError:
        # the new outline can't be laid flat: the template's own can
        return mesh, 0


def _ball_weight(tree, weights, positions):
    near = tree.query_ball_point(positions, GROWTH_RADIUS)
    count = np.array([len(rows) for rows in near])
    rows = np.concatenate([np.asarray(r, np.int64) for r in near]) if count.sum() else np.zeros(0, np.int64)
    return np.bincount(np.repeat(np.arange(len(count)), count), weights[rows], len(count))
