"""HeadMesh: the head as a triangle mesh with a scalp region and the scalp's texture coordinates (paper 3.3.1, Fig. 4)."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..errors import HeadError

SCALP = "scalp"
"""Name of the group, object or material that marks the scalp in an OBJ file (any case)."""
OWN_FILE = "# CT2Hair head, millimetres"
"""First line of the OBJ files that `HeadMesh.save` writes: their coordinates are read back as they are."""


@dataclass(frozen=True)
class HeadMesh:
    """A head, mm: in the head frame (x to the wearer's left, y to the back, z up) or, registered, in the scan frame.

    vertices: (V, 3) float32. faces: (F, 3) int32 triangles, outward (counter-clockwise from outside).
    scalp: (V,) bool; a triangle is scalp where all its vertices are. uv: (V, 2) float32 in [0, 1]^2, NaN off the scalp.
    polygon_offsets, polygon_vertices: (P + 1,) and (L,) int32: the polygons that the triangles came from, quads say, in the
        order and with the vertices of the source; None where the triangles are the polygons.
    name: where the mesh came from, for messages. warnings: what a reader had to assume.
    """

    vertices: np.ndarray
    faces: np.ndarray
    scalp: np.ndarray
    uv: np.ndarray
    polygon_offsets: np.ndarray | None = None
    polygon_vertices: np.ndarray | None = None
    name: str = "head"
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, np.float32).reshape(-1, 3)
        faces = np.ascontiguousarray(self.faces, np.int32).reshape(-1, 3)
        scalp = np.ascontiguousarray(self.scalp, bool)
        uv = np.ascontiguousarray(self.uv, np.float32).reshape(-1, 2)
        if len(scalp) != len(vertices) or len(uv) != len(vertices):
            raise ValueError(f"scalp and uv need one row for each of {len(vertices)} vertices: {len(scalp)}, {len(uv)}")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(f"faces must name the vertices 0 to {len(vertices) - 1}, got {faces.min()} to {faces.max()}")
        for key, value in (("vertices", vertices), ("faces", faces), ("scalp", scalp), ("uv", uv)):
            object.__setattr__(self, key, value)

    @property
    def scalp_faces(self) -> np.ndarray:
        """(G,) int64: the triangles whose three vertices are scalp."""
        return np.flatnonzero(self.scalp[self.faces].all(axis=1))

    @property
    def polygons(self) -> tuple[np.ndarray, np.ndarray]:
        """(offsets (P + 1,), vertices (L,)) int32: the source's polygons, or the triangles where there are none."""
        if self.polygon_offsets is None:
            return np.arange(len(self.faces) + 1, dtype=np.int32) * 3, self.faces.ravel()
        return self.polygon_offsets, self.polygon_vertices

    @property
    def normals(self) -> np.ndarray:
        """(V, 3) float32 unit vertex normals, outward, weighted by the faces' angles."""
        return vertex_normals(self.vertices, self.faces)

    def _fanned_polygons(self) -> tuple[np.ndarray, np.ndarray]:
        """`polygons`, quads turned so that a fan from their first corner gives the very triangles of this mesh."""
        offsets, corners = self.polygons
        start = offsets[:-1][np.diff(offsets) == 4]
        if not len(start):
            return offsets, corners
        triangle = (start - 2 * np.searchsorted(offsets, start))[:, None]
        pair = self.faces[triangle + [0, 1]].reshape(-1, 6)
        quad = corners[start[:, None] + np.arange(4)]
        # a corner on the cut is in both triangles
        on_cut = (pair[:, :, None] == quad[:, None, :]).sum(axis=1) == 2
        first = np.where(on_cut[:, 0] & on_cut[:, 2], 0, 1)
        corners = corners.copy()
        corners[start[:, None] + np.arange(4)] = np.take_along_axis(quad, (first[:, None] + np.arange(4)) % 4, axis=1)
        return offsets, corners

    def transformed(self, matrix: np.ndarray) -> HeadMesh:
        """The mesh under a 4 x 4 matrix acting on column vectors; a mirroring one keeps the faces outward."""
        matrix = np.asarray(matrix, np.float64)
        moved = replace(self, vertices=(self.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32))
        return moved.flipped() if np.linalg.det(matrix[:3, :3]) < 0 else moved

    def flipped(self) -> HeadMesh:
        """The mesh with every face turned round."""
        offsets, corners = self.polygons
        turned = corners.copy()
        for start, end in pairwise(offsets.tolist()):
            turned[start + 1 : end] = corners[start + 1 : end][::-1]
        kept = None if self.polygon_offsets is None else turned
        return replace(self, faces=self.faces[:, [0, 2, 1]], polygon_vertices=kept)

    def with_vertices(self, vertices: np.ndarray) -> HeadMesh:
        """The same mesh at new positions (V, 3), mm."""
        return replace(self, vertices=vertices)

    def save(self, path: str | os.PathLike) -> None:
        """Write an OBJ in mm: polygons, a `vt` for each scalp vertex, group and material 'scalp' and 'skin'.

        Positions are written in the mesh's own frame with 9 digits, so that float32 comes back bit for bit. The file is
        written beside the target and renamed: never half a file.
        """
        path = Path(path)
        offsets, corners = self._fanned_polygons()
        texture = np.full(len(self.vertices), -1)
        known = np.flatnonzero(np.isfinite(self.uv).all(axis=1))
        texture[known] = np.arange(len(known))
        lines = [f"{OWN_FILE}; group 'scalp' carries the scalp's texture coordinates"]
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in self.vertices.tolist()]
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in self.uv[known].tolist()]
        parts = {SCALP: [], "skin": []}
        for start, end in pairwise(offsets.tolist()):
            polygon = corners[start:end]
            is_scalp = self.scalp[polygon].all()
            if is_scalp and (texture[polygon] >= 0).all():
                text = " ".join(f"{v + 1}/{texture[v] + 1}" for v in polygon.tolist())
            else:
                text = " ".join(str(v + 1) for v in polygon.tolist())
            parts[SCALP if is_scalp else "skin"].append(f"f {text}")
        for part, faces in parts.items():
            lines += [f"g {part}", f"usemtl {part}", *faces]
        beside = path.with_name(f".{path.name}.part")
        try:
            beside.write_text("\n".join(lines) + "\n", encoding="utf-8")
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) float32: unit normals at the vertices, each face weighted by its angle there; 0 at lone vertices."""
    corners = np.asarray(vertices, np.float64)[faces]
    normals = face_normals(vertices, faces)
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], angle * normals[:, axis], len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.maximum(length, 1e-30)).astype(np.float32)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) float64 unit normals; 0 for a face of no area."""
    corners = np.asarray(vertices, np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) float64 areas, mm^2."""
    corners = np.asarray(vertices, np.float64)[faces]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undirected edges (E, 2), sorted, and (E,) the number of faces on each."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The boundary of a patch as closed loops of vertices, each along the direction of its faces' edges.

    A vertex where two loops meet closes the first one there, so that every loop is simple.
    """
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    size = directed.max(initial=0) + 1
    key = directed[:, 0] * size + directed[:, 1]
    opposite = directed[:, 1] * size + directed[:, 0]
    open_edges = directed[~np.isin(key, opposite)]
    following: dict[int, list[int]] = {}
    for a, b in open_edges.tolist():
        following.setdefault(a, []).append(b)
    loops = []
    for start in sorted(following):
        while following.get(start):
            walk, position = [start], {start: 0}
            current = start
            while following.get(current):
                current = following[current].pop()
                if current in position:
                    loops.append(np.array(walk[position[current] :]))
                    for vertex in walk[position[current] + 1 :]:
                        del position[vertex]
                    walk = walk[: position[current] + 1]
                    if current == start:
                        break
                else:
                    position[current] = len(walk)
                    walk.append(current)
    return [loop for loop in loops if len(loop) >= 3]


