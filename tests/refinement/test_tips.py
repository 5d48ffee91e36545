"""Tips on strands that were given up too early or run on too far: they come to where the scan shows the hair to end."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.refinement.tips import MOVES, settle_tips
from ct2hair_addon.strands import Strands, concatenate
from ct2hair_addon.volume import BrickVolume
from ct2hair_addon.volume.strand_signal import StrandProfile

VOXEL, BLUR, LENGTH = 0.5, 0.85, 30.0
PROFILE = StrandProfile.gaussian(strand_peak(BLUR), BLUR, VOXEL)
OFF = np.array([-1.2, -0.8, -0.4, 0.0, 0.3, 0.6])
"""mm by which strands end too late."""


def arcs(lengths: np.ndarray, apart: float = 3.0, radius: float = 25.0) -> Strands:
    """Bent strands side by side, a point about every 2 mm."""
    lines = []
    for n, length in enumerate(lengths):
        angle = np.linspace(0.0, length, round(length / 2.0) + 1) / radius
        x = np.full(len(angle), apart * n + 0.13)
        lines.append(np.stack([x, radius * np.sin(angle), radius * (1.0 - np.cos(angle)) + 0.07 * n], axis=1))
    return Strands.from_polylines([line.astype(np.float32) for line in lines])


def scan_of(*hair: Strands, noise: float = 0.0) -> BrickVolume:
    # one more strand around, so that the bricks reach beyond the tips
    frame = Strands.from_polylines([np.linspace([-8, -8, -8], [40, 45, 30], 80, dtype=np.float32)])
    scan = render_density(concatenate([*hair, frame]), VOXEL, BLUR)
    bricks = scan.bricks + np.random.default_rng(0).normal(0.0, noise, scan.bricks.shape).astype(np.float32)
    return BrickVolume(scan.table, bricks, scan.spacing, scan.origin)


def settled(strands: Strands, scan: BrickVolume, visible: np.ndarray | None = None, traced: list[bool] | None = None):
    shown = np.ones(len(strands.points)) if visible is None else visible
    every = np.ones(len(strands), bool) if traced is None else np.array(traced)
    return settle_tips(strands.points.astype(np.float64), strands.offsets, shown, scan, PROFILE, every)


@pytest.mark.parametrize(("noise", "bound"), [(0.0, 0.12), (0.25, 0.25)])
def test_tips_come_to_where_the_hair_ends(noise, bound):
    hair, strands = arcs(np.full(6, LENGTH)), arcs(LENGTH + OFF)
    scan = scan_of(hair, noise=noise * strand_peak(BLUR))
    points, moved = settled(strands, scan)
    tips = points[strands.offsets[1:] - 1]
    assert np.linalg.norm(tips - hair.tips, axis=1).max() < bound + 0.04  # a straight end instead of a bent one
    np.testing.assert_allclose(moved, -OFF, atol=bound)
    np.testing.assert_allclose(np.linalg.norm(tips - strands.tips, axis=1), np.abs(moved), atol=1e-4)
    others = np.ones(len(points), bool)
    others[strands.offsets[1:] - 1] = False
    np.testing.assert_array_equal(points[others], strands.points[others])


def test_hair_that_others_explain_draws_no_tip():
    whole = arcs(np.full(2, LENGTH), apart=0.0)
    behind = arcs(np.array([LENGTH, LENGTH - 10.0]), apart=0.0)
    _, moved = settled(behind, scan_of(behind))
    np.testing.assert_allclose(moved, 0.0, atol=0.07)
    _, moved = settled(behind, scan_of(whole))
    assert moved[1] == pytest.approx(MOVES[-1] * VOXEL), "the rest of it is no other's"
    assert abs(moved[0]) < VOXEL, "what the other lacks is not its own"


def test_hidden_short_lonely_and_made_up_tips_stay_as_they_are():
    hair, strands = arcs(np.full(2, LENGTH)), arcs(np.full(2, LENGTH - 1.0))
    assert (settled(strands, scan_of(hair), traced=[True, False])[1] > 0.0).tolist() == [True, False]
    _, moved = settled(strands, scan_of(hair), np.zeros(len(strands.points)))
    assert not moved.any()
    short = arcs(np.full(2, 3.0))
    assert not settled(short, scan_of(hair))[1].any()
    point = Strands.from_polylines([hair.points[:1], strands.points[:20]])
    assert settled(point, scan_of(hair))[1][0] == 0.0
    far = Strands(strands.points + np.float32(500.0), strands.offsets)
    assert not settled(far, scan_of(hair))[1].any()


def test_tips_are_the_same_on_one_thread():
    hair, strands = arcs(np.full(6, LENGTH)), arcs(LENGTH + OFF)
    scan, threads = scan_of(hair, noise=0.2 * strand_peak(BLUR)), numba.get_num_threads()
    many = settled(strands, scan)
    numba.set_num_threads(1)
    try:
        one = settled(strands, scan)
    finally:
        numba.set_num_threads(threads)
    for each, other in zip(many, one, strict=True):
        np.testing.assert_array_equal(each, other)
