"""Pictures for the report without Blender: the scan as a lit volume, strands as lit lines, slices with strands over them.

All views are in the head frame (x to the wearer's left, y to the back, z up). Hair is lit as in Kajiya and Kay 1989.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np

from ..strands import Strands
from ..volume import BrickVolume
from ..volume.grid import trilinear

PIXELS = 460
"""Width and height of a view."""
ENLARGED = 5.0
"""A part is shown so many times as large as the whole."""
BACKGROUND = np.array([0.086, 0.09, 0.102], np.float32)
SCAN_COLOUR = np.array([0.80, 0.78, 0.74], np.float32)
HAIR_COLOUR = np.array([0.62, 0.40, 0.22], np.float32)
SKIN_COLOUR = np.array([0.52, 0.46, 0.42], np.float32)
STRAND_COLOURS = np.array([[255, 122, 41], [69, 196, 255]], np.uint8)
"""On slices: strands that the scan backs, and strands that were made up."""
LIGHT = np.array([-0.45, -0.65, 0.62])
LIGHT = LIGHT / np.linalg.norm(LIGHT)
VIEWS = {
    # to the picture's right, up, and into the picture
    "front": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
    "left": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]),
    "back": np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


@dataclass(frozen=True)
class Camera:
    """An orthographic view. axes (3, 3): rows right, up, forward, in the scan frame; centre (3,), half (its half width): mm."""

    axes: np.ndarray
    centre: np.ndarray
    half: float
    pixels: int = PIXELS

    def project(self, points: np.ndarray) -> np.ndarray:
        """(M, 3) float32: column, row (pixels, from the upper left corner) and depth (mm) of points in the scan frame."""
        seen = (np.asarray(points, np.float64) - self.centre) @ self.axes.T
        scale = self.pixels / (2.0 * self.half)
        half = 0.5 * self.pixels
        return np.stack([half + scale * seen[:, 0], half - scale * seen[:, 1], seen[:, 2]], axis=1).astype(np.float32)


def cameras(head_to_scan: np.ndarray, low: np.ndarray, high: np.ndarray, pixels: int = PIXELS) -> dict[str, Camera]:
    """The views of VIEWS that hold the box low..high (3,) of the scan frame."""
    turn = np.asarray(head_to_scan, np.float64)[:3, :3]
    turn = turn / np.cbrt(np.abs(np.linalg.det(turn)))
    centre = 0.5 * (np.asarray(low) + np.asarray(high))
    half = 0.52 * float(np.max(np.asarray(high) - np.asarray(low)))
    return {name: Camera(axes @ turn.T, centre, half, pixels) for name, axes in VIEWS.items()}


def strand_picture(strands: Strands, camera: Camera, head=None, most: int = 4_000_000) -> np.ndarray:
    """(P, P, 3) uint8: strands as lit lines in front of the head mesh (`HeadMesh`, scan frame)."""
    step = max(0.5 * 2.0 * camera.half / camera.pixels, float(strands.lengths().sum()) / most if len(strands) else 1.0)
    depth = np.full((camera.pixels, camera.pixels), np.inf, np.float32)
    shade = np.zeros((camera.pixels, camera.pixels, 3), np.float32)
    shade[:] = BACKGROUND
    if head is not None and len(head.faces):
        corners = camera.project(head.vertices)[head.faces]
        edge = head.vertices[head.faces].astype(np.float64)
        normal = np.cross(edge[:, 1] - edge[:, 0], edge[:, 2] - edge[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        light = LIGHT @ _to_world(camera)
        lit = (0.3 + 0.7 * np.clip(normal @ light, 0.0, 1.0)).astype(np.float32)
        _draw_faces(corners.astype(np.float32), lit, SKIN_COLOUR, depth, shade)
    if len(strands):
        fine = strands.resampled_by_step(step)
        tangents = fine.tangents().astype(np.float64) @ camera.axes.T
        light = np.array([LIGHT[0], LIGHT[2], LIGHT[1]])
        along = tangents @ light
        across = np.sqrt(np.clip(1.0 - along**2, 0.0, 1.0))
        to_eye = -tangents[:, 2]
        shine = np.clip(across * np.sqrt(np.clip(1.0 - to_eye**2, 0.0, 1.0)) - along * to_eye, 0.0, 1.0) ** 24
        tone = _tones(len(strands))[fine.strand_index]
        colour = HAIR_COLOUR[None] * (0.18 + 0.82 * across * tone)[:, None] + 0.35 * shine[:, None]
        _draw_points(camera.project(fine.points), colour.astype(np.float32), depth, shade)
        shade = _occluded(shade, depth)
    return _to_bytes(shade)


def volume_picture(density: BrickVolume, level: float, camera: Camera, pixels: int | None = None) -> np.ndarray:
    """(P, P, 3) uint8: the scan as a lit volume; density from `level` on is opaque within about a strand's width."""
    pixels = pixels or camera.pixels
    shade = np.empty((pixels, pixels, 3), np.float32)
    step = max(density.spacing, 2.0 * camera.half / 400.0)
    axes = camera.axes
    light = LIGHT[0] * axes[0] + LIGHT[2] * axes[1] + LIGHT[1] * axes[2]
    corner = density.to_voxel(camera.centre[None])[0]
    _march(
        density.table, density.bricks, axes / density.spacing, corner, camera.half, step, np.float32(level), light,
        SCAN_COLOUR, BACKGROUND, shade,
    )  # fmt: skip
    return _to_bytes(shade)


