"""The default refinement: all strands at once against the volume, coarse to fine (in place of the paper's 3.3.2 Chamfer).

Strands are rendered through the scanner's blur, the misfit to the scan is blurred back into a potential, and every strand
moves down its slope as a smooth curve with a pinned root and no point inside the head.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ..progress import Progress, part, silent
from ..settings import RefinementSettings
from ..volume import BRICK, BrickVolume
from ..volume.strand_signal import StrandProfile
from .binning import RIM, bin_segments
from .blur import blurred, ring
from .boundary import Boundary
from .curves import local_curvature, segment_lengths
from .device import takes_card
from .forces import gather_forces
from .motion import keep_lengths, smooth_step
from .splat import halved, misfit

LEVEL_BLUR = 0.85
"""Blur of the coarser levels, voxels: as sharp as trilinear reading allows."""
HALVING_VARIANCE = 1.0 / 16.0
"""Variance, coarse voxels^2, that the mean of two voxels adds along an axis."""
RELAXATION = 0.7
FRICTION = 0.5
"""Share of a Newton step that is taken, and of the last step that goes on: together just short of overshooting."""
STEP_LIMIT = 0.5
"""Longest move in one iteration, voxels: within the reach of the potential that it follows."""
LENGTH_SWEEPS = 6
SMOOTH_TURN = 0.15
"""Radians that a strand turns over the length that it is smoothed by at most: its curls then lose nothing that counts."""
LEAST_SMOOTH = 1.5
"""voxel; the least such length."""
FIRST_SMOOTH, SETTLED = 3.0, 0.7
"""How many times `stiffness` it is at first, and the share of iterations after which it is that."""
BENDS_EVERY = 4
"""Iterations after which bends are measured anew."""
PLANES_EVERY = 10
"""Iterations after which the head's tangent planes are taken anew; a point moves a few voxels at most in between."""


@dataclass(frozen=True)
class Level:
    """One step of the pyramid: the scan at some voxel size and the blur of a strand there, voxels."""

    scan: BrickVolume
    blur: float


def pyramid(density: BrickVolume, blur: float, coarsest: float) -> list[Level]:
    """The scan at its own voxel size, twice that, and so on up to `coarsest` times; coarsest first."""
    levels = [Level(density, blur)]
    while 2.0 * levels[-1].scan.spacing <= coarsest * density.spacing:
        coarse = halved(levels[-1].scan)
        kept = np.sqrt((levels[-1].blur / 2.0) ** 2 + HALVING_VARIANCE)
        extra = np.sqrt(max(LEVEL_BLUR**2 - kept**2, 0.0))
        bricks = blurred(coarse, extra) if extra > 0.2 else coarse.bricks
        bricks[coarse.bricks == 0.0] = 0.0  # cleared is cleared, whatever lies beside it
        scan = BrickVolume(coarse.table, bricks, coarse.spacing, coarse.origin, coarse.background)
        levels.append(Level(scan, float(np.sqrt(kept**2 + extra**2))))
    return levels[::-1]


