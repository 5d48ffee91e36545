"""The scalp's texture coordinates: a low-distortion flattening of the scalp patch (paper 3.3.1, Fig. 4).

Harmonic map to a disc (Tutte 1963, Floater 1997), then as-rigid-as-possible local/global rounds (Liu et al. 2008, "A
local/global approach to mesh parameterization").
On the built-in head, by `distortion`: areas within 15 %, angles within 5 degrees on average.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from ..errors import HeadError
from .mesh import HeadMesh, boundary_loops, checked, edges, face_areas, largest_component

ROUNDS = 60
"""Local/global rounds: the energy changes by under 1e-3 a round after about 40."""
MARGIN = 0.01
"""Free rim of the texture around the scalp, so that filtering never reads past its edge."""
ORIENTED = 1e-9


@dataclass(frozen=True)
class Distortion:
    """How far a flattening is from an isometry, weighted by area; 0 is perfect.

    area: mean of |area ratio - 1|; area_worst: its 99th percentile. angle: mean over faces of the largest change of any
    direction's angle, degrees (asin((s1 - s2) / (s1 + s2)) for singular values s1 >= s2); flipped: faces turned over.
    """

    area: float
    area_worst: float
    angle: float
    flipped: int


def unwrap(mesh: HeadMesh) -> HeadMesh:
    """`mesh` with `uv` flattened from its scalp: the same scale along u and v and over the whole scalp, into [0, 1]^2.

    v grows to the front (-y of the head frame), u to the wearer's right: seen from above with the face up, the texture is not
    mirrored. Of several scalp pieces the largest is kept; holes are closed for the flattening only.
    Raises HeadError where the scalp can't be flattened: none, or with a handle.
    """
    mesh, patch = scalp_patch(mesh)
    used, local = np.unique(mesh.faces[patch], return_inverse=True)
    local = local.reshape(-1, 3)
    positions = mesh.vertices[used].astype(np.float64)
    closed_positions, closed_faces, rim = _without_holes(positions, local, mesh.name)
    flat = _as_rigid_as_possible(closed_positions, closed_faces, _disc(closed_positions, closed_faces, rim, mesh.name))
    flat = _oriented(positions, local, flat[: len(positions)])
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = (1.0 - 2.0 * MARGIN) / max((high - low).max(), 1e-12)
    uv = np.full((len(mesh.vertices), 2), np.nan, np.float32)
    uv[used] = (flat - 0.5 * (low + high)) * scale + 0.5
    return replace(mesh, uv=uv)


def scalp_patch(mesh: HeadMesh) -> tuple[HeadMesh, np.ndarray]:
    """The mesh with only the largest piece of its scalp marked, and the (G,) indices of that piece's triangles."""
    checked(mesh)
    patch = mesh.scalp_faces
    areas = face_areas(mesh.vertices, mesh.faces[patch])
    if areas.sum() <= 0.0:
        raise HeadError(f"{mesh.name}: the scalp has no area; its faces are degenerate")
    kept = largest_component(mesh.faces[patch], areas)
    warnings = mesh.warnings
    if not kept.all():
        share = areas[~kept].sum() / areas.sum()
        warnings += (f"the scalp has several pieces; the largest is used, the others ({share:.0%} of the area) are not",)
    scalp = np.zeros(len(mesh.vertices), bool)
    scalp[mesh.faces[patch[kept]]] = True
    uv = np.where(scalp[:, None], mesh.uv, np.nan)
    mesh = replace(mesh, scalp=scalp, uv=uv, warnings=warnings)
    return mesh, mesh.scalp_faces


def distortion(mesh: HeadMesh) -> Distortion:
    """How far the scalp's uv is from an isometry (up to one scale, and either handedness as a whole)."""
    faces = mesh.faces[mesh.scalp_faces]
    first, second, signed = _singular_values(mesh.vertices, faces, mesh.uv)
    areas = face_areas(mesh.vertices, faces)
    weight = areas / areas.sum()
    turned = np.sign((signed * weight).sum())
    ratio = first * second
    ratio = ratio / (ratio * weight).sum()
    error = np.abs(ratio - 1.0)
    order = np.argsort(error)
    worst = error[order][np.searchsorted(np.cumsum(weight[order]), 0.99).clip(max=len(order) - 1)]
    angle = np.degrees(np.arcsin(np.clip((first - second) / np.maximum(first + second, 1e-30), 0.0, 1.0)))
    return Distortion(
        float((error * weight).sum()), float(worst), float((angle * weight).sum()), int((signed * turned <= 0).sum())
    )


def _singular_values(vertices, faces, uv):
    local, _ = _local_frames(np.asarray(vertices, np.float64), faces)
    flat = np.asarray(uv, np.float64)[faces]
    source = np.stack([local[:, 1] - local[:, 0], local[:, 2] - local[:, 0]], axis=-1)
    target = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=-1)
    jacobian = target @ np.linalg.pinv(source)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return values[:, 0], values[:, 1], np.linalg.det(jacobian)


