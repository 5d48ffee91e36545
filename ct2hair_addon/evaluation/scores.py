"""Scores of a strand set against the true one: the paper's voxel scores (4.2, Table 1) and strand scores (EVALUATION.md).

Sets too large to ask every millimetre are scored on whole strands drawn with a fixed seed; everything else is counted in full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np

from ..head import Head, HeadMesh
from ..neighbours import PointGrid, nearest_rows
from ..progress import Progress, part, silent
from ..strands import Strands
from ..volume import BRICK, BrickVolume
from .curves import curve_arcs, sample_curves
from .density import BLUR, frame_around, render_density, render_layers, strand_peak
from .spectrum import curvature_spectrum

VOXEL_BLUR = 0.8
"""Blur (sigma, voxels) of the volumes that are compared."""

HAIR_SHARE = 0.35
"""A voxel is hair where the blurred count exceeds this share of the peak of one straight strand."""

PERCENTILE = 99.0
"""Volumes are divided by this percentile of the truth (over its hair voxels) and clipped to 1 before the squared error."""

TOLERANCES = ((0.5, 10.0), (1.0, 10.0), (2.0, 20.0), (3.0, 30.0), (4.0, 40.0))
"""(mm, degrees) at which strand scores are given."""

CONSISTENCY = (2.0, 20.0)
"""(mm, degrees) of a match in the consistency score."""

NEIGHBOURS = 16
"""Points of the other set that a point is held against."""

TARGET_STEP = 0.5
"""Step (mm) at which the other set is sampled; queries are every second of such points: every millimetre."""

TANGENT_REACH = 2
"""Samples to either side of a tangent: 2 mm in all."""

ROOT_REACH = 0.5
"""A root lies on the scalp within this (mm)."""

INSIDE = 0.01
"""A point is inside the head deeper than this (mm): far more than rounding, far less than a hair."""

QUERIES = 2_000_000
"""Points asked at most, in each direction."""

DIRECTED = (2.0, 20.0)
"""(mm, degrees) within which a true strand tells a result's direction from root to tip."""

SCALP_POINTS = 4000
"""Even points of each scalp that registration is measured at."""

_LAYER_BYTES = 600e6
"""Bricks of a slab of one compared volume, roughly, where all of its box is hair."""

_BINS_PER_COUNT, _BINS = 512, 1 << 17
"""Bins of the histogram that the percentile is read from: 1/512 count wide, up to 256 counts."""

_PER_CALL = 50_000
"""Points asked in one kernel call: well under a second."""


def evaluate(
    truth: Strands,
    result: Strands,
    head: HeadMesh | Head | None = None,
    voxels: Sequence[float] = (0.5, 1.0),
    queries: int = QUERIES,
    progress: Progress = silent,
) -> dict:
    """All scores of EVALUATION.md of `result` against `truth` (one frame, mm), as plain values for JSON.

    head: the registered head in the same frame, for roots and points inside (left out without one); whoever asks about
    several strands on one gives it as a `Head`, which is made once. voxels: sizes, mm.
    queries: millimetres of strand asked at most in each direction; beyond, whole strands are drawn with a fixed seed, and
    `asked` tells how many. Keys: `voxel` {size: iou, precision, recall, mse}, `strand` {"mm/degrees": precision, recall, f},
    `consistency`, `curvature` {"shortest-longest wave, mm": truth, result; 1/m, as `curvature_spectrum` gives it},
    `roots_on_scalp`, `inside_head`, `counts`.
    """
    scores: dict = {"voxel": {}, "strand": {}}
    for n, size in enumerate(voxels):
        share = part(progress, 0.5 * n / len(voxels), 0.5 * (n + 1) / len(voxels))
        scores["voxel"][f"{size:g}"] = voxel_scores(truth, result, size, share)
    scores.update(strand_scores(truth, result, queries, part(progress, 0.5, 0.95)))
    true, found = (curvature_spectrum(each.select(_drawn(_millimetres(each), queries))) for each in (truth, result))
    scores["curvature"] = {band: {"truth": true[band], "result": found[band]} for band in true}
    if head is not None:
        scores.update(head_scores(result, head, queries))
    scores["counts"] = {
        "truth_strands": len(truth),
        "result_strands": len(result),
        "truth_length_m": float(truth.lengths().sum(dtype=np.float64) / 1000.0),
        "result_length_m": float(result.lengths().sum(dtype=np.float64) / 1000.0),
        **scores.pop("asked"),
    }
    progress(1, 1)
    return scores


