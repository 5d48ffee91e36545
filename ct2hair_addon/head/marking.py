"""A scalp for a head mesh that comes with hair but without a marked scalp: where the roots are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ..errors import HeadError
from .flatten import unwrap
from .mesh import HeadMesh, edges

ON_SKIN = 10.0
"""mm; hair whose roots lie farther than this from the mesh, in the median, is not this head's."""


def mark_scalp(mesh: HeadMesh, roots: np.ndarray) -> HeadMesh:
    """`mesh` with its scalp where the roots (N, 3), mm in the mesh's frame, lie close; unwrapped.

    A vertex is scalp within one edge's length (its longest) of a root, so that every root lies on a scalp triangle.
    Raises HeadError where the roots are not on the mesh.
    """
    distance, _ = cKDTree(roots).query(mesh.vertices)
    pairs, _ = edges(mesh.faces)
    length = np.linalg.norm(mesh.vertices[pairs[:, 0]] - mesh.vertices[pairs[:, 1]], axis=1)
    longest = np.zeros(len(mesh.vertices))
    np.maximum.at(longest, pairs.ravel(), np.repeat(length, 2))
    off = float(np.median(cKDTree(mesh.vertices).query(roots)[0]))
    if off > max(ON_SKIN, float(np.median(length))):
        raise HeadError(
            f"{mesh.name}: the strands' roots lie {off:.0f} mm from the mesh (median); head and strands must be in the same "
            "coordinates, in mm"
        )
    return unwrap(replace(mesh, scalp=distance <= longest, uv=np.full((len(mesh.vertices), 2), np.nan)))
