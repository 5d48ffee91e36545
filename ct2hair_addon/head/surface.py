"""Head: fast questions to a head mesh: how far is the scalp, inside or outside, where on the scalp texture, which frame."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numba
import numpy as np

from ..strands import normalized
from .flatten import scalp_patch, unwrap
from .mesh import HeadMesh, boundary_loops, face_areas
from .nearest import CHUNK, TriangleTree, box_distance2, nearest_one, winding_one

CELLS = 192
"""Cells along one edge of the texture-space grid: one to three triangles each for scalps of some 10,000 triangles."""
ON_SURFACE = 1e-3
"""mm from the surface within which the way to it is rounding."""
SIDES = 4.0
"""Grid on which inside and outside are tabulated, mm: 300,000 nodes for a head."""
PEEK, PEEKED = 0.01, 0.8
"""mm before and behind a triangle where inside and outside are looked at, and the share that a corner has of the places: three,
since other parts of the mesh may run through it."""
POOL = 10
"""Candidates for each scalp sample: enough for a blue-noise spectrum, few enough to be quick."""
SHRINK = 0.94
"""By how much the distance between samples is relaxed until all are placed."""


@dataclass(frozen=True)
class ScalpPoints:
    """Points on the scalp, M of them.

    distance: (M,) float32 mm from the points that were asked for (0 where the scalp itself was asked).
    position: (M, 3) float32 mm. normal: (M, 3) float32 unit, outward, smooth.
    face: (M,) int32 into `HeadMesh.faces`, -1 where there is none (position, normal, bary and uv of that row are NaN).
    bary: (M, 3) float32 weights of the face's vertices. uv: (M, 2) float32 scalp texture coordinates.
    """

    distance: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    face: np.ndarray
    bary: np.ndarray
    uv: np.ndarray

    def __len__(self) -> int:
        return len(self.face)

    @property
    def valid(self) -> np.ndarray:
        """(M,) bool: the rows that lie on the scalp."""
        return self.face >= 0

    def select(self, which: np.ndarray) -> ScalpPoints:
        """The rows of a mask or an index."""
        return ScalpPoints(*(getattr(self, key)[which] for key in ("distance", "position", "normal", "face", "bary", "uv")))


class Head:
    """A head mesh with what its queries need: search trees (built at once) and tables (built when first asked for).

    mesh: the HeadMesh, its scalp in one piece and with uv. solid_tree, scalp_tree, skin_tree: for kernels.

    All points are in the mesh's own frame, mm. Results don't depend on the number of threads. Raises HeadError where
    the mesh has no usable scalp. Open meshes (neck, eye holes) are closed by caps over their holes, so that inside is inside.
    """

    def __init__(self, mesh: HeadMesh):
        if not np.isfinite(mesh.uv[mesh.scalp]).all() or not mesh.scalp.any():
            mesh = unwrap(mesh)
        mesh, self._scalp_faces = scalp_patch(mesh)
        self.mesh = mesh
        self.scalp_tree = TriangleTree.build(mesh.vertices, mesh.faces[self._scalp_faces])
        self.solid_tree = TriangleTree.build(*closed(mesh.vertices, mesh.faces))

    @functools.cached_property
    def skin_tree(self) -> TriangleTree:
        """The search tree over all the mesh's faces, without caps."""
        return TriangleTree.build(self.mesh.vertices, self.mesh.faces)

    @functools.cached_property
    def scalp_area(self) -> float:
        """mm^2."""
        return float(face_areas(self.mesh.vertices, self.mesh.faces[self._scalp_faces]).sum())

    @functools.cached_property
    def normals(self) -> np.ndarray:
        """(V, 3) float32 vertex normals."""
        return self.mesh.normals

    @functools.cached_property
    def _tangents(self) -> np.ndarray:
        """(V, 3) float64: at scalp vertices the direction of growing u on the surface, unit; 0 elsewhere."""
        vertices, faces = self.mesh.vertices.astype(np.float64), self.mesh.faces[self._scalp_faces]
        uv = self.mesh.uv.astype(np.float64)[faces]
        a, b = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
        s, t = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        twice = s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]
        along = (a * t[:, 1:] - b * s[:, 1:]) * np.sign(twice)[:, None]
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
        along *= face_areas(vertices, faces)[:, None]
        total = np.zeros((len(vertices), 3))
        for corner in range(3):
            for axis in range(3):
                total[:, axis] += np.bincount(faces[:, corner], along[:, axis], len(vertices))
        normals = self.normals.astype(np.float64)
        total -= (total * normals).sum(axis=1, keepdims=True) * normals
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)

    @functools.cached_property
    def _texture_grid(self) -> tuple[np.ndarray, np.ndarray]:
        return _texture_grid(self.mesh.uv.astype(np.float64)[self.mesh.faces[self._scalp_faces]].reshape(-1, 6))

    @functools.cached_property
    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """(low (3,), exact signed distances (X, Y, Z)) on a coarse grid: far from the surface a node's side is its cell's."""
        tree = self.solid_tree
        low, high = tree.boxes[0, :3] - 0.5 * SIDES, tree.boxes[0, 3:] + 0.5 * SIDES
        size = np.ceil((high - low) / SIDES).astype(int) + 1
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3) * SIDES + low
        distance = tree.nearest(nodes)[0]
        grid = np.where(tree.winding(nodes) > 0.5, -distance, distance)
        return low, np.ascontiguousarray(grid.reshape(size))

    @functools.cached_property
    def walls(self) -> np.ndarray:
        """(F,) bool, by slot of the solid tree: the triangles with the inside behind them and the outside before them."""
        tree = self.solid_tree
        corner = tree.corners.reshape(-1, 3, 3)
        weights = np.full((3, 3), 0.5 * (1.0 - PEEKED)) + (1.5 * PEEKED - 0.5) * np.eye(3)
        normal = normalized(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
        place, step = np.matmul(weights, corner), PEEK * normal[:, None]
        before, behind = (tree.winding((place + way * step).reshape(-1, 3)).reshape(-1, 3) for way in (1.0, -1.0))
        return ((before < 0.5) & (behind > 0.5)).all(axis=1)

    def signed_distance(self, points: np.ndarray, beyond: float = np.inf) -> np.ndarray:
        """(M,) float32 mm from `points` (M, 3) to the closed head, negative inside; exact to float.

        beyond: mm; of points farther from the surface than this only something between it and their distance is told, which
        is much quicker. The side is a grid node's where the node's own empty ball holds the point, else the nearest triangle's
        where that is a wall and nearest within its edges, else the winding number's.
        """
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        out = np.empty(len(points), np.float32)
        tree = self.solid_tree
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            _signed_distance(
                points[part], *tree.arrays, tree.centre, tree.dipole, tree.radius, *self.sides, self.walls, float(beyond),
                out[part],
            )  # fmt: skip
        return out

    def outward(self, points: np.ndarray) -> np.ndarray:
        """(M, 3) float64 unit gradients of the signed distance at `points` (M, 3): from the nearest place of the closed head,
        to it for points inside; on the surface itself the triangle's normal."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        out = np.empty((len(points), 3))
        tree = self.solid_tree
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            _outward(points[part], *tree.arrays, tree.centre, tree.dipole, tree.radius, *self.sides, self.walls, out[part])
        return out

    def closest_scalp(self, points: np.ndarray, reach: float = np.inf) -> ScalpPoints:
        """The closest point on the scalp to each of `points` (M, 3); face -1 where none is within `reach` mm."""
        distance, slot, bary = self.scalp_tree.nearest(points, reach)
        face = np.where(slot >= 0, self._scalp_faces[slot], -1).astype(np.int32)
        return self._at(face, bary, distance)

    def on_scalp(self, uv: np.ndarray) -> ScalpPoints:
        """The scalp points at texture coordinates (M, 2); face -1 where `uv` is off the scalp."""
        uv = np.ascontiguousarray(uv, np.float64).reshape(-1, 2)
        corners = self.mesh.uv.astype(np.float64)[self.mesh.faces[self._scalp_faces]].reshape(-1, 6)
        slot, bary = np.empty(len(uv), np.int32), np.empty((len(uv), 3))
        for start in range(0, len(uv), CHUNK):
            part = slice(start, start + CHUNK)
            _on_texture(uv[part], corners, *self._texture_grid, slot[part], bary[part])
        face = np.where(slot >= 0, self._scalp_faces[slot], -1).astype(np.int32)
        return self._at(face, bary, np.zeros(len(uv)))

    def sample_scalp(self, count: int, seed: int) -> ScalpPoints:
        """`count` points over the scalp, uniform by area and kept apart (blue noise); the same seed gives the same points.

        Random candidates are accepted while none is closer than a distance that is relaxed until all are placed (McCool and
        Fiume 1992): any first part of the result is spread over the whole scalp, too.
        """
        generator = np.random.default_rng(seed)
        areas = face_areas(self.mesh.vertices, self.mesh.faces[self._scalp_faces])
        pool = max(count * POOL, 1)
        # stratified along the list of triangles, then shuffled: less clumping than independent draws
        wanted = (np.arange(pool) + generator.random(pool)) / pool * areas.sum()
        slot = np.searchsorted(np.cumsum(areas), wanted).clip(max=len(areas) - 1)
        slot = slot[generator.permutation(pool)]
        root, other = np.sqrt(generator.random(pool)), generator.random(pool)
        bary = np.stack([1.0 - root, root * (1.0 - other), root * other], axis=1)
        corners = self.mesh.vertices.astype(np.float64)[self.mesh.faces[self._scalp_faces[slot]]]
        position = (corners * bary[:, :, None]).sum(axis=1)
        spacing = np.sqrt(areas.sum() / max(count, 1) * 2.0 / np.sqrt(3.0))
        kept = _kept_apart(position, position.min(axis=0), position.max(axis=0), spacing, count)
        return self._at(self._scalp_faces[slot[kept]].astype(np.int32), bary[kept], np.zeros(len(kept)))

    def frames(self, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """(M, 3, 3) float32 tangent frames at scalp points, rows tangent (growing u), bitangent (growing v), normal.

        Interpolated from the vertices and made orthonormal: no jumps between faces, no singularity on the scalp.
        """
        face = np.asarray(face)
        weights = np.asarray(bary, np.float64)[:, :, None]
        corner = self.mesh.faces[face]
        normal = normalized((self.normals[corner] * weights).sum(axis=1))
        tangent = (self._tangents[corner] * weights).sum(axis=1)
        tangent = normalized(tangent - (tangent * normal).sum(axis=1, keepdims=True) * normal)
        return np.stack([tangent, np.cross(normal, tangent), normal], axis=1).astype(np.float32)

    def _at(self, face, bary, distance) -> ScalpPoints:
        corner = self.mesh.faces[np.maximum(face, 0)]
        weights = np.where(face[:, None] >= 0, bary, np.nan)[:, :, None]
        position = (self.mesh.vertices[corner] * weights).sum(axis=1)
        normal = normalized((self.normals[corner] * weights).sum(axis=1))
        uv = (self.mesh.uv[corner] * weights).sum(axis=1)
        return ScalpPoints(
            distance.astype(np.float32),
            position.astype(np.float32),
            normal.astype(np.float32),
            face.astype(np.int32),
            weights[:, :, 0].astype(np.float32),
            uv.astype(np.float32),
        )


def closed(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with each hole capped by a fan around the middle of its edge: (vertices, faces)."""
    vertices = np.asarray(vertices, np.float64)
    for loop in boundary_loops(faces):
        fan = np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(vertices))], axis=1)
        vertices = np.concatenate([vertices, vertices[loop].mean(axis=0, keepdims=True)])
        faces = np.concatenate([faces, fan])
    return vertices, faces


