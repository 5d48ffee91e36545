"""Strands rendered into bricks: mass, peak, scipy's own blur, bricks in any order; the misfit by hand, its slope by finite
differences and a plain reading."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise

import numba
import numpy as np
import pytest
from scipy import ndimage

from ct2hair_addon.refinement.binning import RIM, bin_segments
from ct2hair_addon.refinement.blur import blurred, gaussian_taps
from ct2hair_addon.refinement.fit import Potential
from ct2hair_addon.refinement.forces import gather_forces
from ct2hair_addon.refinement.splat import SPLAT_VARIANCE, _layers, halved, misfit, render, splat_taps
from ct2hair_addon.volume import BrickVolume

BLUR = 0.85


def full(shape=(48, 48, 48)) -> BrickVolume:
    """A volume that has all its bricks."""
    return BrickVolume.from_dense(np.ones(shape, np.float32), 1.0)


def dense_of(volume, bricks):
    return BrickVolume(volume.table, bricks, 1.0, np.zeros(3)).block((0, 0, 0), volume.shape)


def curves(seed=0, count=4):
    """Wavy strands of nine control points inside 48^3: points (M, 3) float64 voxels, offsets, all visible."""
    generator = np.random.default_rng(seed)
    start, end = generator.uniform(8, 16, (count, 3)), generator.uniform(30, 40, (count, 3))
    t = np.linspace(0, 1, 9)[None, :, None]
    points = (start[:, None] * (1 - t) + end[:, None] * t + generator.normal(0, 1.0, (count, 9, 3))).reshape(-1, 3)
    return points, 9 * np.arange(count + 1, dtype=np.int64), np.ones(len(points))


def catmull_rom(points, per_segment=400):
    """Points on the cubics of one strand, finely, ends mirrored."""
    padded = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    t = ((np.arange(per_segment) + 0.5) / per_segment)[:, None]
    parts = []
    for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True):
        parts.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - 3 * c + d - a) * t**3))
    return np.concatenate(parts)


def test_the_volume_holds_the_strands_length():
    points, offsets, visible = curves()
    found = render(points, offsets, visible, full(), BLUR)
    fine = [catmull_rom(points[a:b]) for a, b in pairwise(offsets)]
    length = sum(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in fine)
    assert found.sum() == pytest.approx(length, rel=2e-3)
    half = render(points, offsets, 0.5 * visible, full(), BLUR)
    np.testing.assert_allclose(half, 0.5 * found, atol=1e-6)


def test_a_strand_is_a_sum_of_gaussians_along_it():
    points, offsets, visible = curves(1, 1)
    found = dense_of(full(), render(points, offsets, visible, full(), BLUR))
    line = catmull_rom(points, 60)
    middle, step = 0.5 * (line[1:] + line[:-1]), np.linalg.norm(np.diff(line, axis=0), axis=1)
    x, y, z = (np.exp(-0.5 * ((np.arange(48)[None] - middle[:, axis, None]) / BLUR) ** 2) for axis in range(3))
    expected = np.einsum("p,pi,pj,pk->ijk", step / (BLUR * np.sqrt(2 * np.pi)) ** 3, x, y, z, optimize=True)
    # the splat's own width swings between 0 and 1/2 voxel with the place between voxels, and by a blur more that is gone
    assert np.abs(found - expected).max() < 0.25 * expected.max()
    soft, expected = ndimage.gaussian_filter(found.astype(float), 1.5), ndimage.gaussian_filter(expected, 1.5)
    assert np.abs(soft - expected).max() < 0.03 * expected.max()


@pytest.mark.parametrize("direction", [(1, 0.3, 0.2), (0.1, 0.4, 1), (1, 1, 0.5)])
def test_a_lone_straight_strand_is_as_high_on_its_axis_as_it_should(direction):
    direction = np.array(direction) / np.linalg.norm(direction)
    points = 24.0 + np.linspace(-20, 20, 9)[:, None] * direction
    volume = full()
    shown = BrickVolume(volume.table, render(points, np.array([0, 9]), np.ones(9), volume, BLUR), 1.0, np.zeros(3))
    axis = shown.sample(24.0 + np.linspace(-10, 10, 200)[:, None] * direction).mean()
    # reading between voxels widens it by another sixth
    assert axis == pytest.approx(1.0 / (2 * np.pi * (BLUR**2 + 1 / 6)), rel=0.03)


def test_bricks_that_are_not_there_get_nothing_and_the_others_the_same():
    points, offsets, visible = curves(2)
    whole = full()
    everywhere = dense_of(whole, render(points, offsets, visible, whole, BLUR))
    some = np.ones((48, 48, 48), np.float32)
    some[16:32, 16:32, 16:32] = 0.0
    holed = BrickVolume.from_dense(some, 1.0)
    found = dense_of(holed, render(points, offsets, visible, holed, BLUR))
    np.testing.assert_array_equal(found[some > 0], everywhere[some > 0])
    assert not found[some == 0].any()


def test_the_order_of_bricks_changes_no_bit():
    points, offsets, visible = curves(7, 20)
    volume = full()
    plain = dense_of(volume, render(points, offsets, visible, volume, BLUR))
    mixed = np.random.default_rng(7).permutation(volume.table.size).astype(np.int32).reshape(volume.table.shape)
    shuffled = BrickVolume(mixed, volume.bricks, 1.0, np.zeros(3))
    np.testing.assert_array_equal(dense_of(shuffled, render(points, offsets, visible, shuffled, BLUR)), plain)


def test_hair_beside_the_table_spreads_into_it():
    """A strand a voxel and a half off the volume's face leaves what a larger volume gets there."""
    points = np.stack([np.full(9, -1.5), *np.tile(np.linspace(4, 40, 9), (2, 1))], axis=1)
    offsets, visible = np.array([0, 9]), np.ones(9)
    found = dense_of(full(), render(points, offsets, visible, full(), BLUR))
    larger = full((80, 48, 48))
    moved = dense_of(larger, render(points + [16.0, 0.0, 0.0], offsets, visible, larger, BLUR))
    assert found[0].max() > 0.01
    np.testing.assert_array_equal(found, moved[16:64])


