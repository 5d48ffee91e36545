"""Closest points on triangles and winding numbers by a bounding volume hierarchy, for kernels over many points.

Winding numbers after Barill et al. 2018, "Fast winding numbers for soups and clouds" (first-order far field).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np

LEAF = 4
"""Triangles in a leaf: the least time a query on meshes of 10,000 to 50,000 triangles."""
FAR_FIELD = 2.0
"""A node farther from the point than this many of its radii counts as one dipole: error of the winding number < 0.05."""
STACK = 64
"""Depth of the traversal stack: a balanced tree over 2^32 triangles needs 33."""
CHUNK = 200_000
"""Points of one kernel call, so that cancelling never waits for long."""


@dataclass(frozen=True)
class TriangleTree:
    """A balanced binary tree over triangles; node 0 is the root, the children of an inner node are `child` and `child` + 1.

    boxes: (N, 6) float64 low and high corner. child: (N,) int32, -1 for leaves. first, count: (N,) int32, range of `order`.
    order: (F,) int32 triangle of each slot. corners: (F, 9) float64 by slot.
    centre (N, 3), dipole (N, 3), radius (N,): of each node, for the winding number.
    """

    boxes: np.ndarray
    child: np.ndarray
    first: np.ndarray
    count: np.ndarray
    order: np.ndarray
    corners: np.ndarray
    centre: np.ndarray
    dipole: np.ndarray
    radius: np.ndarray

    @classmethod
    def build(cls, vertices: np.ndarray, faces: np.ndarray) -> TriangleTree:
        corners = np.ascontiguousarray(np.asarray(vertices, np.float64)[faces].reshape(-1, 9))
        order, child, first, count = _build(corners)
        boxes, slots, centre, dipole, radius = _bounds(corners, order, child, first, count)
        return cls(boxes, child, first, count, order, slots, centre, dipole, radius)

    def refitted(self, vertices: np.ndarray, faces: np.ndarray) -> TriangleTree:
        """The same tree over the same faces at new vertices: ten times quicker than a new one, as good for small moves."""
        corners = np.ascontiguousarray(np.asarray(vertices, np.float64)[faces].reshape(-1, 9))
        boxes, slots, centre, dipole, radius = _bounds(corners, self.order, self.child, self.first, self.count)
        return replace(self, boxes=boxes, corners=slots, centre=centre, dipole=dipole, radius=radius)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What the kernels take, in their order: boxes, child, first, count, order, corners."""
        return self.boxes, self.child, self.first, self.count, self.order, self.corners

    def nearest(self, points: np.ndarray, reach: float = np.inf):
        """The closest point on the triangles to each of `points` (M, 3).

        Returns distance (M,) float64 (inf beyond `reach`), face (M,) int32 (-1 beyond), bary (M, 3) float64.
        """
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        distance, face, bary = np.empty(len(points)), np.empty(len(points), np.int32), np.empty((len(points), 3))
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            _nearest(points[part], *self.arrays, reach, distance[part], face[part], bary[part])
        return distance, face, bary

    def winding(self, points: np.ndarray) -> np.ndarray:
        """(M,) float64 winding number at `points`: 1 inside a closed outward surface, 0 outside."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        winding = np.empty(len(points))
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            _winding(
                points[part],
                self.boxes,
                self.child,
                self.first,
                self.count,
                self.corners,
                self.centre,
                self.dipole,
                self.radius,
                winding[part],
            )
        return winding


@numba.njit(cache=True)
def _build(corners):
    """The tree's topology: order, child, first, count; split at the median along the longest side of the centroids' box."""
    total = len(corners)
    order = np.arange(total).astype(np.int32)
    centroids = np.empty((total, 3))
    for f in range(total):
        for axis in range(3):
            centroids[f, axis] = (corners[f, axis] + corners[f, 3 + axis] + corners[f, 6 + axis]) / 3.0
    most = max(2 * total + 1, 1)
    child = np.full(most, -1, np.int32)
    first = np.zeros(most, np.int32)
    count = np.zeros(most, np.int32)
    count[0] = total
    nodes = 1
    node = 0
    while node < nodes:
        if count[node] > LEAF:
            begin, end = first[node], first[node] + count[node]
            longest, length = 0, -1.0
            for axis in range(3):
                low, high = np.inf, -np.inf
                for slot in range(begin, end):
                    value = centroids[order[slot], axis]
                    low, high = min(low, value), max(high, value)
                if high - low > length:
                    longest, length = axis, high - low
            keys = np.empty(end - begin)
            for slot in range(begin, end):
                keys[slot - begin] = centroids[order[slot], longest]
            order[begin:end] = order[begin:end][np.argsort(keys, kind="mergesort")]
            half = count[node] // 2
            child[node] = nodes
            first[nodes], count[nodes] = begin, half
            first[nodes + 1], count[nodes + 1] = begin + half, count[node] - half
            nodes += 2
        node += 1
    return order, child[:nodes].copy(), first[:nodes].copy(), count[:nodes].copy()


@numba.njit(cache=True)
def _bounds(corners, order, child, first, count):
    """For given triangles and topology: boxes, corners by slot, and each node's centre, dipole (area vector) and radius."""
    slots = np.empty((len(order), 9))
    for slot in range(len(order)):
        slots[slot] = corners[order[slot]]
    nodes = len(child)
    boxes = np.empty((nodes, 6))
    centre, dipole, radius, area = np.zeros((nodes, 3)), np.zeros((nodes, 3)), np.zeros(nodes), np.zeros(nodes)
    # children come after their parents
    for n in range(nodes - 1, -1, -1):
        for axis in range(3):
            boxes[n, axis], boxes[n, 3 + axis] = np.inf, -np.inf
        if child[n] >= 0:
            for c in range(child[n], child[n] + 2):
                area[n] += area[c]
                for axis in range(3):
                    boxes[n, axis] = min(boxes[n, axis], boxes[c, axis])
                    boxes[n, 3 + axis] = max(boxes[n, 3 + axis], boxes[c, 3 + axis])
                    dipole[n, axis] += dipole[c, axis]
                    centre[n, axis] += area[c] * centre[c, axis]
        else:
            for slot in range(first[n], first[n] + count[n]):
                abx, aby, abz = (
                    slots[slot, 3] - slots[slot, 0],
                    slots[slot, 4] - slots[slot, 1],
                    slots[slot, 5] - slots[slot, 2],
                )
                acx, acy, acz = (
                    slots[slot, 6] - slots[slot, 0],
                    slots[slot, 7] - slots[slot, 1],
                    slots[slot, 8] - slots[slot, 2],
                )
                nx, ny, nz = 0.5 * (aby * acz - abz * acy), 0.5 * (abz * acx - abx * acz), 0.5 * (abx * acy - aby * acx)
                size = np.sqrt(nx * nx + ny * ny + nz * nz)
                area[n] += size
                dipole[n, 0] += nx
                dipole[n, 1] += ny
                dipole[n, 2] += nz
                for axis in range(3):
                    a, b, c = slots[slot, axis], slots[slot, 3 + axis], slots[slot, 6 + axis]
                    boxes[n, axis] = min(boxes[n, axis], a, b, c)
                    boxes[n, 3 + axis] = max(boxes[n, 3 + axis], a, b, c)
                    centre[n, axis] += size * (a + b + c) / 3.0
        for axis in range(3):
            if area[n] > 0.0:
                centre[n, axis] /= area[n]
            else:
                centre[n, axis] = 0.5 * (boxes[n, axis] + boxes[n, 3 + axis])
        far = 0.0
        for slot in range(first[n], first[n] + count[n]):
            for corner in range(0, 9, 3):
                dx = slots[slot, corner] - centre[n, 0]
                dy = slots[slot, corner + 1] - centre[n, 1]
                dz = slots[slot, corner + 2] - centre[n, 2]
                far = max(far, dx * dx + dy * dy + dz * dz)
        radius[n] = np.sqrt(far)
    return boxes, slots, centre, dipole, radius