@numba.njit(cache=True)
def inside_one(boxes, child, first, count, corners, centre, dipole, radius, low, sides, walls, slot, v, w, x, y, z):
    """Whether a point is inside: as its nearest grid node, if the node's own empty ball holds it; as its nearest triangle says
    (slot, v, w of `nearest_one`; -1 where none is known), if that is a wall and nearest within its edges; else by winding
    number."""
    if x < boxes[0, 0] or y < boxes[0, 1] or z < boxes[0, 2] or x > boxes[0, 3] or y > boxes[0, 4] or z > boxes[0, 5]:
        return False
    node, off2 = _nearest_node(low, sides, x, y, z)
    if off2 < node * node:
        return node < 0.0
    if slot >= 0 and walls[slot] and v > 0.0 and w > 0.0 and v + w < 1.0:
        return _behind(corners, slot, x, y, z)
    return winding_one(boxes, child, first, count, corners, centre, dipole, radius, x, y, z) > 0.5


@numba.njit(cache=True, parallel=True, nogil=True)
def _signed_distance(
    points, boxes, child, first, count, order, corners, centre, dipole, radius, low, sides, walls, beyond, out
):
    for n in numba.prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        node, off2 = _nearest_node(low, sides, x, y, z)
        off = np.sqrt(off2)
        if abs(node) - off > beyond:
            out[n] = node - off if node > 0.0 else node + off
            continue
        box2 = box_distance2(boxes, 0, x, y, z)
        if box2 > beyond * beyond:
            out[n] = np.sqrt(box2)
            continue
        # no farther than the nearest grid node's distance allows: most of the tree is never visited
        d2, slot, v, w = nearest_one(boxes, child, first, count, corners, x, y, z, (abs(node) + off + 1e-3) ** 2)
        inside = inside_one(boxes, child, first, count, corners, centre, dipole, radius, low, sides, walls, slot, v, w, x, y, z)
        out[n] = -np.sqrt(d2) if inside else np.sqrt(d2)