def test_threads_change_no_bit():
    points, offsets, visible = curves(3, 40)
    before = numba.get_num_threads()
    many = render(points, offsets, visible, full(), BLUR)
    try:
        numba.set_num_threads(1)
        one = render(points, offsets, visible, full(), BLUR)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(many, one)


def test_taps_are_normalised_and_leave_room_for_the_splat():
    np.testing.assert_allclose([gaussian_taps(0.85).sum(), splat_taps(0.85).sum()], 1.0, rtol=1e-6)
    assert gaussian_taps(0.0).tolist() == [0, 0, 0, 1, 0, 0, 0]
    offsets = np.arange(-3, 4)
    assert (splat_taps(0.85) * offsets**2).sum() + 1 / 6 == pytest.approx(0.85**2, rel=0.02)


def test_blurred_is_scipys_gaussian_across_brick_borders():
    values = np.random.default_rng(4).normal(size=(40, 33, 50)).astype(np.float32)
    volume = BrickVolume.from_dense(values, 1.0)
    found = dense_of(volume, blurred(volume, BLUR))[:40, :33, :50]
    expected = ndimage.convolve1d(values.astype(float), gaussian_taps(BLUR), 0, mode="constant")
    for axis in (1, 2):
        expected = ndimage.convolve1d(expected, gaussian_taps(BLUR), axis, mode="constant")
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_bricks_are_blurred_in_place_alike():
    volume = BrickVolume.from_dense(np.random.default_rng(9).normal(size=(100, 33, 50)).astype(np.float32), 1.0)
    expected = blurred(volume, BLUR)
    assert (expected != volume.bricks).any()
    assert blurred(volume, BLUR, volume.bricks) is volume.bricks
    np.testing.assert_array_equal(volume.bricks, expected)


def test_halved_are_means_of_8_in_the_same_frame():
    values = np.random.default_rng(5).normal(size=(48, 16, 80)).astype(np.float32)
    volume = BrickVolume.from_dense(values, 0.5, (3.0, -2.0, 7.0))
    coarse = halved(volume)
    expected = values.reshape(24, 2, 8, 2, 40, 2).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(coarse.block((0, 0, 0), (24, 8, 40)), expected, atol=1e-6)
    assert coarse.spacing == 1.0
    # the middle of the first eight voxels
    np.testing.assert_allclose(coarse.to_scan([[0, 0, 0]]), volume.to_scan([[0.5, 0.5, 0.5]]))


def test_halved_are_means_of_what_was_not_cleared():
    values = np.random.default_rng(5).uniform(1.0, 2.0, (16, 16, 16)).astype(np.float32)
    values[:4, :, 0], values[8:12] = 0.0, 0.0
    coarse = halved(BrickVolume.from_dense(values, 0.5)).block((0, 0, 0), (8, 8, 8))
    assert (coarse[4:6] == 0.0).all() and (coarse[:4] > 0.0).all()
    np.testing.assert_allclose(coarse[0, 0, 0], values[:2, :2, 1].mean(), rtol=1e-6)