@numba.njit(cache=True, inline="always")
def box_distance2(boxes, node, x, y, z):
    """The squared distance from a point to a node's box, 0 within."""
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@numba.njit(cache=True)
def triangle_nearest(corners, slot, x, y, z):
    """(squared distance, v, w): the closest point of a triangle is (1 - v - w) a + v b + w c (Ericson 2005, 5.1.5)."""
    ax, ay, az = corners[slot, 0], corners[slot, 1], corners[slot, 2]
    abx, aby, abz = corners[slot, 3] - ax, corners[slot, 4] - ay, corners[slot, 5] - az
    acx, acy, acz = corners[slot, 6] - ax, corners[slot, 7] - ay, corners[slot, 8] - az
    apx, apy, apz = x - ax, y - ay, z - az
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    v, w = 0.0, 0.0
    if not (d1 <= 0.0 and d2 <= 0.0):
        bpx, bpy, bpz = apx - abx, apy - aby, apz - abz
        d3 = abx * bpx + aby * bpy + abz * bpz
        d4 = acx * bpx + acy * bpy + acz * bpz
        cpx, cpy, cpz = apx - acx, apy - acy, apz - acz
        d5 = abx * cpx + aby * cpy + abz * cpz
        d6 = acx * cpx + acy * cpy + acz * cpz
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        if d3 >= 0.0 and d4 <= d3:
            v = 1.0
        elif d6 >= 0.0 and d5 <= d6:
            w = 1.0
        elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
            v = d1 / (d1 - d3) if d1 != d3 else 0.0
        elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
            w = d2 / (d2 - d6) if d2 != d6 else 0.0
        elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
            w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
            v = 1.0 - w
        else:
            total = va + vb + vc
            if total != 0.0:
                v, w = vb / total, vc / total
    qx, qy, qz = apx - v * abx - w * acx, apy - v * aby - w * acy, apz - v * abz - w * acz
    return qx * qx + qy * qy + qz * qz, v, w


