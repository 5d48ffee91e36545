"""Where things stand in the scene: millimetres to metres, and the one matrix that carries scan -> head -> scene.

The layout of a result, in the collection 'CT2Hair <name>'::

    CT2Hair <name>          empty, the handle: identity when it arrives; moving it moves everything
        <name> Head         mesh, head frame in metres, upright at the handle, face to -y
            <name> Hair     curves, the same frame, attached to the head
            <name> Guides   curves, the same frame, not rendered
        <name> Scan         empty whose matrix is scan -> head -> scene: the scan's rotation, its shift and mm -> m
            <name> Volume   the OpenVDB grid, whose own transform is in mm of the scan frame
        <name> Lines        curves, the head frame in metres: the orientation field, after that stage alone

No object but the scan's empty has a scale, so head and hair hold true metres in their data. A registration may have scaled the
template to the wearer: that scale is the head's size, not the scene's, and is left out of `scene_from_scan`.
"""

from __future__ import annotations

import numpy as np

MM = 0.001
"""Metres in a millimetre: Blender's unit against the engine's."""


def rigid(matrix: np.ndarray) -> np.ndarray:
    """The rotation and shift of a 4 x 4 head -> scan matrix (mm), its uniform scale taken out, as float64.

    Raises ValueError where the 3 x 3 part is not a rotation times one positive scale.
    """
    matrix = np.asarray(matrix, np.float64).reshape(4, 4)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3])) if np.isfinite(matrix).all() else np.nan
    if not np.isfinite(scale) or scale <= 0:
        raise ValueError(f"the head -> scan matrix must be a rotation with one positive scale, got\n{matrix}")
    rotation = matrix[:3, :3] / scale
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        raise ValueError(f"the head -> scan matrix must be a rotation with one positive scale, got\n{matrix}")
    u, _, v = np.linalg.svd(rotation)
    out = np.eye(4)
    out[:3, :3] = u @ v
    out[:3, 3] = matrix[:3, 3]
    return out


def head_from_scan(matrix: np.ndarray) -> np.ndarray:
    """4 x 4 float64, mm -> mm: scan frame to head frame at true size, from the registration's head -> scan `matrix`."""
    return np.linalg.inv(rigid(matrix))


def scene_from_scan(matrix: np.ndarray) -> np.ndarray:
    """4 x 4 float64, mm -> m: scan frame to the scene, from the registration's head -> scan `matrix`."""
    return np.diag([MM, MM, MM, 1.0]) @ head_from_scan(matrix)


def scene_from_unregistered_scan(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """4 x 4 float64, mm -> m: a scan whose head is not known yet, standing on z = 0 with its middle over the origin.

    low, high: (3,) mm, the corners of what is in the scan, scan frame.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    out = np.diag([MM, MM, MM, 1.0])
    out[:3, 3] = -MM * base
    return out
