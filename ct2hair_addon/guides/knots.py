"""Roots at the hairnet's knots: strands are tied there, and while hair is cleared with the net, the scan shows knots sharply.

Where hair stands off the scalp its root is known to a millimetre, and what is usually missed is learned from the knots
themselves; where it lies flat, it may have come from any of a few knots behind it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..head import Head, ScalpPoints
from ..strands import nearest_points, normalized
from .assignment import assign

HEIGHT = 1.0
"""mm; knots this far over or under the scalp at most."""
FEWEST = 50
"""Fewer knots tell nothing of how many strands there are."""
CLOSE, CLOSE_SHARE = 4.0, 0.05
"""voxel; where such a share of knots have another this near, nearer ones were seen as one."""
NEAREST = 24
"""Knots weighed for each root."""
ALONG, ACROSS = (1.0, 0.3), (0.55, 0.09)
"""mm, and mm a hidden mm: how far a root may be from where it was looked for, along its hair and across it."""
SHORT = 4.0
"""mm; roots of hair that is hidden for no longer are looked for well enough to learn from."""
LOOSE = 25.0
"""Cost of a root without a knot."""
ROUNDS = 3
"""Assignments, each after the last one's usual miss."""
LEAST_TIED = 0.3
"""Share of roots with a knot from which the usual miss is believed."""


def by_the_scalp(knots: np.ndarray, head: Head) -> np.ndarray:
    """Those of `knots` (K, 3) mm that lie on the scalp: what is farther off is no knot."""
    knots = np.asarray(knots, np.float64).reshape(-1, 3)
    return knots[np.abs(head.signed_distance(knots, HEIGHT)) < HEIGHT] if len(knots) else knots


def strands_by_knots(knots: np.ndarray | None, head: Head, spacing: float) -> tuple[int, bool]:
    """(how many strands the `knots` (K, 3) mm of a scan of `spacing` mm tell of, 0 for none; bool whether some of these may
    be two in one)."""
    knots = by_the_scalp(np.zeros((0, 3)) if knots is None else knots, head)
    if len(knots) < FEWEST:
        return 0, True
    apart = nearest_points(cKDTree(knots), knots, 2)[0][:, 1]
    return len(knots), bool(np.quantile(apart, CLOSE_SHARE) < CLOSE * spacing)


def tie_to_knots(
    found: ScalpPoints, course: np.ndarray, hidden: np.ndarray, knots: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(roots (N, 3) float64 moved to knots, each knot given to one root at most; (N,) the knot of each, -1 for none): the
    cheapest choice.

    found: on the scalp, where roots were looked for. course (N, 3): which way their hair goes. hidden (N,): mm of it that are
    hidden. knots: (K, 3) mm. Roots without a knot, of hair hidden for no more than SHORT, are moved by what others like them
    usually missed, along their hair. None is put back onto the scalp.
    """
    roots = np.array(found.position, np.float64)
    if not len(knots) or not len(roots):
        return roots, np.full(len(roots), -1)
    normal = found.normal.astype(np.float64)
    along = normalized(course - normal * (course * normal).sum(axis=1, keepdims=True))
    across = np.cross(normal, along)
    spread = np.stack([np.hypot(known, share * hidden) for known, share in (ALONG, ACROSS)], axis=1)
    tree, short = cKDTree(knots), hidden <= SHORT
    for _ in range(ROUNDS):
        chosen = _chosen(roots, along, across, spread, knots, tree)
        tied = chosen >= 0
        known = tied & short
        if known.sum() <= LEAST_TIED * short.sum():
            break
        roots[short] += np.median(((knots[chosen[known]] - roots[known]) * along[known]).sum(axis=1)) * along[short]
    roots[tied] = knots[chosen[tied]]
    return roots, chosen


def _chosen(roots, along, across, spread, knots, tree) -> np.ndarray:
    """(N,) the knot of each root, -1 for none. spread: (N, 2) mm along and across."""
    near = nearest_points(tree, roots, min(NEAREST, len(knots)))[1].reshape(len(roots), -1)
    miss = knots[near] - roots[:, None]
    cost = (np.einsum("nkc,nc->nk", miss, along) / spread[:, :1]) ** 2
    cost += (np.einsum("nkc,nc->nk", miss, across) / spread[:, 1:]) ** 2
    row, column = np.nonzero(cost < LOOSE)
    knot, cost = near[row, column].astype(np.int64), cost[row, column]
    order = np.lexsort((knot, row))
    return chosen_knots(row[order], knot[order], cost[order], len(roots), len(knots))


def chosen_knots(
    row: np.ndarray, knot: np.ndarray, cost: np.ndarray, roots: int, knots: int, loose: float = LOOSE
) -> np.ndarray:
    """(roots,) the knot of each root, -1 for none, at the least sum of costs: `loose` for a root without one.

    row, knot, cost (J,): which of the `knots` each root may have, rows ascending, each pair once.
    """
    chosen = np.full(max(roots, knots), -1, np.int64)
    assign(np.searchsorted(row, np.arange(len(chosen) + 1)), knot, cost, {loose: 0}, chosen)
    return chosen[:roots]