@numba.njit(cache=True, parallel=True, nogil=True)
def _outward(points, boxes, child, first, count, order, corners, centre, dipole, radius, low, sides, walls, out):
    for n in numba.prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        node, off2 = _nearest_node(low, sides, x, y, z)
        known = abs(node) + np.sqrt(off2) + 1e-3
        d2, slot, v, w = nearest_one(boxes, child, first, count, corners, x, y, z, known * known)
        ax, ay, az = corners[slot, 0], corners[slot, 1], corners[slot, 2]
        ux, uy, uz = corners[slot, 3] - ax, corners[slot, 4] - ay, corners[slot, 5] - az
        vx, vy, vz = corners[slot, 6] - ax, corners[slot, 7] - ay, corners[slot, 8] - az
        if d2 < ON_SURFACE * ON_SURFACE:
            dx, dy, dz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        else:
            dx, dy, dz = x - ax - v * ux - w * vx, y - ay - v * uy - w * vy, z - az - v * uz - w * vz
            if inside_one(boxes, child, first, count, corners, centre, dipole, radius, low, sides, walls, slot, v, w, x, y, z):
                dx, dy, dz = -dx, -dy, -dz
        norm = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-30)
        out[n, 0], out[n, 1], out[n, 2] = dx / norm, dy / norm, dz / norm


