"""The orientation field on phantoms with known answers; blocks against the whole; the eigenvector against numpy."""

import numba
import numpy as np
import pytest

from ct2hair_addon.errors import Cancelled
from ct2hair_addon.orientation import OrientationField, noise_level, orientation_field
from ct2hair_addon.orientation.eigen import smallest_eigenvector
from ct2hair_addon.orientation.filters import derivative_taps, filter_x, filter_y, filter_z, gaussian_taps, noise_gain
from ct2hair_addon.settings import OrientationSettings
from ct2hair_addon.volume import BrickVolume
from ct2hair_addon.volume.openvdb_module import openvdb

PEAK = 100.0
BLUR = 0.85


def tube(points: np.ndarray, shape, peak=PEAK, blur=BLUR) -> np.ndarray:
    """A strand's blurred profile around densely sampled points (voxels): the maximum over them, exact for a line."""
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1).astype(float)
    nearest = np.full(shape, np.inf)
    for p in points:
        np.minimum(nearest, ((grid - p) ** 2).sum(-1), out=nearest)
    return (peak * np.exp(-0.5 * nearest / blur**2)).astype(np.float32)


def line(direction, shape, middle=None):
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    middle = np.array(shape) / 2.0 if middle is None else middle
    return middle + np.linspace(-45, 45, 181)[:, None] * direction, direction


@pytest.fixture(scope="module")
def straight():
    points, direction = line((1.0, 2.0, 0.7), (40, 40, 40))
    return BrickVolume.from_dense(tube(points, (40, 40, 40)), 0.4, (5.0, -3.0, 2.0)), points, direction


def angles(found, truth):
    return np.degrees(np.arccos(np.clip(np.abs((found * truth).sum(-1)), 0, 1)))


@pytest.mark.parametrize(
    ("changes", "error"),
    # Central differences read a tube this narrow some degrees towards the axes.
    [({}, 1.0), ({"rho": 1.0}, 1.0), ({"sigma": 0.0}, 6.0), ({"sigma": 0.0, "reweighting": 1}, 6.0)],
)
def test_a_straight_fibre_has_its_own_direction_and_full_confidence(straight, changes, error):
    volume, points, direction = straight
    field = orientation_field(volume, 30.0, OrientationSettings(**changes))
    inside = points[(points > 10).all(1) & (points < 30).all(1)]
    found, confidence = field.sample(volume.to_scan(inside))
    assert angles(found, direction).max() < error
    assert confidence.min() > 0.9
    assert field.tally["with a direction"] == np.count_nonzero(field.confidence.bricks)


def test_noise_turns_directions_little_and_leaves_confidence_on_the_fibre(straight):
    volume, points, direction = straight
    noisy = volume.bricks + np.random.default_rng(3).normal(0, PEAK / 4, volume.bricks.shape).astype(np.float32)
    noisy = BrickVolume(volume.table, noisy, volume.spacing, volume.origin)
    assert noise_level(noisy) == pytest.approx(PEAK / 4, rel=0.1)
    field = orientation_field(noisy, 35.0)
    inside = points[(points > 10).all(1) & (points < 30).all(1)]
    found, confidence = field.sample(noisy.to_scan(inside))
    assert np.median(angles(found, direction)) < 6.0
    assert np.median(confidence) > 0.6


def test_a_helix_is_followed_along_its_turns():
    t = np.linspace(0, 4 * np.pi, 400)
    points = np.stack([24 + 12 * np.cos(t), 24 + 12 * np.sin(t), 6 + 3.0 * t], 1)
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    volume = BrickVolume.from_dense(tube(points, (48, 48, 48)), 0.4)
    found, _ = orientation_field(volume, 30.0).sample(volume.to_scan(points[20:-20]))
    assert np.median(angles(found, tangent[20:-20])) < 4.0


def test_off_the_hair_there_is_no_direction(straight):
    volume, _, _ = straight
    field = orientation_field(volume, 30.0)
    found, confidence = field.sample(volume.to_scan(np.array([[2.0, 35.0, 35.0], [-50.0, 0.0, 0.0]])))
    assert not found.any() and not confidence.any()


def test_blocks_equal_the_whole_and_threads_change_nothing(straight, monkeypatch):
    volume, _, _ = straight
    noisy = volume.bricks + np.random.default_rng(1).normal(0, 20, volume.bricks.shape).astype(np.float32)
    noisy = BrickVolume(volume.table, noisy, volume.spacing, volume.origin)
    whole = orientation_field(noisy, 30.0)
    monkeypatch.setattr("ct2hair_addon.orientation.field.BLOCK", 1)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        blocks = orientation_field(noisy, 30.0)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(whole.direction.bricks, blocks.direction.bricks)
    np.testing.assert_array_equal(whole.confidence.bricks, blocks.confidence.bricks)


def test_an_empty_volume_gives_an_empty_field():
    volume = BrickVolume.from_dense(np.zeros((20, 20, 20), np.float32), 0.4)
    field = orientation_field(volume, 1.0)
    assert field.tally["hair voxels"] == 0 and len(field.direction.bricks) == 0


