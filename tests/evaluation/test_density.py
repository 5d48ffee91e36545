"""Density: counts and blur against a dense array, lattice and frame, and slabs against the whole."""

import numba
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.evaluation.curves import curve_arcs, sample_curves
from ct2hair_addon.evaluation.density import render_layers
from ct2hair_addon.strands import Strands


def tangle(count=200, points=12, seed=1) -> Strands:
    """Smooth random walks through a box of some 40 mm."""
    steps = np.random.default_rng(seed).normal(size=(count, points, 3)) * 3.0
    return Strands.from_array((np.cumsum(steps, axis=1) + [5.0, -7.0, 11.0]).astype(np.float32))


def dense_reference(strands: Strands, spacing, sigma, origin, shape) -> np.ndarray:
    points = sample_curves(strands, spacing / 2, 0.5).points
    index = np.floor((points.astype(np.float64) - origin) / spacing + 0.5).astype(int)
    index = index[((index >= 0) & (index < shape)).all(axis=1)]
    counts = np.zeros(shape)
    np.add.at(counts, tuple(index.T), 1.0)
    return gaussian_filter(counts, sigma, mode="constant") if sigma else counts


@pytest.mark.parametrize("sigma", [0.0, 0.85])
def test_bricks_equal_dense_counts_and_scipys_blur(sigma):
    strands = tangle()
    volume = render_density(strands, 0.8, sigma)
    expected = dense_reference(strands, 0.8, sigma, volume.origin, volume.shape)
    # a point in a thousand lies so near a face that float32 rounds it across
    difference = np.abs(volume.block((0, 0, 0), volume.shape) - expected)
    assert np.count_nonzero(difference > 1e-4) < 1e-3 * np.count_nonzero(expected)
    assert len(volume.bricks) <= volume.table.size


def test_a_box_cuts_the_strands_and_layers_equal_the_whole():
    strands = tangle()
    origin, shape = np.array([-10.0, -20.0, -5.0]), (70, 50, 90)
    whole = render_density(strands, 0.5, 0.85, origin, shape)
    assert not whole.block((70, 0, 0), (80, 64, 96)).any()
    arcs = curve_arcs(strands)
    for first, last in ((0, 2), (2, 3), (3, 6)):
        part = render_layers(strands, arcs, 0.5, 0.85, origin, shape, first, last)
        np.testing.assert_allclose(part.origin, origin + [0, 0, first * 16 * 0.5])
        np.testing.assert_array_equal(
            part.block((0, 0, 0), (80, 64, 16 * (last - first))), whole.block((0, 0, 16 * first), (80, 64, 16 * last))
        )


def test_a_point_counts_in_the_voxel_whose_centre_is_nearest():
    line = Strands.from_polylines([np.array([[2.1, 3.9, 1.0], [2.1, 3.9, 3.0]], np.float32)])
    volume = render_density(line, 1.0, 0.0, (0.0, 0.0, 0.0), (8, 8, 8))
    dense = volume.block((0, 0, 0), (8, 8, 8))
    np.testing.assert_array_equal(dense[2, 4], [0, 1, 2, 1, 0, 0, 0, 0])
    assert dense.sum() == 4


def test_a_straight_strand_peaks_where_the_protocol_says():
    line = Strands.from_polylines([np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 30.0]], np.float32)])
    volume = render_density(line, 0.5, 0.8, (-8.0, -8.0, -4.0), (33, 33, 80))
    # its axis passes through voxel centres, so that counting adds nothing to the blur across it
    np.testing.assert_allclose(volume.sample([[0.0, 0.0, 15.0]]), strand_peak(0.8), rtol=0.01)


def test_threads_change_nothing():
    strands = tangle()
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = render_density(strands, 0.5)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(one.bricks, render_density(strands, 0.5).bricks)


def test_a_quarter_circle_through_four_points_is_a_circle():
    angle = np.linspace(0.0, np.pi / 2, 7)
    arc = np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0 * angle], axis=1).astype(np.float32)
    strands = Strands.from_polylines([arc])
    np.testing.assert_allclose(curve_arcs(strands)[-1], 10 * np.pi / 2, rtol=2e-3)
    samples = sample_curves(strands, 0.25)
    np.testing.assert_allclose(np.linalg.norm(samples.points, axis=1), 10.0, atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(np.diff(samples.points, axis=0), axis=1), 0.25, atol=2e-3)
