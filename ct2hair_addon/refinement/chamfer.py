"""The paper's refinement (3.3.2, eqs. 4 to 6, supplement 4): Chamfer distance between points of strands and of the scan.

Neighbouring strands are optimised together in batches, each against the target points nearest to it, with Adam on the
control points of cubic curves. Runs on CUDA where torch has it, else on the CPU.
"""

from __future__ import annotations

import numba
import numpy as np
import torch

from ..neighbours import PointGrid
from ..progress import Progress, part, silent
from ..settings import RefinementSettings
from ..volume import BRICK, BrickVolume
from .boundary import Boundary
from .device import takes_card

BINS = 4
"""Bins of density (n_d, not given in the paper): a voxel of the i-th bin holds i target points."""
TOP_QUANTILE = 0.99
"""Density at which the last bin begins, as a quantile over hair voxels: single bright voxels must not stretch the bins."""
CURVE_POINTS = 64
"""Points of each strand after cubic interpolation (supplement 4)."""
BETAS = (0.9, 0.999)
BATCH_BYTES = 1e9
"""Room on a graphics card that a batch of the usual size takes at most."""
SEARCH = 12
"""Voxels around a strand point within which its nearest target points are looked for, ring by ring; the paper gives no limit,
and a point farther than this from all hair is pulled by none."""


def fit_to_points(
    points: np.ndarray,
    offsets: np.ndarray,
    density: BrickVolume,
    hair_level: float,
    boundary: Boundary,
    settings: RefinementSettings,
    seed: int,
    device: str = "auto",
    progress: Progress = silent,
) -> tuple[np.ndarray, dict[str, int]]:
    """Move control points (M, 3) float64 mm, strands by `offsets`, to the scan's points. Returns new points and a tally.

    Unlike in the paper, roots are held on the scalp and points are kept out of the head after each step: a Chamfer
    distance alone pulls the former off it, the scan being empty there. device: auto, cpu or cuda, of the optimiser; targets
    are looked for by the processor.
    """
    place = torch.device("cuda" if takes_card(device, BATCH_BYTES) else "cpu")
    points = np.array(points, np.float64)
    bins = density_bins(density, hair_level)
    sums = {"batches": 0, "iterations": 0, "batches that converged": 0}
    groups = batches(points[offsets[:-1]], settings.batch)
    for number, group in enumerate(groups):
        share = part(progress, number / len(groups), (number + 1) / len(groups))
        rows = np.concatenate([np.arange(offsets[n], offsets[n + 1]) for n in group])
        own = np.concatenate([[0], np.cumsum(np.diff(offsets)[group])])
        moved, iterations, converged = _fit_batch(
            points[rows], own, density, bins, boundary, settings, seed, place, share
        )  # fmt: skip
        points[rows] = moved
        sums["batches"] += 1
        sums["iterations"] += iterations
        sums["batches that converged"] += converged
    return points, sums


def density_bins(density: BrickVolume, hair_level: float) -> BrickVolume:
    """uint8 bricks: 0 where there is no hair, else the bin 1..BINS of the voxel's density = its number of target points."""
    hair = density.bricks[density.bricks > hair_level]
    top = float(np.quantile(hair, TOP_QUANTILE)) if len(hair) else hair_level + 1.0
    width = max((top - hair_level) / BINS, 1e-9)
    bricks = np.zeros(density.bricks.shape, np.uint8)
    for row in range(0, len(bricks), 256):
        some = density.bricks[row : row + 256]
        bricks[row : row + 256] = np.where(some > hair_level, np.clip((some - hair_level) / width + 1.0, 1, BINS), 0)
    return BrickVolume(density.table, bricks, density.spacing, density.origin)