def _local_frames(positions, faces):
    """Each triangle laid flat: (F, 3, 2) corners, and (F, 3) cotangents of the angles at them."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    length = np.maximum(np.linalg.norm(ab, axis=1), 1e-12)
    along = (ab * ac).sum(axis=1) / length
    across = np.linalg.norm(np.cross(ab, ac), axis=1) / length
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0], flat[:, 2, 0], flat[:, 2, 1] = length, along, across
    cotangents = np.empty((len(faces), 3))
    for corner in range(3):
        u = flat[:, (corner + 1) % 3] - flat[:, corner]
        v = flat[:, (corner + 2) % 3] - flat[:, corner]
        cross = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
        cotangents[:, corner] = (u * v).sum(axis=1) / np.maximum(cross, 1e-9)
    return flat, np.clip(cotangents, 0.02, 50.0)


def _without_holes(positions, faces, name):
    """The patch with all boundary loops but the longest closed by a fan: (positions, faces, the rim that is left)."""
    loops = boundary_loops(faces)
    if not loops:
        raise HeadError(f"{name}: the scalp is closed on itself; it must be a patch of the head with an open edge")
    around = [np.linalg.norm(np.diff(positions[np.append(loop, loop[0])], axis=0), axis=1).sum() for loop in loops]
    rim = loops.pop(int(np.argmax(around)))
    for loop in loops:
        centre = len(positions)
        positions = np.concatenate([positions, positions[loop].mean(axis=0, keepdims=True)])
        fan = np.stack([np.roll(loop, -1), loop, np.full(len(loop), centre)], axis=1)
        faces = np.concatenate([faces, fan])
    pairs, count = edges(faces)
    if len(np.unique(faces)) - len(pairs) + len(faces) != 1 or count.max() > 2:
        raise HeadError(
            f"{name}: the scalp can't be laid flat, it has a handle, a fold onto itself or pieces that touch in one point; "
            "mark a simple cap of faces as 'scalp'"
        )
    return positions, faces, rim


def _laplacian(faces, weights, count):
    """Symmetric sparse matrix from the weight (F, 3) of the edge across from each corner."""
    rows, columns, values = [], [], []
    for corner in range(3):
        a, b, w = faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3], weights[:, corner]
        rows += [a, b, a, b]
        columns += [a, b, b, a]
        values += [w, w, -w, -w]
    return coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, count)).tocsc()


def _disc(positions, faces, rim, name):
    """(V, 2): the harmonic map onto a disc of the patch's area, its rim by arc length; one-to-one for positive weights."""
    count = len(positions)
    steps = np.linalg.norm(positions[np.roll(rim, -1)] - positions[rim], axis=1)
    angle = 2.0 * np.pi * np.concatenate([[0.0], np.cumsum(steps)[:-1]]) / steps.sum()
    radius = np.sqrt(face_areas(positions, faces).sum() / np.pi)
    flat = np.zeros((count, 2))
    flat[rim] = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = np.setdiff1d(np.unique(faces), rim)
    if len(inner):
        _, cotangents = _local_frames(positions, faces)
        matrix = _laplacian(faces, cotangents, count)
        solver = splu(matrix[inner][:, inner].tocsc())
        flat[inner] = solver.solve(-(matrix[inner][:, rim] @ flat[rim]))
    return flat


def _as_rigid_as_possible(positions, faces, flat):
    """The flattening whose triangles are closest to rotations of the patch's own (least squares, cotangent weights)."""
    count = len(positions)
    local, cotangents = _local_frames(positions, faces)
    matrix = _laplacian(faces, cotangents, count)
    # one vertex is held: the energy does not know translations
    solver = splu(matrix[1:, 1:].tocsc())
    for _ in range(ROUNDS):
        covariance = np.zeros((len(faces), 2, 2))
        for corner in range(3):
            i, j = (corner + 1) % 3, (corner + 2) % 3
            apart = flat[faces[:, i]] - flat[faces[:, j]]
            source = local[:, i] - local[:, j]
            covariance += cotangents[:, corner, None, None] * apart[:, :, None] * source[:, None, :]
        # the closest rotation in the plane, in closed form
        cosine = covariance[:, 0, 0] + covariance[:, 1, 1]
        sine = covariance[:, 1, 0] - covariance[:, 0, 1]
        length = np.maximum(np.hypot(cosine, sine), 1e-30)
        cosine, sine = cosine / length, sine / length
        right = np.zeros((count, 2))
        for corner in range(3):
            i, j = (corner + 1) % 3, (corner + 2) % 3
            source = (local[:, i] - local[:, j]) * cotangents[:, corner, None]
            turned = np.stack(
                [cosine * source[:, 0] - sine * source[:, 1], sine * source[:, 0] + cosine * source[:, 1]], axis=1
            )
            for axis in range(2):
                right[:, axis] += np.bincount(faces[:, i], turned[:, axis], count)
                right[:, axis] -= np.bincount(faces[:, j], turned[:, axis], count)
        flat = np.concatenate([np.zeros((1, 2)), solver.solve(right[1:])])
    return flat


def _oriented(positions, faces, flat):
    """The flattening turned so that v follows the front (-y), by the rotation that fits best over all triangles."""
    one, two = flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]]
    cross = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    if cross.sum() < 0:
        flat = flat * [-1.0, 1.0]
    middle = flat - flat.mean(axis=0)
    around = positions[:, :2] - positions[:, :2].mean(axis=0)
    # seen from above: u to the wearer's right (-x), v to the front (-y)
    wanted = -around
    cosine = (middle * wanted).sum()
    sine = (middle[:, 0] * wanted[:, 1] - middle[:, 1] * wanted[:, 0]).sum()
    length = np.hypot(cosine, sine)
    if length < ORIENTED:
        return middle
    cosine, sine = cosine / length, sine / length
    return middle @ np.array([[cosine, sine], [-sine, cosine]])