def largest_component(faces: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(F,) bool: the faces of the edge-connected component with the largest sum of `weight` (F,)."""
    if not len(faces):
        return np.zeros(0, bool)
    labels = components(faces)
    return labels == np.argmax(np.bincount(labels, weight))


def components(faces: np.ndarray) -> np.ndarray:
    """(F,) int32 labels of the components that hang together over edges."""
    directed = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(directed.T)
    same = (directed[order[1:]] == directed[order[:-1]]).all(axis=1)
    a, b = face[order[1:]][same], face[order[:-1]][same]
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(faces), len(faces)))
    return connected_components(graph, directed=False)[1]


def through_skin(mesh: HeadMesh) -> HeadMesh:
    """`mesh` with each quad that has one corner off the scalp cut through that corner: the scalp ends with the polygons."""
    offsets, corners = mesh.polygons
    size = np.diff(offsets)
    quads = np.flatnonzero(size == 4)
    quad = corners[offsets[quads][:, None] + np.arange(4)]
    triangle = offsets[quads] - 2 * quads
    on = mesh.scalp[quad]
    single = on.sum(axis=1) == 3
    faces = mesh.faces.copy()
    for off in range(4):
        turn = single & ~on[:, off]
        a, b, c, d = np.roll(quad[turn], -off, axis=1).T
        faces[triangle[turn]], faces[triangle[turn] + 1] = np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)
    return replace(mesh, faces=faces)


def checked(mesh: HeadMesh) -> HeadMesh:
    """`mesh`, or HeadError where it is of no use as a head: no faces, no scalp, not finite, of no area."""
    if not len(mesh.faces) or not len(mesh.vertices):
        raise HeadError(f"{mesh.name}: the mesh has no faces; give a head mesh with polygons")
    if not np.isfinite(mesh.vertices).all():
        raise HeadError(f"{mesh.name}: the mesh has vertices that are not finite numbers; repair it")
    if not len(mesh.scalp_faces):
        raise HeadError(
            f"{mesh.name}: the mesh has no scalp. Mark it with a vertex group 'scalp' in Blender, or in the OBJ file with a "
            "group ('g scalp'), object or material of that name over the faces where hair grows"
        )
    return mesh
