"""Roots at the hairnet's knots: strands are tied there, and while hair is cleared with the net, the scan shows knots sharply.

Followed straight back, hair meets the scalp too far behind its root, since it leaves the knot steeper than it goes on; by how
much is learned from the knots themselves.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..head import Head, ScalpPoints
from .linking import assign

HEIGHT = 1.0
"""mm; knots this far over or under the scalp at most."""
REACH = 3.0
"""mm around where a root was looked for."""
NEAREST = 10
"""Knots weighed for each root."""
ALONG, ACROSS = 1.0, 0.55
"""mm; how far a root may be from where it was looked for, along the hair's direction over the scalp and across it."""
LOOSE = 25.0
"""Cost of a root without a knot."""
ROUNDS = 3
"""Assignments, each after the last one's usual miss."""
LEAST_TIED = 0.3
"""Share of roots with a knot from which the usual miss is believed."""


def tie_to_knots(found: ScalpPoints, forward: np.ndarray, head: Head, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(roots (N, 3) float64 moved to knots, each knot given to one root at most; (N,) bool which were): the cheapest choice.

    found: on the scalp, where hair that goes on in the directions `forward` (N, 3) was followed back to. knots: (K, 3) mm.
    Roots without a knot are moved by what the others' usually missed, along their hair. None is put back onto the scalp.
    """
    roots = np.array(found.position, np.float64)
    knots = np.asarray(knots, np.float64).reshape(-1, 3)
    if len(knots):
        knots = knots[np.abs(head.signed_distance(knots)) < HEIGHT]
    if not len(knots) or not len(roots):
        return roots, np.zeros(len(roots), bool)
    normal = found.normal.astype(np.float64)
    along = forward - normal * (forward * normal).sum(axis=1, keepdims=True)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = np.cross(normal, along)
    tree = cKDTree(knots)
    for _ in range(ROUNDS):
        chosen = _chosen(roots, along, across, knots, tree)
        tied = chosen >= 0
        if tied.mean() < LEAST_TIED:
            break
        roots += np.median(((knots[chosen[tied]] - roots[tied]) * along[tied]).sum(axis=1)) * along
    roots[tied] = knots[chosen[tied]]
    return roots, tied


def _chosen(roots, along, across, knots, tree) -> np.ndarray:
    """(N,) the knot of each root, -1 for none."""
    count = min(NEAREST, len(knots))
    distance, near = (
        each.reshape(len(roots), count) for each in tree.query(roots, k=count, distance_upper_bound=REACH, workers=-1)
    )
    row, column = np.nonzero(np.isfinite(distance))
    knot = near[row, column].astype(np.int64)
    miss = knots[knot] - roots[row]
    cost = ((miss * along[row]).sum(axis=1) / ALONG) ** 2 + ((miss * across[row]).sum(axis=1) / ACROSS) ** 2
    order = np.lexsort((knot, row))
    chosen = np.full(max(len(roots), len(knots)), -1, np.int64)
    starts = np.searchsorted(row[order], np.arange(len(chosen) + 1))
    assign(starts, knot[order], cost[order], LOOSE, chosen)
    return chosen[: len(roots)]
