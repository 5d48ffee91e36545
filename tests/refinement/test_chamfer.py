"""The paper's refinement by Chamfer distance: its target points, its batches, and that it lowers its loss on a phantom."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.refinement import refine
from ct2hair_addon.settings import RefinementSettings
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume

SPACING, BLUR = 0.6, 0.85
LEVEL = 0.35 * strand_peak(BLUR)

torch = pytest.importorskip("torch", reason="the Chamfer method needs torch")
chamfer = pytest.importorskip("ct2hair_addon.refinement.chamfer")


def test_a_voxel_of_the_ith_bin_holds_i_points():
    values = np.zeros((16, 16, 16), np.float32)
    values[:8] = np.linspace(0.0, 40.0, 8 * 256, dtype=np.float32).reshape(8, 16, 16)
    bins = chamfer.density_bins(BrickVolume.from_dense(values, 0.5), 10.0)
    top = np.quantile(values[values > 10.0], chamfer.TOP_QUANTILE)
    width = (top - 10.0) / chamfer.BINS
    expected = np.where(values > 10.0, np.clip(np.floor((values - 10.0) / width) + 1, 1, chamfer.BINS), 0)
    assert np.abs(bins.bricks[0].astype(int) - expected).max() <= 1  # rounding at a bin's edge
    assert np.mean(bins.bricks[0] == expected) > 0.999
    assert np.bincount(bins.bricks.ravel())[1:].min() > 100


def test_nearest_targets_are_what_a_search_tree_finds():
    generator = np.random.default_rng(0)
    counts = generator.integers(0, 4, (32, 32, 32)).astype(np.uint8)
    bins = BrickVolume.from_dense(counts, 1.0)
    points = generator.uniform(6, 26, (300, 3))
    found, targets = chamfer.nearest_targets(bins, points, 8, 3)
    # all points of the scan, from a query at every voxel
    voxels = np.argwhere(counts > 0)
    _, everything = chamfer.nearest_targets(bins, voxels.astype(float), 64, 3)
    assert len(everything) == counts.sum()
    assert np.abs(everything - np.rint(everything)).max() <= 0.5
    distance, nearest = cKDTree(everything).query(points, k=8)
    assert (found >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(targets[found] - points, axis=1), distance[:, 0], atol=1e-9)
    together = everything[np.unique(nearest)]
    np.testing.assert_allclose(targets[np.lexsort(targets.T)], together[np.lexsort(together.T)], atol=1e-9)
    # another seed jitters them elsewhere within their voxels
    _, others = chamfer.nearest_targets(bins, points, 8, 4)
    assert not np.array_equal(np.sort(others, axis=0)[:50], np.sort(targets, axis=0)[:50])
    far, none = chamfer.nearest_targets(bins, np.array([[200.0, 0, 0]]), 8, 3)
    assert (far == -1).all() and not len(none)


def test_batches_are_neighbours_and_hold_each_strand_once():
    roots = np.random.default_rng(1).uniform(0, 100, (1000, 3))
    groups = chamfer.batches(roots, 130)
    assert sorted(np.concatenate(groups).tolist()) == list(range(1000))
    assert max(map(len, groups)) <= 130 and min(map(len, groups)) >= 60
    assert np.mean([np.ptp(roots[group], axis=0).prod() for group in groups]) < 0.2 * 100**3


def loss_of(strands, density):
    """Mean squared distance, voxels^2, to the nearest target points: the Chamfer term from strands to scan."""
    bins = chamfer.density_bins(density, LEVEL)
    points = density.to_voxel(strands.resampled(64).reshape(-1, 3))
    points = points[np.linalg.norm(density.to_scan(points), axis=1) > 43.0]
    found, targets = chamfer.nearest_targets(bins, points, 1, 0)
    reached = found >= 0
    apart = np.linalg.norm(targets[found[reached]] - points[reached], axis=1)
    return float(np.concatenate([apart**2, np.full((~reached).sum(), chamfer.SEARCH**2)]).mean())


def test_it_draws_displaced_strands_onto_the_scan(head, profile):
    generator = np.random.default_rng(2)
    d = generator.normal(size=(40, 3))
    d[:, 2] = np.abs(d[:, 2]) + 0.3
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    straight = d[:, None] * np.linspace(40, 75, 40)[None, :, None]
    aside = np.cross(d, generator.normal(size=(40, 3)))
    aside *= 0.8 / np.linalg.norm(aside, axis=1, keepdims=True)
    truth = Strands.from_array(straight.astype(np.float32))
    given = Strands.from_array(
        (straight + aside[:, None] * np.minimum(np.linspace(0, 35, 40) / 10, 1)[None, :, None]).astype(np.float32)
    )
    density = render_density(truth, SPACING, BLUR)
    settings = RefinementSettings(method="chamfer", iterations=60, batch=25, length_weight=1.0, tangent_weight=1.0)
    result = refine(given, density, LEVEL, head, settings, seed=1, profile=profile)
    assert loss_of(result.strands, density) < 0.6 * loss_of(given, density)
    assert result.tally["batches"] == 2 and result.tally["iterations"] > 10
    np.testing.assert_array_equal(result.strands.roots, given.roots)
    inner = np.ones(len(result.strands.points), bool)
    inner[result.strands.offsets[:-1]] = False
    assert head.signed_distance(result.strands.points[inner]).min() > 0
    again = refine(given, density, LEVEL, head, settings, seed=1, profile=profile)
    np.testing.assert_array_equal(again.strands.points, result.strands.points)
