"""Segments joined into whole strands: which tip goes on in which root end, for all of them at once (in place of 3.2.2).

A trace ends where strands touch and goes on, under another name, where they part. Every tip end is held against the root
ends that lie on its course; a joint costs what it bends more than hair does, what it bridges, and what the scan doesn't back.
The cheapest set of joints in which no end is used twice is an assignment problem, solved exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching
from scipy.spatial import cKDTree

from ..progress import Progress, silent
from ..strands import Strands, offsets_from_counts
from ..volume.grid import BrickVolume, trilinear

CUTS = (0.0, 2.5, 5.0, 8.0)
"""voxel; a trace may have gone too far, onto a neighbour: a joint may leave it this far before its end."""
STATIONS = ((2.0, 3.5), (7.0, 4.5), (14.0, 5.5), (23.0, 7.0), (34.0, 8.5))
"""voxel; root ends are looked for around these points ahead of a tip, within these radii."""
NEAREST = 12
"""Root ends looked at around each station."""
SPAN = 9.0
"""voxel; the length at an end that its course is fitted to."""
PLACE = (0.75, 0.09)
"""voxel, and voxel a voxel of gap: how far the two courses may miss each other in the middle of a gap."""
TURN = (0.16, 0.012)
"""radian, and radian a voxel of gap: by how much their directions may differ there."""
PER_VOXEL = 0.10
UNBACKED = 6.0
"""Cost of a voxel of gap, and of a gap that the scan does not back at all."""
PER_CUT = 0.25
"""Cost of a voxel that is cut off a trace."""
LOOSE_END = 14.0
"""Cost of a tip that goes on nowhere: joints dearer than this are not made."""
STEP = 1.0
"""voxel between the points of a joint."""


@dataclass(frozen=True)
class _Joints:
    """Candidates: strand `tip` goes on in strand `root`; `cut` points are left off the tip; cost."""

    tip: np.ndarray
    root: np.ndarray
    cut: np.ndarray
    cost: np.ndarray


def link_segments(
    segments: Strands,
    rooted: np.ndarray,
    density: BrickVolume,
    strand: float,
    progress: Progress = silent,
) -> tuple[Strands, np.ndarray, np.ndarray, dict[str, int]]:
    """Chains of directed segments (mm, scan frame, root end first).

    rooted: (N,) bool, segments whose first point is a root on the scalp: nothing goes on into them. density: the scan; strand:
    a lone strand's density on its centre line as trilinear reads see it. Returns (chains, (C,) bool rooted, (C,) float32 mm
    bridged in each, tally).
    """
    voxel = density.spacing
    lines = segments.resampled_by_step(STEP * voxel)
    count = len(lines)
    rooted = np.asarray(rooted, bool)
    if count < 2:
        return lines, rooted, np.zeros(count, np.float32), {"segments joined": 0}
    joints = _candidates(lines, rooted, density, strand, progress)
    following, cut = _assigned(count, joints)
    progress(0.8, 1.0)
    following, broken = _without_rings(following, joints)
    chain, position, length = _chains(following)
    points, offsets, bridged = _joined(lines, following, cut, chain, position, length, voxel)
    firsts = np.flatnonzero(position == 0)
    order = np.argsort(chain[firsts])
    tally = {
        "joints weighed": len(joints.cost),
        "segments joined": int((following >= 0).sum()),
        "joints undone: they closed a ring": broken,
        "strands after joining": len(offsets) - 1,
    }
    progress(1.0, 1.0)
    return Strands(points, offsets), rooted[firsts[order]], bridged, tally


def _courses(lines: Strands, from_root: bool, cut: float, voxel: float):
    """(valid (N,), place, tangent, bend (N, 3)): the course of each strand as it leaves its end, in voxels.

    A parabola is fitted to SPAN voxels before the end (for root ends: after it); tangent and bend (second derivative) are
    those along the outward direction.
    """
    counts = lines.counts
    skip = round(cut / STEP)
    window = round(SPAN / STEP)
    valid = counts > max(skip + 4, 2 * skip)
    index = np.where(valid, (lines.offsets[:-1] + skip) if from_root else (lines.offsets[1:] - 1 - skip), lines.offsets[:-1])
    place = np.zeros((len(lines), 3))
    tangent = np.zeros((len(lines), 3))
    bend = np.zeros((len(lines), 3))
    _fit_ends(
        lines.points, lines.offsets, index, 1 if from_root else -1, window, STEP * voxel, valid, place, tangent, bend
    )  # fmt: skip
    return valid, place / voxel, tangent, bend * voxel


@numba.njit(cache=True, parallel=True)
def _fit_ends(points, offsets, index, way, window, step, valid, place, tangent, bend):
    for n in numba.prange(len(index)):
        if not valid[n]:
            continue
        room = offsets[n + 1] - 1 - index[n] if way > 0 else index[n] - offsets[n]
        size = min(window, room) + 1
        # t runs from 0 at the end into the strand; a parabola by least squares
        s0 = s1 = s2 = s3 = s4 = 0.0
        for m in range(size):
            t = m * step
            s0 += 1.0
            s1 += t
            s2 += t * t
            s3 += t * t * t
            s4 += t * t * t * t
        det = s0 * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s2 * s3) + s2 * (s1 * s3 - s2 * s2)
        for axis in range(3):
            m0 = m1 = m2 = 0.0
            for m in range(size):
                t = m * step
                value = points[index[n] + way * m, axis]
                m0 += value
                m1 += t * value
                m2 += t * t * value
            if size >= 4 and abs(det) > 1e-12:
                a = (m0 * (s2 * s4 - s3 * s3) - s1 * (m1 * s4 - m2 * s3) + s2 * (m1 * s3 - m2 * s2)) / det
                b = (s0 * (m1 * s4 - m2 * s3) - m0 * (s1 * s4 - s2 * s3) + s2 * (s1 * m2 - s2 * m1)) / det
                c = (s0 * (s2 * m2 - s3 * m1) - s1 * (s1 * m2 - s2 * m1) + m0 * (s1 * s3 - s2 * s2)) / det
            else:
                a = points[index[n], axis]
                b = (points[index[n] + way * (size - 1), axis] - a) / max((size - 1) * step, 1e-9)
                c = 0.0
            place[n, axis], tangent[n, axis], bend[n, axis] = a, -b, 2.0 * c
        norm = np.sqrt(tangent[n, 0] ** 2 + tangent[n, 1] ** 2 + tangent[n, 2] ** 2)
        for axis in range(3):
            tangent[n, axis] /= max(norm, 1e-9)


def _candidates(lines: Strands, rooted: np.ndarray, density: BrickVolume, strand: float, progress: Progress) -> _Joints:
    """All joints worth weighing, the cheapest for each pair."""
    voxel = density.spacing
    root_valid, root_place, root_out, root_bend = _courses(lines, True, 0.0, voxel)
    targets = np.flatnonzero(root_valid & ~rooted)
    nothing = _Joints(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    if not len(targets):
        return nothing
    tree = cKDTree(root_place[targets])
    found = []
    for number, cut in enumerate(CUTS):
        progress(0.7 * number / len(CUTS), 1.0)
        valid, place, out, bend = _courses(lines, False, cut, voxel)
        tips = np.flatnonzero(valid)
        if not len(tips):
            continue
        pairs = []
        for ahead, radius in STATIONS:
            for bent in (0.0, 0.5):
                centre = place[tips] + ahead * out[tips] + bent * ahead**2 * bend[tips]
                distance, near = tree.query(centre, k=min(NEAREST, len(targets)), distance_upper_bound=radius)
                row, column = np.nonzero(np.isfinite(distance.reshape(len(tips), -1)))
                near = near.reshape(len(tips), -1)
                pairs.append(tips[row].astype(np.int64) * len(lines) + targets[near[row, column]])
        pair = np.unique(np.concatenate(pairs))
        tip, root = pair // len(lines), pair % len(lines)
        kept = tip != root
        tip, root = tip[kept], root[kept]
        cost = np.empty(len(tip))
        _weigh(
            tip, root, place, out, bend, root_place, root_out, root_bend, density.table, density.bricks,
            density.origin / voxel, np.float32(strand), cost,
        )  # fmt: skip
        cost += PER_CUT * cut
        kept = cost < LOOSE_END
        shift = np.full(int(kept.sum()), round(cut / STEP), np.int64)
        found.append((tip[kept], root[kept], shift, cost[kept]))
    if not found:
        return nothing
    tip, root, cut, cost = (np.concatenate(columns) for columns in zip(*found, strict=True))
    order = np.lexsort((cut, cost, root, tip))
    tip, root, cut, cost = tip[order], root[order], cut[order], cost[order]
    first = np.ones(len(tip), bool)
    first[1:] = (tip[1:] != tip[:-1]) | (root[1:] != root[:-1])
    return _Joints(tip[first], root[first], cut[first], cost[first])


@numba.njit(cache=True, parallel=True)
def _weigh(tip, root, place, out, bend, root_place, root_out, root_bend, table, bricks, origin, strand, cost):
    """The cost of each joint (see the constants): the two courses, extended to the middle of the gap, must meet."""
    for n in numba.prange(len(tip)):
        a, b = tip[n], root[n]
        gap = 0.0
        forward = 0.0
        for axis in range(3):
            apart = root_place[b, axis] - place[a, axis]
            gap += apart * apart
            forward += apart * (out[a, axis] - root_out[b, axis]) * 0.5
        gap = np.sqrt(gap)
        if forward < -1.0 or forward < 0.5 * gap - 1.5:
            cost[n] = 1e9
            continue
        half = 0.5 * max(forward, 0.0)
        best = 1e9
        for curved in range(2):
            miss = turn = 0.0
            norm_a = norm_b = dot = 0.0
            for axis in range(3):
                pa, ta = place[a, axis] + half * out[a, axis], out[a, axis]
                pb, tb = root_place[b, axis] + half * root_out[b, axis], root_out[b, axis]
                if curved:
                    pa += 0.5 * half * half * bend[a, axis]
                    pb += 0.5 * half * half * root_bend[b, axis]
                    ta += half * bend[a, axis]
                    tb += half * root_bend[b, axis]
                miss += (pa - pb) ** 2
                norm_a += ta * ta
                norm_b += tb * tb
                dot -= ta * tb
            turn = np.arccos(min(max(dot / np.sqrt(max(norm_a * norm_b, 1e-12)), -1.0), 1.0))
            value = miss / (PLACE[0] + PLACE[1] * gap) ** 2 + (turn / (TURN[0] + TURN[1] * gap)) ** 2
            best = min(best, value)
        backed = 0.0
        many = int(gap) + 1
        for m in range(many):
            t = (m + 0.5) / many
            wa, wb = 2 * t**3 - 3 * t**2 + 1, 3 * t**2 - 2 * t**3
            va, vb = (t**3 - 2 * t**2 + t) * gap, (t**3 - t**2) * gap
            x = wa * place[a, 0] + va * out[a, 0] + wb * root_place[b, 0] - vb * root_out[b, 0] - origin[0]
            y = wa * place[a, 1] + va * out[a, 1] + wb * root_place[b, 1] - vb * root_out[b, 1] - origin[1]
            z = wa * place[a, 2] + va * out[a, 2] + wb * root_place[b, 2] - vb * root_out[b, 2] - origin[2]
            backed += min(max(trilinear(table, bricks, np.float32(0.0), x, y, z) / strand, 0.0), 1.0)
        cost[n] = best + PER_VOXEL * gap + UNBACKED * (1.0 - backed / many) * min(gap / 4.0, 1.0)


def _assigned(count: int, joints: _Joints) -> tuple[np.ndarray, np.ndarray]:
    """(following (N,): the segment that each goes on in, -1 for none; cut (N,) points left off its tip) at the least cost."""
    following, cut = np.full(count, -1, np.int64), np.zeros(count, np.int64)
    if not len(joints.cost):
        return following, cut
    tips, row = np.unique(joints.tip, return_inverse=True)
    roots, column = np.unique(joints.root, return_inverse=True)
    # a tip that goes on nowhere is matched to a column of its own; costs must not be 0 in a sparse matrix
    size = len(tips)
    rows = np.concatenate([row, np.arange(size)])
    columns = np.concatenate([column, len(roots) + np.arange(size)])
    costs = np.concatenate([joints.cost, np.full(size, LOOSE_END)]) + 1.0
    graph = coo_matrix((costs, (rows, columns)), shape=(size, len(roots) + size)).tocsr()
    matched_row, matched_column = min_weight_full_bipartite_matching(graph)
    joined = matched_column < len(roots)
    tip, root = tips[matched_row[joined]], roots[matched_column[joined]]
    following[tip] = root
    key = joints.tip * count + joints.root
    cut[tip] = joints.cut[np.searchsorted(key, tip * count + root)]
    return following, cut


def _without_rings(following: np.ndarray, joints: _Joints) -> tuple[np.ndarray, int]:
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
    tips = lines.offsets[1:] - 1 - cut
    roots = lines.offsets[:-1]
    linked = following[order] >= 0
    gap = np.zeros(len(order))
    after = following[order][linked]
    gap[linked] = np.linalg.norm(lines.points[roots[after]] - lines.points[tips[order][linked]], axis=1)
    between = np.where(linked, np.maximum(np.ceil(gap / (STEP * voxel)).astype(np.int64) - 1, 0), 0)
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