@numba.njit(cache=True)
def nearest_one(boxes, child, first, count, corners, x, y, z, reach2):
    """(squared distance, slot, v, w) of the closest triangle nearer than `reach2`; slot -1 where there is none."""
    best, best_slot, best_v, best_w = reach2, -1, 0.0, 0.0
    stack = np.empty(STACK, np.int32)
    bound = np.empty(STACK)
    stack[0], bound[0] = 0, box_distance2(boxes, 0, x, y, z)
    top = 1
    while top > 0:
        top -= 1
        node, near = stack[top], bound[top]
        if near >= best:
            continue
        while child[node] >= 0:
            left = child[node]
            d_left = box_distance2(boxes, left, x, y, z)
            d_right = box_distance2(boxes, left + 1, x, y, z)
            closer = left
            if d_right < d_left:
                closer = left + 1
                d_left, d_right = d_right, d_left
            other = 2 * left + 1 - closer
            if d_right < best:
                stack[top], bound[top] = other, d_right
                top += 1
            node = closer
            near = d_left
            if near >= best:
                break
        if near >= best:
            continue
        for slot in range(first[node], first[node] + count[node]):
            d2, v, w = triangle_nearest(corners, slot, x, y, z)
            if d2 < best:
                best, best_slot, best_v, best_w = d2, slot, v, w
    return best, best_slot, best_v, best_w


@numba.njit(cache=True, parallel=True, nogil=True)
def _nearest(points, boxes, child, first, count, order, corners, reach, distance, face, bary):
    for n in numba.prange(len(points)):
        d2, slot, v, w = nearest_one(
            boxes, child, first, count, corners, points[n, 0], points[n, 1], points[n, 2], reach * reach
        )
        distance[n] = np.sqrt(d2) if slot >= 0 else np.inf
        face[n] = order[slot] if slot >= 0 else -1
        bary[n, 0], bary[n, 1], bary[n, 2] = 1.0 - v - w, v, w


@numba.njit(cache=True, inline="always")
def _solid_angle(corners, slot, x, y, z):
    """Half the signed solid angle of a triangle seen from a point (Van Oosterom and Strackee 1983)."""
    ax, ay, az = corners[slot, 0] - x, corners[slot, 1] - y, corners[slot, 2] - z
    bx, by, bz = corners[slot, 3] - x, corners[slot, 4] - y, corners[slot, 5] - z
    cx, cy, cz = corners[slot, 6] - x, corners[slot, 7] - y, corners[slot, 8] - z
    a = np.sqrt(ax * ax + ay * ay + az * az)
    b = np.sqrt(bx * bx + by * by + bz * bz)
    c = np.sqrt(cx * cx + cy * cy + cz * cz)
    triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    below = (
        a * b * c + (ax * bx + ay * by + az * bz) * c + (bx * cx + by * cy + bz * cz) * a + (cx * ax + cy * ay + cz * az) * b
    )
    return np.arctan2(triple, below)


@numba.njit(cache=True)
def winding_one(boxes, child, first, count, corners, centre, dipole, radius, x, y, z):
    """The winding number at one point."""
    total = 0.0
    stack = np.empty(STACK, np.int32)
    stack[0] = 0
    top = 1
    while top > 0:
        top -= 1
        node = stack[top]
        dx, dy, dz = centre[node, 0] - x, centre[node, 1] - y, centre[node, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 > (FAR_FIELD * radius[node]) ** 2:
            total += (dipole[node, 0] * dx + dipole[node, 1] * dy + dipole[node, 2] * dz) / (4.0 * np.pi * d2 * np.sqrt(d2))
        elif child[node] >= 0:
            stack[top], stack[top + 1] = child[node], child[node] + 1
            top += 2
        else:
            for slot in range(first[node], first[node] + count[node]):
                total += _solid_angle(corners, slot, x, y, z) / (2.0 * np.pi)
    return total


@numba.njit(cache=True, parallel=True, nogil=True)
def _winding(points, boxes, child, first, count, corners, centre, dipole, radius, winding):
    for n in numba.prange(len(points)):
        winding[n] = winding_one(
            boxes, child, first, count, corners, centre, dipole, radius, points[n, 0], points[n, 1], points[n, 2]
        )