@numba.njit(cache=True, inline="always")
def _nearest_node(low, sides, x, y, z):
    """(signed distance of the grid node nearest to a point, squared distance of the point from it)."""
    i, j, k = _node(x - low[0], sides.shape[0]), _node(y - low[1], sides.shape[1]), _node(z - low[2], sides.shape[2])
    dx, dy, dz = x - low[0] - i * SIDES, y - low[1] - j * SIDES, z - low[2] - k * SIDES
    return sides[i, j, k], dx * dx + dy * dy + dz * dz


@numba.njit(cache=True, inline="always")
def _node(along, size):
    """The grid node nearest to a place `along` an axis of it."""
    return int(min(max(along / SIDES + 0.5, 0.0), size - 1.0))


@numba.njit(cache=True)
def _behind(corners, slot, x, y, z):
    """Whether a point lies behind a triangle's plane."""
    ax, ay, az = corners[slot, 0], corners[slot, 1], corners[slot, 2]
    ux, uy, uz = corners[slot, 3] - ax, corners[slot, 4] - ay, corners[slot, 5] - az
    vx, vy, vz = corners[slot, 6] - ax, corners[slot, 7] - ay, corners[slot, 8] - az
    return (uy * vz - uz * vy) * (x - ax) + (uz * vx - ux * vz) * (y - ay) + (ux * vy - uy * vx) * (z - az) < 0.0