def slice_picture(
    density: BrickVolume, level: float, camera: Camera, strands: Strands | None = None, thickness: float = 0.5
) -> np.ndarray:
    """(P, P, 3) uint8: the scan in the camera's middle plane, and the strands within `thickness` mm of it drawn over."""
    across = (np.arange(camera.pixels) + 0.5) / camera.pixels * 2.0 - 1.0
    right, up = np.meshgrid(across * camera.half, -across * camera.half)
    points = camera.centre + right.reshape(-1, 1) * camera.axes[0] + up.reshape(-1, 1) * camera.axes[1]
    grey = np.clip(density.sample(points).reshape(camera.pixels, camera.pixels) / (4.0 * level), 0.0, 1.0) ** 0.7
    picture = np.repeat((235.0 * grey[:, :, None] + 12.0).astype(np.uint8), 3, axis=2)
    if strands is not None and len(strands):
        fine = strands.resampled_by_step(camera.half / camera.pixels)
        seen = camera.project(fine.points)
        near = np.abs(seen[:, 2]) < thickness
        column, row = (seen[near, n].astype(np.int64) for n in (0, 1))
        inside = (column >= 0) & (row >= 0) & (column < camera.pixels) & (row < camera.pixels)
        support = strands.strand_attributes.get("support")
        backed = np.ones(len(strands)) if support is None else np.asarray(support)
        colour = STRAND_COLOURS[(backed[fine.strand_index[near]] < 0.5).astype(np.int64)]
        picture[row[inside], column[inside]] = colour[inside]
    return picture


def strip_picture(sets: Sequence[Strands], head_to_scan: np.ndarray, head=None, pixels: int = PIXELS) -> np.ndarray:
    """(2 P, P N, 3) uint8: N sets of strands beside each other, seen from the left, and under each a part of it, larger.

    The views hold the first set, the truth or what others are compared with; the part is where half of its points lie to
    each side. head: `HeadMesh`, scan frame.
    """
    points = sets[0].points if len(sets[0]) else head.vertices
    whole = cameras(head_to_scan, points.min(axis=0), points.max(axis=0), pixels)["left"]
    near = replace(whole, centre=np.median(points, axis=0), half=whole.half / ENLARGED)
    return np.concatenate(
        [np.concatenate([strand_picture(strands, camera, head) for strands in sets], axis=1) for camera in (whole, near)]
    )


def _to_world(camera: Camera) -> np.ndarray:
    """Rows that turn (right, into the picture, up) components into the scan frame."""
    return np.stack([camera.axes[0], camera.axes[2], camera.axes[1]])