def voxel_scores(truth: Strands, result: Strands, voxel: float, progress: Progress = silent) -> dict[str, float]:
    """IoU, precision, recall of hair voxels and the mean squared error over their union, at this voxel size (mm)."""
    if not len(truth.points) or not len(result.points):
        return {"iou": 0.0, "precision": 0.0, "recall": 0.0, "mse": 1.0 if len(truth.points) or len(result.points) else 0.0}
    both = np.stack([truth.points.min(axis=0), truth.points.max(axis=0), result.points.min(axis=0), result.points.max(axis=0)])
    origin, shape = frame_around(both, voxel, 6 * voxel)
    layers = -(-shape[2] // BRICK)
    per_layer = -(-shape[0] // BRICK) * -(-shape[1] // BRICK) * 4.0 * BRICK**3
    thickness = int(min(max(_LAYER_BYTES // per_layer, 1), layers))
    slabs = [(first, min(first + thickness, layers)) for first in range(0, layers, thickness)]
    arcs = curve_arcs(truth), curve_arcs(result)
    hair = HAIR_SHARE * strand_peak(VOXEL_BLUR)

    def rendered(which: int, first: int, last: int) -> BrickVolume:
        return render_layers((truth, result)[which], arcs[which], voxel, VOXEL_BLUR, origin, shape, first, last)

    histogram = np.zeros(_BINS, np.int64)
    kept = None
    for n, (first, last) in enumerate(slabs):
        progress(0.4 * n, len(slabs))
        kept = rendered(0, first, last)
        histogram += _histogram(kept.bricks, hair)
    top = _percentile(histogram)
    sums = np.zeros(4)
    for n, (first, last) in enumerate(slabs):
        progress(0.4 * len(slabs) + 0.6 * n, len(slabs))
        true = kept if len(slabs) == 1 else rendered(0, first, last)
        found = rendered(1, first, last)
        sums += _compare(true.table, true.bricks, found.table, found.bricks, hair, top).sum(axis=0)
    progress(1, 1)
    hits, missed, wrong, squared = (float(value) for value in sums)
    union = hits + missed + wrong
    return {
        "iou": hits / union if union else 1.0,
        "precision": _ratio(hits, hits + wrong),
        "recall": _ratio(hits, hits + missed),
        "mse": squared / union if union else 0.0,
        "truth_voxels": int(hits + missed),
        "result_voxels": int(hits + wrong),
    }


def strand_scores(truth: Strands, result: Strands, queries: int = QUERIES, progress: Progress = silent) -> dict:
    """Precision, recall and F at each of TOLERANCES (`strand`), `consistency`, and how much was `asked`."""
    true, found = _Samples(truth), _Samples(result)
    recalled, best, asked_truth = _matched(true, found, queries, part(progress, 0.0, 0.5))
    precise, _, asked_result = _matched(found, true, queries, part(progress, 0.5, 1.0))
    table = {}
    for n, (reach, angle) in enumerate(TOLERANCES):
        precision, recall = _ratio(precise[:, n].sum(), asked_result.sum()), _ratio(recalled[:, n].sum(), asked_truth.sum())
        both = 2.0 * precision * recall / (precision + recall) if precision + recall else 0.0
        table[f"{reach:g}/{angle:g}"] = {"precision": precision, "recall": recall, "f": both}
    consistency = float(np.mean(best / asked_truth)) if len(best) else 0.0
    asked = {"truth_points_asked": int(asked_truth.sum()), "result_points_asked": int(asked_result.sum())}
    return {"strand": table, "consistency": consistency, "asked": asked}


def head_scores(result: Strands, head: HeadMesh | Head, queries: int = QUERIES) -> dict[str, float]:
    """Share of strands rooted on the scalp, and share of points (every millimetre) inside the head."""
    surface = _as_head(head)
    strands = result.select(result.counts > 0)
    if not len(strands):
        return {"roots_on_scalp": 0.0, "inside_head": 0.0}
    on_scalp = surface.closest_scalp(strands.roots).distance <= ROOT_REACH
    points = sample_curves(strands.select(_drawn(_millimetres(strands), queries)), 2.0 * TARGET_STEP).points
    depth = surface.signed_distance(points, INSIDE)
    return {"roots_on_scalp": float(on_scalp.mean()), "inside_head": float((depth < -INSIDE).mean())}


def _as_head(head: HeadMesh | Head) -> Head:
    return head if isinstance(head, Head) else Head(head)


def direction_share(result: Strands, truth: Strands, queries: int = QUERIES) -> dict[str, float]:
    """Share of the result's length, every millimetre, that runs root to tip as the truth does (`right`).

    A point is asked of the nearest of its 16 nearest true points within 2 mm whose tangent lies within 20 degrees, sign
    ignored; `compared` is the share of the length with one. FINDINGS.md and issue 4 give directions so.
    """
    true, found = _Samples(truth), _Samples(result)
    which = _drawn((np.diff(found.offsets) + 1) // 2, queries)
    asked = found.strands.select(which)
    tangents = asked.tangents(TANGENT_REACH)
    points, tangents = asked.points[::2], tangents[::2]
    right = compared = 0
    for start in range(0, len(points), _PER_CALL):
        some = slice(start, start + _PER_CALL)
        index, _ = true.grid.nearest(points[some], NEIGHBOURS, DIRECTED[0])
        cosine = np.einsum("mkc,mc->mk", true.tangents[np.maximum(index, 0)], tangents[some])
        fits = (index >= 0) & (np.abs(cosine) >= math.cos(math.radians(DIRECTED[1])))
        first = fits.argmax(axis=1)
        rows = np.arange(len(first))
        has = fits[rows, first]
        compared += int(has.sum())
        right += int((cosine[rows, first][has] > 0.0).sum())
    return {"right": _ratio(right, compared), "compared": _ratio(compared, len(points))}


def rooted_length(strands: Strands, head: HeadMesh | Head) -> float:
    """Share of the length that lies on strands whose first point is on the scalp (ROOT_REACH)."""
    kept = strands.select(strands.counts > 0)
    if not len(kept):
        return 0.0
    rooted = _as_head(head).closest_scalp(kept.roots).distance <= ROOT_REACH
    lengths = kept.lengths().astype(np.float64)
    return _ratio(lengths[rooted].sum(), lengths.sum())


def registration_error(found: HeadMesh, true: HeadMesh) -> dict[str, float]:
    """Distance (mm) from even points of the true scalp to the fitted one, one frame: median, 90th percentile; and
    `beyond`, the same median from the fitted scalp to the true one, which grows where too much skin became scalp."""
    fitted, truth = Head(found), Head(true)
    there = fitted.closest_scalp(truth.sample_scalp(SCALP_POINTS, 0).position).distance
    back = truth.closest_scalp(fitted.sample_scalp(SCALP_POINTS, 0).position).distance
    return {**_spread(there), "beyond": float(np.median(back))}


def orientation_error(points: np.ndarray, directions: np.ndarray, truth: Strands, reach: float = 2.0) -> dict[str, float]:
    """Degrees between directions (M, 3) at points (M, 3; mm) and the tangent of the nearest true strand, sign ignored.

    Points with no true strand within `reach` mm are left out. Median, 90th percentile and the share compared.
    """
    samples = _Samples(truth)
    index, _ = samples.grid.nearest(points, 1, reach)
    near = index[:, 0] >= 0
    direction = np.asarray(directions, np.float64)[near]
    norm = np.linalg.norm(direction, axis=1)
    cosine = np.abs((direction * samples.tangents[index[near, 0]]).sum(axis=1)) / np.maximum(norm, 1e-12)
    return {**_spread(np.degrees(np.arccos(np.clip(cosine[norm > 0], 0.0, 1.0)))), "compared": float(near.mean())}


def centre_line_error(strands: Strands, truth: Strands, reach: float = 4.0) -> dict[str, float]:
    """Distance (mm) of strands, every millimetre, from the centre line of the nearest true strand: median, 90th percentile.

    The distance is that from the tangent line of the nearest sample, so that sampling adds nothing to it. Points with no
    true strand within `reach` mm are left out; `compared` is the share that is left.
    """
    samples = _Samples(truth)
    points = sample_curves(strands, 2.0 * TARGET_STEP).points
    index, _ = samples.grid.nearest(points, 1, reach)
    near = index[:, 0] >= 0
    away = points[near].astype(np.float64) - samples.points[index[near, 0]]
    tangent = samples.tangents[index[near, 0]]
    across = away - (away * tangent).sum(axis=1, keepdims=True) * tangent
    return {**_spread(np.linalg.norm(across, axis=1)), "compared": float(near.mean()) if len(near) else 0.0}


def coverage(strands: Strands, density: BrickVolume, hair_level: float, reach: float, queries: int = 200_000) -> float:
    """Share of the scan's hair voxels (above `hair_level`) with a strand within `reach` mm, on at most `queries` of them."""
    rows, *inside = np.nonzero(density.bricks > hair_level)
    if not len(rows):
        return 0.0
    which = np.random.default_rng(0).permutation(len(rows))[:queries] if len(rows) > queries else np.arange(len(rows))
    voxels = density.brick_index[rows[which]].astype(np.int64) * BRICK + np.stack([axis[which] for axis in inside], axis=1)
    grid = PointGrid.build(sample_curves(strands, TARGET_STEP).points)
    index, _ = grid.nearest(density.to_scan(voxels), 1, reach)
    return float((index[:, 0] >= 0).mean())


def hair_kept(truth: Strands, density: BrickVolume) -> float:
    """Share of the true strands' length that a wig's density holds: what is cleared or not stored is 0 there."""
    return float(np.mean(density.sample(sample_curves(truth, 2.0 * TARGET_STEP).points) != 0.0))


def scan_scores(strands: Strands, density: BrickVolume, strand_level: float, progress: Progress = silent) -> dict[str, float]:
    """Scores of strands against the scan that they were made from, where there is no truth.

    density: air subtracted; strand_level: a lone strand's peak above air. The strands are rendered through the scanner's
    blur on the scan's own lattice; both volumes are averaged over 2 x 2 x 2 voxels, which takes the noise from a lone
    strand's third to its tenth, and are hair above HAIR_SHARE of a lone strand. Keys as in `voxel_scores`, and `voxel` (mm).
    """
    box = density.shape
    made = render_density(strands, density.spacing, BLUR, density.origin, box, progress)
    scale = strand_level / strand_peak(BLUR)
    sums = _compare_halved(density.table, density.bricks, made.table, made.bricks, scale, HAIR_SHARE * strand_level)
    hits, missed, wrong, squared, top = (float(value) for value in sums.sum(axis=0))
    union = hits + missed + wrong
    return {
        "iou": hits / union if union else 1.0,
        "precision": _ratio(hits, hits + wrong),
        "recall": _ratio(hits, hits + missed),
        "mse": squared / top if top else 0.0,
        "voxel": 2.0 * density.spacing,
    }


def format_scores(scores: dict) -> str:
    """The scores as a plain table for a terminal."""
    lines = ["voxels    size      IoU  precision  recall     MSE"]
    lines += [
        f"        {size:>4} mm   {s['iou']:.3f}      {s['precision']:.3f}   {s['recall']:.3f}  {s['mse']:.4f}"
        for size, s in scores["voxel"].items()
    ]
    lines.append("strands   mm/deg      F  precision  recall")
    lines += [
        f"       {name:>8}    {s['f']:.3f}      {s['precision']:.3f}   {s['recall']:.3f}"
        for name, s in scores["strand"].items()
    ]
    lines.append(f"consistency       {scores['consistency']:.3f}")
    lines.append("bends     wave, mm  curvature  truth's (rms, 1/m)")
    lines += [f"       {band:>8}    {rms['result']:7.2f}  {rms['truth']:7.2f}" for band, rms in scores["curvature"].items()]
    if "roots_on_scalp" in scores:
        lines.append(f"roots on scalp    {100 * scores['roots_on_scalp']:.2f} %")
        lines.append(f"inside the head   {100 * scores['inside_head']:.3f} %")
    counts = scores["counts"]
    lines.append(
        f"strands           {counts['result_strands']} of {counts['result_length_m']:.0f} m "
        f"(truth {counts['truth_strands']} of {counts['truth_length_m']:.0f} m)"
    )
    return "\n".join(lines)


class _Samples:
    """A strand set sampled for the strand scores: points every TARGET_STEP, their tangents, their strands, and a grid."""

    def __init__(self, strands: Strands) -> None:
        self.strands = samples = sample_curves(strands.select(strands.counts > 0), TARGET_STEP)
        self.points, self.offsets = samples.points, samples.offsets
        self.tangents = samples.tangents(TANGENT_REACH)
        self.strand = samples.strand_index.astype(np.int32)
        self.grid = PointGrid.build(samples.points)


def _drawn(points: np.ndarray, queries: int) -> np.ndarray:
    """Index of the strands to ask: all, or as many drawn with a fixed seed as hold `queries` points."""
    if points.sum() <= queries:
        return np.arange(len(points))
    order = np.random.default_rng(0).permutation(len(points))
    return np.sort(order[: max(int(np.searchsorted(np.cumsum(points[order]), queries)), 1)])


def _millimetres(strands: Strands) -> np.ndarray:
    """(N,) how many points each strand has at every millimetre, 1 at least."""
    return np.maximum(strands.lengths(), 1.0)


def _matched(source: _Samples, target: _Samples, queries: int, progress: Progress):
    """Of each strand asked: points matched at each tolerance (S, 5), points matched by its best strand (S,), points (S,)."""
    points = (np.diff(source.offsets) + 1) // 2
    which = _drawn(points, queries)
    matched, best = np.zeros((len(which), len(TOLERANCES)), np.int64), np.zeros(len(which), np.int64)
    reach = np.array([each[0] for each in TOLERANCES])
    cosine = np.array([math.cos(math.radians(each[1])) for each in TOLERANCES])
    grid = target.grid
    tangents, strand = target.tangents[grid.order], target.strand[grid.order]
    ends = np.cumsum(points[which])
    start = 0
    while start < len(which):
        progress(start, len(which))
        end = max(int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _PER_CALL)), start + 1)
        _match(
            source.points,
            source.tangents,
            source.offsets,
            which[start:end],
            grid.points,
            grid.order,
            grid.start,
            grid.size,
            grid.cell,
            grid.low,
            tangents,
            strand,
            reach * reach,
            cosine,
            CONSISTENCY[0] ** 2,
            math.cos(math.radians(CONSISTENCY[1])),
            matched[start:end],
            best[start:end],
        )
        start = end
    return matched, best, points[which]


def _ratio(part_: float, whole: float) -> float:
    return float(part_ / whole) if whole else 0.0


def _spread(values: np.ndarray) -> dict[str, float]:
    if not len(values):
        return {"median": float("nan"), "p90": float("nan")}
    return {"median": float(np.median(values)), "p90": float(np.percentile(values, 90))}


def _percentile(histogram: np.ndarray) -> float:
    """The PERCENTILE of the values binned in `histogram`, 1 where there are none."""
    total = histogram.sum()
    if not total:
        return 1.0
    return float((np.searchsorted(np.cumsum(histogram), total * PERCENTILE / 100.0) + 1) / _BINS_PER_COUNT)


def _histogram(bricks: np.ndarray, hair: float) -> np.ndarray:
    values = bricks[bricks > hair]
    return np.bincount(np.minimum((values * _BINS_PER_COUNT).astype(np.int64), _BINS - 1), minlength=_BINS)


@numba.njit(cache=True, parallel=True)
def _compare(true_table, true_bricks, found_table, found_bricks, hair, top):
    """(bricks, 4) float64: voxels that are hair in both, in the truth only, in the result only; squared error on them."""
    count = true_table.size
    sums = np.zeros((count, 4))
    size_y, size_z = true_table.shape[1], true_table.shape[2]
    for n in numba.prange(count):
        I, J, K = n // (size_y * size_z), (n // size_z) % size_y, n % size_z
        a, b = true_table[I, J, K], found_table[I, J, K]
        if a < 0 and b < 0:
            continue
        for i in range(BRICK):
            for j in range(BRICK):
                for k in range(BRICK):
                    true = true_bricks[a, i, j, k] if a >= 0 else np.float32(0.0)
                    found = found_bricks[b, i, j, k] if b >= 0 else np.float32(0.0)
                    if true > hair or found > hair:
                        sums[n, 0 if (true > hair and found > hair) else (1 if true > hair else 2)] += 1.0
                        error = min(true / top, 1.0) - min(found / top, 1.0)
                        sums[n, 3] += error * error
    return sums


@numba.njit(cache=True, parallel=True)
def _compare_halved(scan_table, scan_bricks, made_table, made_bricks, scale, hair):
    """(bricks, 5) float64 over voxels of twice the size: as `_compare`, then the scan's squares to divide the error by."""
    count = scan_table.size
    sums = np.zeros((count, 5))
    size_y, size_z = scan_table.shape[1], scan_table.shape[2]
    for n in numba.prange(count):
        I, J, K = n // (size_y * size_z), (n // size_z) % size_y, n % size_z
        a, b = scan_table[I, J, K], made_table[I, J, K]
        if a < 0 and b < 0:
            continue
        for i in range(0, BRICK, 2):
            for j in range(0, BRICK, 2):
                for k in range(0, BRICK, 2):
                    scan, made = 0.0, 0.0
                    for c in range(8):
                        x, y, z = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
                        if a >= 0:
                            scan += scan_bricks[a, x, y, z]
                        if b >= 0:
                            made += scale * made_bricks[b, x, y, z]
                    scan, made = scan / 8.0, made / 8.0
                    if scan > hair or made > hair:
                        sums[n, 0 if (scan > hair and made > hair) else (1 if scan > hair else 2)] += 1.0
                        sums[n, 3] += (scan - made) ** 2
                        sums[n, 4] += scan * scan
    return sums


@numba.njit(cache=True, parallel=True)
def _match(
    points,
    tangents,
    offsets,
    which,
    grid_points,
    order,
    start,
    size,
    cell,
    low,
    grid_tangents,
    grid_strand,
    reach2,
    cosine,
    own_reach2,
    own_cosine,
    matched,
    best,
):
    """Hold every second sample of the strands `which` against the nearest points of the grid."""
    largest = np.sqrt(reach2.max())
    for s in numba.prange(len(which)):
        if len(grid_points) == 0:
            continue
        first, end = offsets[which[s]], offsets[which[s] + 1]
        rows = np.empty(NEIGHBOURS, np.int64)
        squared = np.empty(NEIGHBOURS)
        met = np.empty(NEIGHBOURS * ((end - first + 1) // 2), np.int32)
        meetings = 0
        for m in range(first, end, 2):
            x, y, z = np.float64(points[m, 0]), np.float64(points[m, 1]), np.float64(points[m, 2])
            found = nearest_rows(grid_points, order, start, size, cell, low, x, y, z, largest, rows, squared)
            known = meetings
            for t in range(len(reach2)):
                for n in range(found):
                    if squared[n] <= reach2[t] and _aligned(tangents, m, grid_tangents, rows[n]) >= cosine[t]:
                        matched[s, t] += 1
                        break
            for n in range(found):
                if squared[n] <= own_reach2 and _aligned(tangents, m, grid_tangents, rows[n]) >= own_cosine:
                    strand = grid_strand[rows[n]]
                    new = True
                    for each in range(known, meetings):
                        if met[each] == strand:
                            new = False
                    if new:
                        met[meetings] = strand
                        meetings += 1
        ordered = np.sort(met[:meetings])
        run = 0
        for each in range(meetings):
            run = run + 1 if each > 0 and ordered[each] == ordered[each - 1] else 1
            best[s] = max(best[s], run)


@numba.njit(cache=True, inline="always")
def _aligned(tangents, m, others, row):
    """|cosine| between two unit tangents; 1 between two points without any, so that lone points can match."""
    a = tangents[m, 0] * tangents[m, 0] + tangents[m, 1] * tangents[m, 1] + tangents[m, 2] * tangents[m, 2]
    b = others[row, 0] * others[row, 0] + others[row, 1] * others[row, 1] + others[row, 2] * others[row, 2]
    if a == 0.0 and b == 0.0:
        return 1.0
    dot = tangents[m, 0] * others[row, 0] + tangents[m, 1] * others[row, 1] + tangents[m, 2] * others[row, 2]
    # float32 unit vectors: a tangent and itself may come out a hair under 1
    return abs(dot) + 1e-6