def shares(iterations: int, levels: int) -> list[int]:
    """How the iterations are shared out: half to the finest level, the rest evenly to the coarser ones."""
    if levels == 1:
        return [iterations]
    coarse = [(iterations // 2) // (levels - 1)] * (levels - 1)
    return [*coarse, iterations - sum(coarse)]


def fit_to_volume(
    points: np.ndarray,
    offsets: np.ndarray,
    density: BrickVolume,
    profile: StrandProfile,
    boundary: Boundary,
    settings: RefinementSettings,
    device: str = "auto",
    progress: Progress = silent,
    traced: np.ndarray | None = None,
    first: float = FIRST_SMOOTH,
) -> tuple[np.ndarray, dict[str, int]]:
    """Move control points (M, 3) float64 mm, strands by `offsets`, to fit the scan. Returns new points and a tally.

    traced: (N,) bool, strands that were found in the scan, whose short waves are noise (None: none was); others keep theirs,
    and their lengths. device: 'auto' takes a graphics card for what is done to voxels where torch has one, 'cpu' none. first:
    how many times `stiffness` it is at first, to pull hops straight.
    """
    points = np.array(points, np.float64)
    made_up = np.ones(len(offsets) - 1, bool) if traced is None else ~np.asarray(traced, bool)
    shaped = np.repeat(made_up, np.diff(offsets))
    rest_lengths = segment_lengths(points, offsets)
    levels = pyramid(density, profile.blur, settings.coarsest)
    plan = shares(settings.iterations, len(levels))
    cost = np.array(plan) * (0.2 + np.array([len(level.scan.bricks) for level in levels]) / len(density.bricks))
    done = np.concatenate([[0.0], np.cumsum(cost)]) / max(cost.sum(), 1e-9)
    tally = {"control points": len(points)}
    potential_of = _potentials(density, device)
    tally["fitted on a graphics card"] = int(potential_of is not Potential)
    for number, (level, count) in enumerate(zip(levels, plan, strict=True)):
        stage = part(progress, done[number], done[number + 1])
        size = level.scan.spacing
        gain = profile.line_mass / size**2
        newton = 8.0 * np.pi * level.blur**4 / gain
        potential = potential_of(level.scan, level.blur, gain)
        forces, weights = np.empty_like(points), np.empty(len(points))
        velocity = np.zeros_like(points)
        rest = points * shaped[:, None]
        for iteration in range(count):
            step = part(stage, iteration / count, (iteration + 1) / count)
            if iteration % PLANES_EVERY == 0:
                visible = boundary.look(points)
            voxels = level.scan.to_voxel(points)
            error = potential.forces(voxels, offsets, visible, forces, weights, part(step, 0.0, 0.9))
            forces *= newton * size
            if iteration % BENDS_EVERY == 0:
                bends = SMOOTH_TURN / np.maximum(local_curvature(points, offsets), 1e-6)
            most = settings.stiffness * size * first ** max(1.0 - iteration / (SETTLED * count), 0.0)
            smooth = np.where(shaped, settings.stiffness * size, np.clip(bends, LEAST_SMOOTH * size, most))
            smooth_step(
                points, rest, offsets, forces, weights, smooth, RELAXATION, FRICTION, STEP_LIMIT * size, velocity
            )  # fmt: skip
            keep_lengths(points, offsets, made_up, rest_lengths, LENGTH_SWEEPS)
            boundary.push(points, offsets)
            if iteration == 0:
                whole = _scale(level.scan)
                tally[f"misfit before, {size:.2f} mm (thousandths)"] = round(1000 * error / whole)
        if count:
            tally[f"misfit after, {size:.2f} mm (thousandths)"] = round(1000 * error / whole)
        tally["iterations"] = tally.get("iterations", 0) + count
        del potential
    progress(1.0, 1.0)
    return points, tally


class Potential:
    """What a scan asks of strands: their misfit to it, blurred back, whose slope draws them; worked out by the processor.

    blur: that of a strand in `scan`, voxels. gain: density of one voxel of strand length in a voxel.
    """

    def __init__(self, scan: BrickVolume, blur: float, gain: float) -> None:
        self.blur, self.gain, self.scan = blur, gain, scan
        self.places = np.full(np.add(scan.table.shape, 2 * RIM), -1, np.int32)
        index = scan.brick_index + np.int32(RIM)
        _, _, self.place, room = ring(index, len(self.places))
        self.places[tuple(index.T)] = self.place
        self.misfit = np.empty((room, BRICK, BRICK, BRICK), np.float32)

    def forces(
        self,
        voxels: np.ndarray,
        offsets: np.ndarray,
        visible: np.ndarray,
        forces: np.ndarray,
        weights: np.ndarray,
        progress: Progress = silent,
    ) -> float:
        """Write what is asked of each control point of strands at `voxels` (M, 3): forces (M, 3) and weights (M,), as
        `gather_forces`. Returns half the weighted square sum of the misfit."""
        segments, errors = bin_segments(voxels, offsets, visible, self.scan.table), np.empty(len(self.place))
        layers = misfit(
            voxels, visible, segments, self.scan, self.blur, self.gain, self.misfit, self.place, errors, progress
        )  # fmt: skip
        gather_forces(voxels, offsets, visible, segments, self.misfit, self.places, layers, self.blur, forces, weights)
        return float(errors.sum())


def _potentials(density: BrickVolume, device: str):
    """What makes the potential of a level of `density`: the processor's, or a graphics card's where there is one."""
    if not takes_card(device):
        return Potential
    from . import card  # torch takes seconds to import

    if not takes_card(device, card.bytes_needed(density)):
        return Potential
    return partial(card.CardPotential, device=card.CUDA)


def _scale(scan: BrickVolume) -> float:
    """Half the square sum of the scan: what a misfit is a share of."""
    chunks = range(0, len(scan.bricks), 1024)
    total = sum(float(np.square(scan.bricks[at : at + 1024], dtype=np.float32).sum(dtype=np.float64)) for at in chunks)
    return max(0.5 * total, 1e-12)