def _tones(count: int) -> np.ndarray:
    """(N,) a strand's own brightness, so that neighbours stand apart."""
    return np.random.default_rng(0).uniform(0.7, 1.25, count)


def _occluded(shade: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Darken what lies behind its surroundings: crevices between locks."""
    from scipy.ndimage import gaussian_filter

    finite = np.where(np.isfinite(depth), depth, depth[np.isfinite(depth)].max(initial=0.0))
    behind = np.clip((finite - gaussian_filter(finite, 6.0)) / 12.0, 0.0, 1.0)
    return shade * (1.0 - 0.65 * behind[:, :, None])


def _to_bytes(shade: np.ndarray) -> np.ndarray:
    return (255.0 * np.clip(shade, 0.0, 1.0) ** (1.0 / 1.8)).astype(np.uint8)


@numba.njit(cache=True)
def _draw_points(points, colours, depth, shade):
    """The nearest point of each pixel; one thread, so that ties fall the same way everywhere."""
    for n in range(len(points)):
        if not (0 <= points[n, 0] < depth.shape[1] and 0 <= points[n, 1] < depth.shape[0]):
            continue
        column, row = int(points[n, 0]), int(points[n, 1])
        if points[n, 2] < depth[row, column]:
            depth[row, column] = points[n, 2]
            shade[row, column] = colours[n]


@numba.njit(cache=True)
def _draw_faces(corners, lit, colour, depth, shade):
    height, width = depth.shape
    for n in range(len(corners)):
        ax, ay, az = corners[n, 0]
        bx, by, bz = corners[n, 1]
        cx, cy, cz = corners[n, 2]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-9:
            continue
        first_x, last_x = max(int(min(ax, bx, cx)), 0), min(int(max(ax, bx, cx)) + 1, width - 1)
        first_y, last_y = max(int(min(ay, by, cy)), 0), min(int(max(ay, by, cy)) + 1, height - 1)
        for y in range(first_y, last_y + 1):
            for x in range(first_x, last_x + 1):
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                w = 1.0 - u - v
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                z = u * az + v * bz + w * cz
                if z < depth[y, x]:
                    depth[y, x] = z
                    for channel in range(3):
                        shade[y, x, channel] = lit[n] * colour[channel]


@numba.njit(cache=True, parallel=True)
def _march(table, bricks, axes, corner, half, step, level, light, colour, background, shade):
    size = shade.shape[0]
    steps = int(2.0 * half / step)
    nothing = np.float32(0.0)
    for row in numba.prange(size):
        for column in range(size):
            right = ((column + 0.5) / size * 2.0 - 1.0) * half
            up = (1.0 - (row + 0.5) / size * 2.0) * half
            clear = 1.0
            total = 0.0
            for s in range(steps):
                forward = (s + 0.5) * step - half
                x = corner[0] + right * axes[0, 0] + up * axes[1, 0] + forward * axes[2, 0]
                y = corner[1] + right * axes[0, 1] + up * axes[1, 1] + forward * axes[2, 1]
                z = corner[2] + right * axes[0, 2] + up * axes[1, 2] + forward * axes[2, 2]
                value = trilinear(table, bricks, nothing, x, y, z)
                if value <= level:
                    continue
                gx = trilinear(table, bricks, nothing, x + 1, y, z) - trilinear(table, bricks, nothing, x - 1, y, z)
                gy = trilinear(table, bricks, nothing, x, y + 1, z) - trilinear(table, bricks, nothing, x, y - 1, z)
                gz = trilinear(table, bricks, nothing, x, y, z + 1) - trilinear(table, bricks, nothing, x, y, z - 1)
                norm = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-9
                facing = -(gx * light[0] + gy * light[1] + gz * light[2]) / norm
                alpha = min(0.35 * (value / level - 1.0), 0.8)
                total += clear * alpha * (0.35 + 0.65 * max(facing, 0.0)) * (1.0 - 0.55 * s / steps)
                clear *= 1.0 - alpha
                if clear < 0.02:
                    break
            for channel in range(3):
                shade[row, column, channel] = total * colour[channel] + clear * background[channel]
