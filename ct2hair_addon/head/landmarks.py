"""Places of a scalp that a person can point at in a scan, and the pose of a head that brings its own onto them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import HeadError
from .mesh import HeadMesh

LANDMARKS = ("forehead", "crown", "nape", "left side", "right side")
"""Middle of the hairline, highest point, lowest point of the neck's hairline, and the hairline's lowest points before the
ears, where a wig has its tabs."""
MIDDLE = 0.12
"""Share of the scalp's half width that counts as its middle."""
SIDE = 0.6
"""Share of the scalp's half width from which on it is a side."""
LEAST = 3


def scalp_landmarks(mesh: HeadMesh) -> dict[str, np.ndarray]:
    """Each of `LANDMARKS` -> (3,) float64, mm, of a head in the head frame (x to the wearer's left, y to the back, z up).

    Raises HeadError where the scalp is no cap over a head: nothing in its middle or on a side.
    """
    points = mesh.vertices[mesh.scalp].astype(np.float64)
    if not len(points):
        raise HeadError(f"{mesh.name}: no vertex is scalp; mark where hair grows")
    low, high = points[:, 0].min(), points[:, 0].max()
    across = 2.0 * (points[:, 0] - low) / max(high - low, 1e-9) - 1.0
    front = points[:, 1] < np.median(points[:, 1])
    choices = {
        "forehead": (np.abs(across) < MIDDLE, points[:, 1]),
        "crown": (np.abs(across) < MIDDLE, -points[:, 2]),
        "nape": ((np.abs(across) < MIDDLE) & ~front, points[:, 2]),
        "left side": ((across > SIDE) & front, points[:, 2]),
        "right side": ((across < -SIDE) & front, points[:, 2]),
    }
    found = {}
    for name, (there, height) in choices.items():
        if not there.any():
            raise HeadError(f"{mesh.name}: the scalp has no {name}; the head must look to -y, its top to +z")
        found[name] = points[np.flatnonzero(there)[np.argmin(height[there])]]
    return found


def fit_landmarks(own: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
    """The (4, 4) similarity that brings points `own` (K, 3) closest to `wanted` (K, 3), and the root mean square left over.

    Least squares over rotation, shift and one scale (Umeyama 1991). Raises HeadError for fewer than three points, or where
    they lie on a line.
    """
    own, wanted = (np.asarray(points, np.float64).reshape(-1, 3) for points in (own, wanted))
    if len(own) != len(wanted):
        raise ValueError(f"as many points are wanted as there are: {len(wanted)}, {len(own)}")
    if len(own) < LEAST:
        raise HeadError(f"{len(own)} landmarks say too little; at least {LEAST} are needed")
    a, b = own - own.mean(axis=0), wanted - wanted.mean(axis=0)
    for points in (a, b):
        spread = np.linalg.svd(points, compute_uv=False)
        if spread[1] < 1e-3 * max(spread[0], 1e-12):
            raise HeadError("the landmarks lie on one line: they leave open how the head is turned; move one of them off it")
    turn = Rotation.align_vectors(b, a)[0].as_matrix()
    scale = float((b * (a @ turn.T)).sum() / (a * a).sum())
    if scale <= 0.0:
        raise HeadError("the landmarks are no head's: are left and right swapped?")
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:3, 3] = wanted.mean(axis=0) - matrix[:3, :3] @ own.mean(axis=0)
    left = b - scale * a @ turn.T
    return matrix, float(np.sqrt((left**2).sum(axis=1).mean()))
