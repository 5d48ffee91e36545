"""Chamfer targets: the nearest points of the scan, exactly, near and far; bins by density."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.refinement.chamfer import BINS, SEARCH, density_bins, nearest_targets
from ct2hair_addon.volume import BrickVolume


def every_target(bins: BrickVolume, seed: int) -> np.ndarray:
    """All target points, found by asking for as many as there can be at each filled voxel."""
    filled = np.argwhere(bins.block((0, 0, 0), bins.shape) > 0)
    return np.unique(np.concatenate([nearest_targets(bins, filled.astype(float), 64, seed)[1]]).round(9), axis=0)


def test_voxels_of_the_ith_bin_hold_i_points():
    values = np.zeros((16, 16, 16), np.float32)
    values[2:14, 8, 8] = np.linspace(10.0, 120.0, 12)
    bins = density_bins(BrickVolume.from_dense(values, 0.5), 5.0)
    held = bins.bricks[0, 2:14, 8, 8]
    assert held[0] == 1 and held[-1] == BINS and (np.diff(held.astype(int)) >= 0).all()
    assert len(every_target(bins, 0)) == held.sum()


def test_the_nearest_are_those_of_a_tree_however_far():
    generator = np.random.default_rng(4)
    values = np.zeros((48, 48, 48), np.float32)
    values[tuple(generator.integers(16, 32, (60, 3)).T)] = generator.uniform(10, 100, 60)
    bins = density_bins(BrickVolume.from_dense(values, 0.5), 5.0)
    targets = every_target(bins, 7)
    points = generator.uniform(8, 40, (200, 3))
    found, partial = nearest_targets(bins, points, 16, 7)
    assert np.isin(partial.round(9).view("f8,f8,f8").ravel(), targets.view("f8,f8,f8").ravel()).all()
    expected = cKDTree(targets).query(points, k=16)[0]
    for n in range(len(points)):
        alone = np.linalg.norm(nearest_targets(bins, points[n : n + 1], 16, 7)[1] - points[n], axis=1)
        near = expected[n][expected[n] < SEARCH - 1.0]
        np.testing.assert_allclose(np.sort(alone)[: len(near)], near, atol=1e-9)
        if len(near):
            assert np.linalg.norm(partial[found[n]] - points[n]) == pytest.approx(near[0], abs=1e-9)
    assert (found >= 0).mean() > 0.9


def test_where_no_hair_is_near_nothing_is_found():
    values = np.zeros((48, 48, 48), np.float32)
    values[40, 40, 40] = 50.0
    bins = density_bins(BrickVolume.from_dense(values, 0.5), 5.0)
    found, partial = nearest_targets(bins, np.array([[5.0, 5.0, 5.0], [39.0, 40.0, 41.0]]), 16, 0)
    assert found[0] == -1 and found[1] >= 0
    assert abs(partial - 40.0).max() <= 0.5