def test_air_that_evens_out_is_not_halved_to_what_was_cleared():
    even = np.where(np.indices((16, 16, 16)).sum(axis=0) & 1, 1, -1).astype(np.int16)
    coarse = halved(BrickVolume.from_dense(even, 0.5)).block((0, 0, 0), (8, 8, 8))
    assert (coarse != 0.0).all() and np.abs(coarse).max() < 1e-20


def misfit_of(points, offsets, visible, target, gain, out):
    """Fill `out` with the misfit; half its weighted square sum."""
    segments, errors = bin_segments(points, offsets, visible, target.table), np.empty(len(out))
    layers = misfit(points, visible, segments, target, BLUR, gain, out, np.arange(len(out)), errors)
    assert list(layers) == list(range(len(segments.table) - 1))
    return errors.sum()


def test_the_misfit_is_what_the_formula_says():
    points, offsets, visible = curves(6)
    target = BrickVolume.from_dense(np.random.default_rng(6).normal(0.1, 0.05, (48, 48, 48)).astype(np.float32), 1.0)
    gain = 0.7
    out = np.empty_like(target.bricks)
    error = misfit_of(points, offsets, visible, target, gain, out)
    model = gain * render(points, offsets, visible, target, BLUR).astype(np.float64)
    weight = 1.0 / (1.0 + model / (gain / (2 * np.pi * BLUR**2)))
    np.testing.assert_allclose(out, weight * (model - target.bricks), atol=1e-5)
    assert error == pytest.approx(0.5 * (weight * (model - target.bricks) ** 2).sum(), rel=1e-4)


def test_where_the_scan_was_cleared_nothing_is_asked():
    points, offsets, visible = curves(6)
    values = np.random.default_rng(6).normal(0.1, 0.05, (48, 48, 48)).astype(np.float32)
    whole, out = BrickVolume.from_dense(values, 1.0), np.empty((27, 16, 16, 16), np.float32)
    misfit_of(points, offsets, visible, whole, 0.7, out)
    expected = out.copy()
    values[:, 20:30, :] = 0.0
    holed = BrickVolume.from_dense(values, 1.0)
    error = misfit_of(points, offsets, visible, holed, 0.7, out)
    known = holed.bricks != 0.0
    assert (out[~known] == 0.0).all() and (render(points, offsets, visible, holed, BLUR)[~known] > 0.01).any()
    np.testing.assert_array_equal(out[known], expected[known])
    assert 0.0 < error < 0.5 * (expected**2).sum() * 100


def asked(points, offsets, visible, field, blur):
    forces, weights = np.full_like(points, np.nan), np.full(len(points), np.nan)
    segments = bin_segments(points, offsets, visible, field.table)
    places = np.pad(field.table, RIM, constant_values=-1)
    gather_forces(points, offsets, visible, segments, field.bricks, places, range(len(places)), blur, forces, weights)
    return forces, weights


def holed(seed=0):
    """Random values, smooth enough that where exactly they are read counts little, the middle brick left out."""
    values = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(48, 48, 48)), 2.0).astype(np.float32)
    values[16:32, 16:32, 16:32] = 0.0
    return BrickVolume.from_dense(values, 1.0)


def plain(points, visible, potential):
    """Force on each control point of one strand, by fine sampling of the trilinear potential and differences in it."""
    per = 400
    line = catmull_rom(points, per)
    tangent = np.gradient(line, axis=0)
    length = np.linalg.norm(tangent, axis=1)
    h = 1e-3
    slope = np.stack(
        [
            (
                ndimage.map_coordinates(potential, (line + h * e).T, order=1)
                - ndimage.map_coordinates(potential, (line - h * e).T, order=1)
            )
            / (2 * h)
            for e in np.eye(3)
        ],
        axis=1,
    )
    unit = tangent / length[:, None]
    slope -= (slope * unit).sum(axis=1, keepdims=True) * unit
    number, t = np.divmod(np.arange(len(line)) + 0.5, per)
    number, t = number.astype(int), t / per
    seen = (1 - t) * visible[number] + t * visible[number + 1]
    forces, shown = np.zeros_like(points), np.zeros(len(points))
    for to, weight in ((number, (1 - t) * length * seen), (number + 1, t * length * seen)):
        np.add.at(forces, to, -weight[:, None] * slope)
        np.add.at(shown, to, weight)
    return forces / np.maximum(shown, 1e-9)[:, None]