def batches(roots: np.ndarray, size: int) -> list[np.ndarray]:
    """Groups of about `size` strands with neighbouring roots (N, 3): halves along the longest side, again and again."""
    groups, done = [np.arange(len(roots))], []
    while groups:
        group = groups.pop(0)
        if len(group) <= size:
            done.append(np.sort(group))
            continue
        axis = int(np.argmax(np.ptp(roots[group], axis=0)))
        order = group[np.argsort(roots[group, axis], kind="stable")]
        parts = -(-len(group) // size)
        middle = len(group) * (parts // 2) // parts
        groups[:0] = [order[:middle], order[middle:]]
    return done


def _fit_batch(start, offsets, density, bins, boundary, settings, seed, device, progress):
    """One batch: (M, 3) control points after at most `settings.iterations` steps, their number, whether it converged."""
    weights, owners = _cubic_matrix(offsets, device)
    origin = torch.tensor(density.origin, dtype=torch.float32, device=device)
    control = torch.tensor(start, dtype=torch.float32, device=device, requires_grad=True)
    optimiser = torch.optim.Adam([control], lr=settings.rate, betas=BETAS)
    first = _directions(_curve(control.detach(), weights, owners))
    lengths = first.norm(dim=2)
    last = first
    best, loss_before = None, np.inf
    for iteration in range(settings.iterations):
        progress(iteration, settings.iterations)
        if iteration % 10 == 0:
            boundary.look(control.detach().cpu().numpy().astype(np.float64))
        curve = _curve(control, weights, owners)
        flat = curve.reshape(-1, 3)
        found, targets = nearest_targets(
            bins, ((flat.detach() - origin) / density.spacing).cpu().numpy().astype(np.float64), settings.targets, seed
        )
        loss = curve.new_zeros(())
        if len(targets):
            reached = np.flatnonzero(found >= 0)
            goal = torch.tensor(targets * density.spacing + density.origin, dtype=torch.float32, device=device)
            pick = torch.from_numpy(found[reached]).to(device)
            drawn = flat[torch.from_numpy(reached).to(device)]
            loss = loss + (drawn - goal[pick]).square().sum()
            ours = PointGrid.build(flat.detach().cpu().numpy())
            near = torch.from_numpy(ours.nearest(goal.cpu().numpy(), 1, np.inf)[0][:, 0]).to(device)
            loss = loss + (flat.index_select(0, near) - goal).square().sum() * (len(reached) / len(targets))
        now = _directions(curve)
        size = now.norm(dim=2)
        tangent = now / size.clamp_min(1e-9)[..., None]
        before = last / last.norm(dim=2).clamp_min(1e-9)[..., None]
        loss = loss + settings.length_weight * (size - lengths).square().sum()
        turn = ((now - last) * before).sum(dim=2).square() + ((last - now) * tangent).sum(dim=2).square()
        loss = loss + settings.tangent_weight * turn.sum()
        optimiser.zero_grad()
        loss.backward()
        last = now.detach()
        value = float(loss.detach())
        if not np.isfinite(value):
            break
        best = control.detach().cpu().numpy().astype(np.float64)
        if abs(loss_before - value) <= settings.patience:
            return best, iteration + 1, True
        loss_before = value
        optimiser.step()
        with torch.no_grad():
            stepped = control.cpu().numpy().astype(np.float64)
            stepped[offsets[:-1]] = start[offsets[:-1]]
            boundary.push(stepped, offsets)
            control.copy_(torch.tensor(stepped, dtype=torch.float32))
    else:
        best = control.detach().cpu().numpy().astype(np.float64)
    if best is None:
        best = start
    best[offsets[:-1]] = start[offsets[:-1]]
    return best, settings.iterations, False


def _directions(curve: torch.Tensor) -> torch.Tensor:
    """(N, CURVE_POINTS - 1, 3): dir(S_i) = S_(i+1) - S_i (eq. 4)."""
    return curve[:, 1:] - curve[:, :-1]


def _cubic_matrix(offsets: np.ndarray, device) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (N, CURVE_POINTS, 4) and control point indices of Cu(P_s): Catmull-Rom curves at even parameters."""
    counts = np.diff(offsets)
    place = np.linspace(0.0, 1.0, CURVE_POINTS)[None] * (counts - 1)[:, None]
    segment = np.minimum(place.astype(np.int64), (counts - 2)[:, None])
    t = place - segment
    at_start, at_end = segment == 0, segment == (counts - 2)[:, None]
    a = ((-0.5 * t + 1.0) * t - 0.5) * t
    b = (1.5 * t - 2.5) * t * t + 1.0
    c = ((-1.5 * t + 2.0) * t + 0.5) * t
    d = (0.5 * t - 0.5) * t * t
    # At a strand's ends the missing control point is the mirror image of its neighbour.
    b, c = b + np.where(at_start, 2.0 * a, -0.0), c - np.where(at_start, a, 0.0)
    c, b = c + np.where(at_end, 2.0 * d, 0.0), b - np.where(at_end, d, 0.0)
    a, d = np.where(at_start, 0.0, a), np.where(at_end, 0.0, d)
    weights = np.stack([a, b, c, d], axis=2)
    owners = offsets[:-1][:, None, None] + np.clip(segment[..., None] + np.arange(-1, 3), 0, (counts - 1)[:, None, None])
    return (
        torch.tensor(weights, dtype=torch.float32, device=device),
        torch.tensor(owners, dtype=torch.int64, device=device),
    )


def _curve(control: torch.Tensor, weights: torch.Tensor, owners: torch.Tensor) -> torch.Tensor:
    """(N, CURVE_POINTS, 3) points of the cubics."""
    corners = control.index_select(0, owners.reshape(-1)).reshape(*owners.shape, 3)
    return (weights[..., None] * corners).sum(dim=2)


def nearest_targets(bins: BrickVolume, voxels: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` target points nearest to each of the points (M, 3) (in voxels), within SEARCH voxels, all together.

    Returns found (M,) int64, the row of the nearest target, -1 where there is none, and targets (T, 3) float64 in voxels: the
    partial target point cloud, each point once.
    """
    codes = np.full((len(voxels), count), -1, np.int64)
    chunk = 20_000
    for at in range(0, len(voxels), chunk):
        _nearest(bins.table, bins.bricks, voxels[at : at + chunk], np.uint64(seed), codes[at : at + chunk])
    marks = np.zeros((len(bins.bricks), BRICK**3), np.uint8)
    touched = np.zeros(len(marks), bool)
    partial = np.empty(_mark(codes, marks, touched), np.int64)
    _collect(marks, np.flatnonzero(touched), partial)
    found, targets = np.empty(len(codes), np.int64), np.empty((len(partial), 3))
    _rank(codes, partial, found)
    _places(partial, bins.brick_index, np.uint64(seed), targets)
    return found, targets


@numba.njit(cache=True, inline="always")
def _jitter(code, seed):
    """Three fixed numbers in [-0.5, 0.5) for a target point: 21 bits each of a 64-bit hash (splitmix64)."""
    h = np.uint64(code) + seed * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ (h >> np.uint64(31))
    low, unit = np.uint64(0x1FFFFF), 1.0 / 2097152.0
    return (
        np.int64(h & low) * unit - 0.5,
        np.int64((h >> np.uint64(21)) & low) * unit - 0.5,
        np.int64((h >> np.uint64(42)) & low) * unit - 0.5,
    )


@numba.njit(cache=True, parallel=True)
def _nearest(table, bricks, voxels, seed, codes):
    """Codes (brick row, voxel, number of the point) of the nearest target points, by insertion into a sorted list."""
    count = codes.shape[1]
    for n in numba.prange(len(voxels)):
        distances = np.full(count, np.inf)
        x, y, z = voxels[n, 0], voxels[n, 1], voxels[n, 2]
        cx, cy, cz = int(np.floor(x + 0.5)), int(np.floor(y + 0.5)), int(np.floor(z + 0.5))
        for ring in range(SEARCH + 1):
            # points of this ring and of farther ones are farther than ring - 1
            if ring > 1 and distances[count - 1] <= (ring - 1.0) ** 2:
                break
            for i in range(cx - ring, cx + ring + 1):
                for j in range(cy - ring, cy + ring + 1):
                    face = abs(i - cx) == ring or abs(j - cy) == ring
                    step = 1 if face or ring == 0 else 2 * ring
                    for k in range(cz - ring, cz + ring + 1, step):
                        if i < 0 or j < 0 or k < 0:
                            continue
                        if (i >> 4) >= table.shape[0] or (j >> 4) >= table.shape[1] or (k >> 4) >= table.shape[2]:
                            continue
                        row = table[i >> 4, j >> 4, k >> 4]
                        if row < 0:
                            continue
                        held = bricks[row, i & 15, j & 15, k & 15]
                        if held == 0:
                            continue
                        # a voxel's points lie up to half a voxel from its centre
                        ox, oy, oz = abs(i - x) - 0.5, abs(j - y) - 0.5, abs(k - z) - 0.5
                        ox, oy, oz = max(ox, 0.0), max(oy, 0.0), max(oz, 0.0)
                        if ox * ox + oy * oy + oz * oz >= distances[count - 1]:
                            continue
                        for point in range(held):
                            code = ((np.int64(row) * 4096 + (i & 15) * 256 + (j & 15) * 16 + (k & 15)) << 3) + point
                            u, v, w = _jitter(code, seed)
                            dx, dy, dz = i + u - x, j + v - y, k + w - z
                            d = dx * dx + dy * dy + dz * dz
                            if d >= distances[count - 1]:
                                continue
                            slot = count - 1
                            while slot > 0 and distances[slot - 1] > d:
                                distances[slot] = distances[slot - 1]
                                codes[n, slot] = codes[n, slot - 1]
                                slot -= 1
                            distances[slot] = d
                            codes[n, slot] = code


@numba.njit(cache=True)
def _mark(codes, marks, touched):
    """Set the bits of target points in the marks (B, 4096) of their voxels, and the bricks that hold any; returns how many."""
    count = 0
    for n in range(len(codes)):
        for code in codes[n]:
            if code < 0:
                break
            row, voxel, bit = code >> 15, (code >> 3) & 4095, np.uint8(1 << (code & 7))
            if marks[row, voxel] & bit == 0:
                marks[row, voxel] |= bit
                touched[row] = True
                count += 1
    return count


@numba.njit(cache=True)
def _collect(marks, rows, codes):
    """Write the codes of all marked points in the bricks `rows`, rising."""
    at = 0
    for row in rows:
        for voxel in range(marks.shape[1]):
            mark = marks[row, voxel]
            point = 0
            while mark:
                if mark & 1:
                    codes[at] = (((row << 12) + voxel) << 3) + point
                    at += 1
                mark >>= 1
                point += 1


@numba.njit(cache=True, parallel=True)
def _rank(codes, sorted_codes, found):
    """Where the first of each row of codes is among the sorted ones, -1 where there is none."""
    for n in numba.prange(len(codes)):
        found[n] = np.searchsorted(sorted_codes, codes[n, 0]) if codes[n, 0] >= 0 else -1


@numba.njit(cache=True, parallel=True)
def _places(codes, index, seed, targets):
    for n in numba.prange(len(codes)):
        voxel = (codes[n] >> 3) & 4095
        row = codes[n] >> 15
        u, v, w = _jitter(codes[n], seed)
        targets[n, 0] = 16 * index[row, 0] + (voxel >> 8) + u
        targets[n, 1] = 16 * index[row, 1] + ((voxel >> 4) & 15) + v
        targets[n, 2] = 16 * index[row, 2] + (voxel & 15) + w
