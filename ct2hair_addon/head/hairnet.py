"""The hairnet taken out of the scan: voxels inside the head or close to the scalp (supplement 1, "removing the hairnet")."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from ..progress import Progress, silent
from ..settings import HeadSettings
from ..volume import BRICK, BrickVolume
from .nearest import nearest_one
from .surface import Head, inside_one

NODE = 1.6
"""Distances are computed on nodes at most this far apart, mm, and interpolated between: off by at most NODE^2 / (4 R) on a
surface of radius R, 0.01 mm on a scalp."""
BRICKS_A_CALL = 1024
"""Bricks of one kernel call: well under a second."""

NET_HEIGHT, NET_BLUR = 0.5, 1.1
"""mm, and voxel: how high a net's threads lie over the scalp, and how far the scan's blur carries them and the knots (1.3
sigma). More hides hair that lies flat; less shows so much of the knots that strands are led from one to the next."""
CLEARANCES = (0.6, 1.5)
"""mm; the least and the most that is cleared where the settings give no number."""


def clearance(spacing: float, settings: HeadSettings) -> float:
    """mm over the scalp that are cleared in a scan of `spacing` mm: `settings.net_clearance`, or what a net takes there."""
    low, high = CLEARANCES
    return float(settings.net_clearance or min(max(NET_HEIGHT + NET_BLUR * spacing, low), high))


def remove_hairnet(
    density: BrickVolume, head: Head, settings: HeadSettings, progress: Progress = silent
) -> tuple[BrickVolume, dict[str, int]]:
    """`density` (scan frame) with the voxels inside `head`, and those nearer to its scalp than `clearance`, set to the
    background, exactly 0, which no other voxel is; bricks that end empty are dropped. Returns it with the counts of what was
    removed."""
    bricks = density.bricks.copy()
    index = density.brick_index
    background = bricks.dtype.type(density.background)
    removed = np.zeros((len(bricks), 2), np.int64)
    full = np.ones(len(bricks), np.bool_)
    solid, scalp = head.solid_tree, head.scalp_tree
    size = max(int(np.ceil((BRICK - 1) * density.spacing / NODE)), 1)
    for start in range(0, len(bricks), BRICKS_A_CALL):
        progress(start, len(bricks))
        part = slice(start, start + BRICKS_A_CALL)
        _remove(
            bricks[part],
            index[part],
            background,
            density.spacing,
            density.origin,
            clearance(density.spacing, settings),
            size,
            solid.boxes,
            solid.child,
            solid.first,
            solid.count,
            solid.corners,
            solid.centre,
            solid.dipole,
            solid.radius,
            *head.sides,
            head.walls,
            scalp.boxes,
            scalp.child,
            scalp.first,
            scalp.count,
            scalp.corners,
            removed[part],
            full[part],
        )
    progress(len(bricks), len(bricks))
    table = np.full(density.table.shape, -1, np.int32)
    kept = int(np.count_nonzero(full))
    # rows move down in place: a second copy of the volume may not fit
    position = 0
    for start in range(0, len(bricks), BRICKS_A_CALL):
        rows = bricks[start : start + BRICKS_A_CALL][full[start : start + BRICKS_A_CALL]]
        bricks[position : position + len(rows)] = rows
        position += len(rows)
    table[tuple(index[full].T)] = np.arange(kept, dtype=np.int32)
    tally = {
        "voxels removed: inside the head": int(removed[:, 0].sum()),
        "voxels removed: hairnet, close to the scalp": int(removed[:, 1].sum()),
        "bricks dropped: empty without head and net": len(bricks) - kept,
        "bricks kept": kept,
    }
    return replace(density, table=table, bricks=bricks[:kept]), tally


@numba.njit(cache=True, parallel=True)
def _remove(
    bricks,
    index,
    background,
    spacing,
    origin,
    clearance,
    size,
    boxes,
    child,
    first,
    count,
    corners,
    centre,
    dipole,
    radius,
    low,
    sides,
    walls,
    scalp_boxes,
    scalp_child,
    scalp_first,
    scalp_count,
    scalp_corners,
    removed,
    full,
):
    half = 0.5 * (BRICK - 1) * spacing
    # beyond this from the brick's middle nothing changes the brick
    far = clearance + np.sqrt(3.0) * half + 0.1
    for b in numba.prange(len(bricks)):
        x0 = origin[0] + BRICK * index[b, 0] * spacing
        y0 = origin[1] + BRICK * index[b, 1] * spacing
        z0 = origin[2] + BRICK * index[b, 2] * spacing
        x, y, z = x0 + half, y0 + half, z0 + half
        _, slot, v, w = nearest_one(boxes, child, first, count, corners, x, y, z, far * far)
        near = slot >= 0
        whole = not near and inside_one(
            boxes, child, first, count, corners, centre, dipole, radius, low, sides, walls, slot, v, w, x, y, z
        )
        if not near and not whole:
            continue
        head = np.full((size + 1, size + 1, size + 1), -1.0)
        # how much farther the scalp is than the skin: 0 over the scalp, without a kink on it
        beyond = np.full((size + 1, size + 1, size + 1), 2.0 * far)
        step = 2.0 * half / size
        if near:
            for i in range(size + 1):
                for j in range(size + 1):
                    for k in range(size + 1):
                        x, y, z = x0 + i * step, y0 + j * step, z0 + k * step
                        d2, slot, v, w = nearest_one(boxes, child, first, count, corners, x, y, z, 4.0 * far * far)
                        s2, _, _, _ = nearest_one(
                            scalp_boxes, scalp_child, scalp_first, scalp_count, scalp_corners, x, y, z, 4.0 * far * far
                        )
                        inside = inside_one(
                            boxes, child, first, count, corners, centre, dipole, radius, low, sides, walls, slot, v, w, x, y, z
                        )
                        head[i, j, k] = -np.sqrt(d2) if inside else np.sqrt(d2)
                        beyond[i, j, k] = np.sqrt(s2) - np.sqrt(d2)
        left = 0
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    if bricks[b, i, j, k] == background:
                        continue
                    distance = _between(head, i, j, k, size)
                    if whole or distance < 0.0:
                        removed[b, 0] += 1
                        bricks[b, i, j, k] = background
                    elif distance + _between(beyond, i, j, k, size) < clearance:
                        removed[b, 1] += 1
                        bricks[b, i, j, k] = background
                    else:
                        left += 1
        full[b] = left > 0


@numba.njit(cache=True, inline="always")
def _between(nodes, i, j, k, size):
    """The trilinear value at voxel (i, j, k) of a brick whose nodes run from its first to its last voxel."""
    x, y, z = i * size / (BRICK - 1.0), j * size / (BRICK - 1.0), k * size / (BRICK - 1.0)
    a, b, c = min(int(x), size - 1), min(int(y), size - 1), min(int(z), size - 1)
    u, v, w = x - a, y - b, z - c
    low = (nodes[a, b, c] * (1 - w) + nodes[a, b, c + 1] * w) * (1 - v)
    low += (nodes[a, b + 1, c] * (1 - w) + nodes[a, b + 1, c + 1] * w) * v
    high = (nodes[a + 1, b, c] * (1 - w) + nodes[a + 1, b, c + 1] * w) * (1 - v)
    high += (nodes[a + 1, b + 1, c] * (1 - w) + nodes[a + 1, b + 1, c + 1] * w) * v
    return low * (1 - u) + high * u
