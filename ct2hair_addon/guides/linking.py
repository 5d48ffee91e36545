"""Segments joined into whole strands: which tip goes on in which root end, for all of them at once (in place of 3.2.2).

A trace ends where strands touch and goes on, under another name, where they part. Every tip end is held against the root
ends that lie on its course (`joints.py`), and the cheapest set of joints taken in which no end is used twice
(`assignment.py`). What it costs to leave a tip loose says how many strands there are; where the knots of the hairnet tell
that, it is as low as leaves no more of them.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..progress import Progress, part, silent
from ..strands import Strands, offsets_from_counts
from ..volume.grid import BrickVolume
from .assignment import assign
from .joints import LOOSE_END, Joints, weighed_joints
from .pieces import STEP, Pieces

LOOSE_ENDS = (20.0, 25.0, 30.0, 40.0, 60.0)
"""Costs of a tip that goes on nowhere, tried in turn where it is known how many strands there are; the first alone where there
may be more. Lower ones break good joints, higher ones make none but bad ones."""
SPARE = 0.02
"""Share of strands more than are known that may be left: about as many prove to be nothing when they are rooted and fitted."""
LOWEST, LACKING = 14.0, 0.01
"""The cost before those, and the share of strands that must be lacking even so: bad joints are then worse than broken ones."""


def link_segments(
    pieces: Pieces,
    rooted: np.ndarray,
    density: BrickVolume,
    strand: float,
    progress: Progress = silent,
    known: int = 0,
    at_least: bool = False,
) -> tuple[Strands, np.ndarray, np.ndarray, dict[str, int]]:
    """Chains of directed pieces of segments (mm, scan frame, root end first).

    rooted: (P,) bool, pieces whose first point is a root on the scalp: nothing goes on into them. density: the scan; strand:
    a lone strand's density on its centre line as trilinear reads see it. known: how many strands there are, or are `at_least`;
    0 where nobody knows. Returns (chains, (C,) bool rooted, (C,) float32 mm bridged in each, tally).
    """
    voxel, lines, onward = density.spacing, pieces.strands, pieces.onward
    count = len(lines)
    rooted = np.asarray(rooted, bool)
    if count < 2:
        return lines, rooted, np.zeros(count, np.float32), {"segments joined": 0}
    prices = _prices(known, at_least)
    joints = weighed_joints(lines, rooted, onward, density, strand, max(prices), part(progress, 0.0, 0.5))
    following, cut, price = _assigned(count, joints, prices)
    progress(0.9, 1.0)
    following, broken = _without_rings(following, joints)
    chain, position, length = _chains(following)
    points, offsets, bridged = _joined(lines, following, cut, chain, position, length, voxel)
    firsts = np.flatnonzero(position == 0)
    order = np.argsort(chain[firsts])
    healed = (following == onward) & (onward >= 0)
    tally = {
        "cuts of segments: an end beside them, or a kink": len(pieces.parent) - len(np.unique(pieces.parent)),
        "cuts that were healed": int(healed.sum()),
        "joints held": len(joints.cost),
        "dearest joint allowed": round(price),
        "joints made": int(((following >= 0) & ~healed).sum()),
        "joints undone: they closed a ring": broken,
        "strands after joining": len(offsets) - 1,
    }
    progress(1.0, 1.0)
    return Strands(points, offsets), rooted[firsts[order]], bridged, tally


def _prices(known: int, at_least: bool) -> dict[float, int]:
    """The costs of a loose tip, to be tried in turn, and how many may be left loose at each (see the constants)."""
    if not known:
        return {LOOSE_END: 0}
    spare = int((1.0 + SPARE) * known)
    if at_least:
        return {LOOSE_ENDS[0]: spare}
    return {LOWEST: int((1.0 - LACKING) * known)} | dict.fromkeys(LOOSE_ENDS, spare)


def _assigned(count: int, joints: Joints, prices: dict[float, int]) -> tuple[np.ndarray, np.ndarray, float]:
    """(following (N,): the piece that each goes on in, -1 for none; cut (N, 2): points left off its root and its tip; the cost
    of a loose tip) at the least cost in all: by the first of `prices` that leaves no more tips loose than it may, or the
    last."""
    following, cut = np.full(count, -1, np.int64), np.zeros((count, 2), np.int64)
    if not len(joints.cost):
        return following, cut, min(prices)
    starts = np.searchsorted(joints.tip, np.arange(count + 1))
    price = assign(starts, joints.root, joints.cost, prices, following)
    tip = np.flatnonzero(following >= 0)
    root = following[tip]
    key = joints.tip * count + joints.root
    chosen = joints.cut[np.searchsorted(key, tip * count + root)]
    cut[tip, 1], cut[root, 0] = chosen[:, 0], chosen[:, 1]
    return following, cut, price


def _without_rings(following: np.ndarray, joints: Joints) -> tuple[np.ndarray, int]:
    """The joints without rings: each ring is opened at its dearest joint."""
    count = len(following)
    linked = np.flatnonzero(following >= 0)
    graph = coo_matrix((np.ones(len(linked)), (linked, following[linked])), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    # a component with as many joints as members is a ring
    rings = np.bincount(label[linked], minlength=number) == np.bincount(label, minlength=number)
    inside = linked[rings[label[linked]]]
    if not len(inside):
        return following, 0
    key = joints.tip * count + joints.root
    cost = joints.cost[np.searchsorted(key, inside * count + following[inside])]
    order = np.lexsort((inside, -cost, label[inside]))
    inside = inside[order]
    dearest = inside[np.unique(label[inside], return_index=True)[1]]
    following = following.copy()
    following[dearest] = -1
    return following, len(dearest)


def _chains(following: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(chain (N,), position (N,) in it, length (C,)): pointers doubled until every segment knows its chain's first."""
    count = len(following)
    before = np.full(count, -1, np.int64)
    linked = np.flatnonzero(following >= 0)
    before[following[linked]] = linked
    first, steps = np.arange(count), (before >= 0).astype(np.int64)
    jump = np.where(before >= 0, before, first)
    while True:
        further = jump[jump]
        more = steps[jump]
        if (further == jump).all():
            break
        steps, jump = steps + more, further
    firsts = np.flatnonzero(before < 0)
    chain = np.searchsorted(firsts, jump)
    return chain, steps, np.bincount(chain, minlength=len(firsts))