def test_cancelling_passes_through(straight):
    def stop(done, total):
        raise Cancelled

    with pytest.raises(Cancelled):
        orientation_field(straight[0], 30.0, progress=stop)


def test_the_eigenvector_is_numpys():
    generator = np.random.default_rng(0)
    for _ in range(300):
        a = generator.normal(size=(5, 3)) * generator.uniform(0.01, 10, 3)
        matrix = a.T @ a
        values, vectors = np.linalg.eigh(matrix)
        x, y, z, small, middle, large = smallest_eigenvector(*matrix[np.triu_indices(3)])
        np.testing.assert_allclose([small, middle, large], values, rtol=1e-6, atol=1e-8 * values[2])
        assert abs(np.dot((x, y, z), vectors[:, 0])) > 1 - 1e-6


def test_the_eigenvector_of_a_double_eigenvalue_is_in_its_plane():
    x, y, z, *_ = smallest_eigenvector(1.0, 0.0, 0.0, 1.0, 0.0, 5.0)
    assert abs(z) < 1e-6 and x * x + y * y == pytest.approx(1.0)
    assert np.isfinite(smallest_eigenvector(2.0, 0.0, 0.0, 2.0, 0.0, 2.0)).all()


def filtered(block, taps, axis):
    shape = list(block.shape)
    shape[axis] -= len(taps) - 1
    out = np.empty(shape, np.float32)
    (filter_x, filter_y, filter_z)[axis](block, taps, out)
    return out


def test_filters_are_numpys_correlation_along_each_axis():
    block = np.random.default_rng(0).normal(size=(9, 10, 11)).astype(np.float32)
    taps = gaussian_taps(0.7)
    for axis in range(3):
        expected = np.apply_along_axis(np.correlate, axis, block.astype(float), taps, "valid")
        np.testing.assert_allclose(filtered(block, taps, axis), expected, atol=1e-5)
    assert gaussian_taps(0.0).tolist() == [1.0] and derivative_taps(0.0).tolist() == [-0.5, 0.0, 0.5]
    assert (derivative_taps(0.7) * np.arange(-3, 4)).sum() == pytest.approx(1.0)


def test_the_gain_of_noise_is_measured():
    slope, smooth = derivative_taps(0.7), gaussian_taps(0.7)
    noise = np.random.default_rng(0).normal(size=(60, 60, 60)).astype(np.float32)
    gradient = filtered(filtered(filtered(noise, smooth, 2), smooth, 1), slope, 0)
    assert gradient.var() == pytest.approx(noise_gain(smooth, slope), rel=0.1)


def one_voxel_field():
    """A field with a direction at one voxel: along y, at (11, 3.5, 5.5) mm."""
    direction, sure = np.zeros((32, 16, 16, 3), np.int8), np.zeros((32, 16, 16), np.uint8)
    sure[20, 3, 5], direction[20, 3, 5] = 51, (0, 127, 0)
    bricks = BrickVolume.from_dense(sure, 0.5, (1.0, 2.0, 3.0))
    return OrientationField(BrickVolume(bricks.table, direction.reshape(2, 16, 16, 16, 3)[1:], 0.5, bricks.origin), bricks, {})


def test_voxels_and_lines_lie_where_the_field_has_a_direction():
    places, directions, confidence = one_voxel_field().voxels(10)
    np.testing.assert_allclose(places, [[11.0, 3.5, 5.5]])
    np.testing.assert_array_equal(directions, [[0, 1, 0]])
    np.testing.assert_allclose(confidence, [0.2])
    lines = one_voxel_field().lines()
    np.testing.assert_allclose(lines.points, [[11.0, 3.25, 5.5], [11.0, 3.75, 5.5]])
    np.testing.assert_allclose(lines.strand_attributes["confidence"], [0.2])


def test_no_more_voxels_than_asked_for_the_same_each_time():
    volume, _ = line((1.0, 0.3, 0.2), (64, 64, 64))
    field = orientation_field(BrickVolume.from_dense(tube(volume, (64, 64, 64)), 1.0), 0.35 * PEAK)
    places = field.voxels(50)[0]
    assert len(np.unique(places, axis=0)) == 50
    np.testing.assert_array_equal(places, field.voxels(50)[0])


def test_a_saved_field_is_two_grids_in_the_scan_frame(tmp_path):
    one_voxel_field().save(tmp_path / "orientation.vdb")
    vdb = openvdb()
    for name, expected in (("orientation", (0.0, 1.0, 0.0)), ("confidence", 0.2)):
        grid = vdb.read(str(tmp_path / "orientation.vdb"), name)
        assert grid.activeVoxelCount() == 1
        index = tuple(round(n) for n in grid.transform.worldToIndex((11.0, 3.5, 5.5)))
        np.testing.assert_allclose(grid.getConstAccessor().getValue(index), expected, atol=1e-6)
    assert [file.name for file in tmp_path.iterdir()] == ["orientation.vdb"]