def test_forces_are_those_of_a_plain_reading_where_bricks_are_missing_too():
    points, offsets, visible = curves(1, 3)
    points = 24.0 + 1.1 * (points - 24.0)
    visible[:5] = 0.0
    visible[12:15] = 0.4
    field = holed()
    potential = blurred(field, 1.0)
    dense = dense_of(field, potential).astype(float)
    forces, weights = asked(points, offsets, visible, field, 1.0)
    for n in range(3):
        some = slice(offsets[n], offsets[n + 1])
        expected = plain(points[some], visible[some], dense)
        # two samples a voxel against a hundred
        assert np.abs(forces[some] - expected).max() < 0.1 * np.abs(expected).max()
    assert not forces[:4].any() and not weights[:4].any()  # nothing shows there
    np.testing.assert_allclose(weights[20:26], 1.0)
    assert weights[13] == pytest.approx(0.4, abs=1e-6)


def test_strands_far_outside_stay_and_threads_change_no_bit():
    points, offsets, visible = curves(2, 30)
    points[offsets[3] : offsets[4]] += 500.0
    points[offsets[5] : offsets[6]] -= 500.0
    field = holed(1)
    forces, weights = asked(points, offsets, visible, field, BLUR)
    for n in (3, 5):
        assert not forces[offsets[n] : offsets[n + 1]].any()
    np.testing.assert_allclose(weights, 1.0)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(asked(points, offsets, visible, field, BLUR)[0], forces)
    finally:
        numba.set_num_threads(before)


@pytest.mark.parametrize("direction", [(0, 1, 0), (0.6, 0, 0.8)])
def test_forces_are_the_misfits_slope_by_finite_differences(direction):
    """A straight strand beside the scan's, moved as a whole, askew to the lattice; all weights 1, so the slope is exact."""
    along = np.array([1.0, 0.31, -0.22]) / np.linalg.norm([1.0, 0.31, -0.22])
    truth = 24.0 + np.linspace(-18, 18, 10)[:, None] * along
    offsets, visible = np.array([0, 10]), np.ones(10)
    scan = full()
    gain = 0.8
    target = BrickVolume(scan.table, gain * render(truth, offsets, visible, scan, BLUR), 1.0, np.zeros(3))
    across = np.array(direction, float) - (direction @ along) * along
    across /= np.linalg.norm(across)
    points = truth + 0.7 * across
    out = np.empty_like(target.bricks)

    def error(step):
        moved = points + step * across
        segments, errors = bin_segments(moved, offsets, visible, target.table), np.empty(len(out))
        # a peak that is never reached: all weights are 1
        for _ in _layers(moved, visible, segments, target, BLUR, gain, 1e12, out, np.arange(len(out)), errors, lambda *_: None):
            pass
        return errors.sum()

    slope = (error(0.1) - error(-0.1)) / 0.2
    error(0.0)
    assert slope > 0  # farther off is worse
    length = np.full(10, 4.0)
    length[[0, -1]] = 2.0

    def from_forces(blur):
        forces, weights = asked(points, offsets, visible, BrickVolume(target.table, out, 1.0, np.zeros(3)), blur)
        np.testing.assert_allclose(weights, 1.0)
        assert np.abs(forces @ along).max() < 1e-5  # nothing along the strand
        return -gain * (length * (forces @ across)).sum()

    # reading between voxels is part of the blur, as the splat is: then the force is the slope
    assert from_forces(np.sqrt(BLUR**2 - SPLAT_VARIANCE)) == pytest.approx(slope, rel=0.05)
    # under the whole blur, as the fit takes it, it is up to a quarter softer
    assert 0.75 * slope < from_forces(BLUR) < slope


def test_a_fit_holds_a_few_layers_of_bricks_and_not_the_volume():
    points, offsets, visible = curves(8, 20)
    points = np.concatenate([points + [48.0 * n, 0.0, 0.0] for n in range(20)])
    offsets, visible = 9 * np.arange(401, dtype=np.int64), np.ones(len(points))
    scan = BrickVolume.from_dense(np.ones((960, 48, 48), np.int16), 1.0)
    forces, weights = np.empty_like(points), np.empty(len(points))
    potential = Potential(scan, BLUR, 1.0)
    potential.forces(points, offsets, visible, forces, weights)  # what is compiled is not counted
    del potential
    tracemalloc.start()
    try:
        Potential(scan, BLUR, 1.0).forces(points, offsets, visible, forces, weights)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert np.abs(forces).max() > 0.01
    assert peak < 0.5 * 4 * scan.bricks.size