def _joined(lines: Strands, following, cut, chain, position, length, voxel):
    """(points, offsets, bridged (C,) mm) of the chains: their segments in order, with a cubic Hermite piece in each gap."""
    order = np.lexsort((position, chain))
    tips = lines.offsets[1:] - 1 - cut[:, 1]
    roots = lines.offsets[:-1] + cut[:, 0]
    linked = following[order] >= 0
    gap = np.zeros(len(order))
    after = following[order][linked]
    gap[linked] = np.linalg.norm(lines.points[roots[after]] - lines.points[tips[order][linked]], axis=1)
    gap = np.maximum(gap - STEP * voxel, 0.0)  # what heals a cut bridges nothing
    between = np.where(linked, np.ceil(gap / (STEP * voxel)).astype(np.int64), 0)
    kept = tips[order] - roots[order] + 1
    starts = offsets_from_counts(kept + between)
    points = np.empty((starts[-1], 3), np.float32)
    tangents = lines.tangents()
    _lay(lines.points, tangents, roots, tips, order, following, between, starts, points)
    ends = np.cumsum(length)
    offsets = np.concatenate([[0], starts[ends]]).astype(np.int64)
    bridged = np.add.reduceat(gap, np.concatenate([[0], ends[:-1]])).astype(np.float32)
    return points, offsets, bridged


@numba.njit(cache=True, parallel=True)
def _lay(points, tangents, roots, tips, order, following, between, starts, out):
    for n in numba.prange(len(order)):
        at = starts[n]
        segment = order[n]
        for m in range(roots[segment], tips[segment] + 1):
            out[at] = points[m]
            at += 1
        if following[segment] < 0:
            continue
        a, b = tips[segment], roots[following[segment]]
        gap = 0.0
        for axis in range(3):
            gap += (points[b, axis] - points[a, axis]) ** 2
        gap = np.sqrt(gap)
        for m in range(between[n]):
            t = (m + 1.0) / (between[n] + 1.0)
            for axis in range(3):
                out[at, axis] = (
                    (2 * t**3 - 3 * t**2 + 1) * points[a, axis]
                    + (t**3 - 2 * t**2 + t) * gap * tangents[a, axis]
                    + (3 * t**2 - 2 * t**3) * points[b, axis]
                    + (t**3 - t**2) * gap * tangents[b, axis]
                )
            at += 1
