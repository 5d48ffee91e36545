"""BrickVolume: the frame, blocks and samples against the dense array that they come from."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from ct2hair_addon.volume import BrickVolume


def phantom() -> np.ndarray:
    """An asymmetric volume: every axis and direction is told apart."""
    array = np.zeros((40, 20, 70), np.float32)
    array[3, 4, 50] = 7.0
    array[33:36, 2:18, 10:13] = np.arange(3 * 16 * 3, dtype=np.float32).reshape(3, 16, 3) + 1
    return array


def test_blocks_equal_the_dense_array_and_reach_past_its_ends():
    array = phantom()
    volume = BrickVolume.from_dense(array, 0.4, (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(volume.block((0, 0, 0), array.shape), array)
    np.testing.assert_array_equal(volume.block((30, -2, 5), (38, 6, 15))[:, 2:], array[30:38, :6, 5:15])
    assert not volume.block((-9, -9, -9), (0, 0, 0)).any()
    assert len(volume.bricks) < volume.table.size


def test_voxel_centres_follow_the_convention_of_openvdb_and_itk():
    volume = BrickVolume.from_dense(phantom(), 0.4, (1.0, 2.0, 3.0))
    centre = np.array([[1.0 + 3 * 0.4, 2.0 + 4 * 0.4, 3.0 + 50 * 0.4]])
    np.testing.assert_allclose(volume.to_voxel(centre), [[3, 4, 50]])
    np.testing.assert_allclose(volume.to_scan([[3, 4, 50]]), centre)
    np.testing.assert_allclose(volume.sample(centre), [7.0], atol=1e-5)
    np.testing.assert_allclose(volume.sample(centre + [[0.1, 0.0, 0.0]]), [7.0 * 0.75], atol=1e-5)


@pytest.mark.parametrize("background", [0.0, -3.0])
def test_samples_are_trilinear_within_a_brick_and_across_bricks_and_their_ends(background):
    random = np.random.default_rng(0)
    array = random.normal(0.0, 1.0, (48, 32, 48)).astype(np.float32)
    array[16:32, :16, 16:32] = background  # a brick that is not stored
    volume = BrickVolume.from_dense(array, 0.4, background=background)
    assert len(volume.bricks) == 17
    places = random.uniform(-20.0, 70.0, (20_000, 3))
    expected = map_coordinates(np.pad(array, 40, constant_values=background), (places + 40).T, order=1)
    np.testing.assert_allclose(volume.sample(volume.to_scan(places)), expected, atol=1e-5)


def test_brick_index_names_the_brick_of_each_row():
    volume = BrickVolume.from_dense(phantom(), 1.0)
    for row, (i, j, k) in enumerate(volume.brick_index):
        low = 16 * np.array([i, j, k])
        np.testing.assert_array_equal(volume.bricks[row], volume.block(low, low + 16))


def test_voxels_above_a_level_are_counted_brick_by_brick():
    generator = np.random.default_rng(6)
    for values in (
        generator.normal(0.0, 9.0, (40, 20, 33)).astype(np.float32),
        generator.integers(-90, 90, (17, 16, 50), np.int16),
    ):
        volume = BrickVolume.from_dense(values, 0.5)
        for level in (-5.0, 0.0, 7.3):
            np.testing.assert_array_equal(volume.count_above(level), (volume.bricks > level).sum(axis=(1, 2, 3)))