@numba.njit(cache=True)
def _texture_grid(corners):
    """Which triangles (G, 6) touch each cell of the texture: start (CELLS^2 + 1,) and items."""
    start = np.zeros(CELLS * CELLS + 1, np.int64)
    for fill in range(2):
        if fill == 1:
            total = 0
            for cell in range(CELLS * CELLS + 1):
                here = start[cell]
                start[cell] = total
                total += here
            items = np.empty(total, np.int32)
            cursor = start.copy()
        for g in range(len(corners)):
            u0 = _cell(min(corners[g, 0], corners[g, 2], corners[g, 4]))
            u1 = _cell(max(corners[g, 0], corners[g, 2], corners[g, 4]))
            v0 = _cell(min(corners[g, 1], corners[g, 3], corners[g, 5]))
            v1 = _cell(max(corners[g, 1], corners[g, 3], corners[g, 5]))
            for i in range(u0, u1 + 1):
                for j in range(v0, v1 + 1):
                    cell = i * CELLS + j
                    if fill == 0:
                        start[cell] += 1
                    else:
                        items[cursor[cell]] = g
                        cursor[cell] += 1
    return start, items


@numba.njit(cache=True, inline="always")
def _cell(value):
    return min(max(int(value * CELLS), 0), CELLS - 1)


@numba.njit(cache=True, parallel=True, nogil=True)
def _on_texture(uv, corners, start, items, slot, bary):
    for n in numba.prange(len(uv)):
        u, v = uv[n, 0], uv[n, 1]
        slot[n] = -1
        bary[n, 0], bary[n, 1], bary[n, 2] = 0.0, 0.0, 0.0
        if not (0.0 <= u <= 1.0 and 0.0 <= v <= 1.0):
            continue
        cell = _cell(u) * CELLS + _cell(v)
        # a point on an edge, off by rounding, belongs to the triangle that it is least outside of
        best = -1e-6
        for item in range(start[cell], start[cell + 1]):
            g = items[item]
            ax, ay = corners[g, 2] - corners[g, 0], corners[g, 3] - corners[g, 1]
            bx, by = corners[g, 4] - corners[g, 0], corners[g, 5] - corners[g, 1]
            area = ax * by - ay * bx
            if area == 0.0:
                continue
            px, py = u - corners[g, 0], v - corners[g, 1]
            s = (px * by - py * bx) / area
            t = (ax * py - ay * px) / area
            least = min(s, t, 1.0 - s - t)
            if least > best:
                best = least
                slot[n] = g
                bary[n, 0], bary[n, 1], bary[n, 2] = 1.0 - s - t, s, t


@numba.njit(cache=True)
def _kept_apart(position, low, high, spacing, count):
    """(count,) indices of candidates, each as far from the earlier ones as can be, by a grid of cells of `spacing`."""
    size = np.empty(3, np.int64)
    for axis in range(3):
        size[axis] = int((high[axis] - low[axis]) / spacing) + 1
    head = np.full(size[0] * size[1] * size[2], -1, np.int64)
    following = np.full(max(count, 1), -1, np.int64)
    kept = np.empty(count, np.int64)
    taken = np.zeros(len(position), np.bool_)
    total = 0
    distance = spacing
    while total < count:
        for n in range(len(position)):
            if total == count:
                break
            if taken[n]:
                continue
            i = min(int((position[n, 0] - low[0]) / spacing), size[0] - 1)
            j = min(int((position[n, 1] - low[1]) / spacing), size[1] - 1)
            k = min(int((position[n, 2] - low[2]) / spacing), size[2] - 1)
            free = True
            for a in range(max(i - 1, 0), min(i + 2, size[0])):
                for b in range(max(j - 1, 0), min(j + 2, size[1])):
                    for c in range(max(k - 1, 0), min(k + 2, size[2])):
                        item = head[(a * size[1] + b) * size[2] + c]
                        while free and item >= 0:
                            d2 = 0.0
                            for axis in range(3):
                                apart = position[kept[item], axis] - position[n, axis]
                                d2 += apart * apart
                            if d2 < distance * distance:
                                free = False
                            item = following[item]
            if free:
                cell = (i * size[1] + j) * size[2] + k
                kept[total] = n
                taken[n] = True
                following[total] = head[cell]
                head[cell] = total
                total += 1
        distance *= SHRINK
    return kept
