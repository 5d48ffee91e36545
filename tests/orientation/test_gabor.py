"""The Gabor ablation: kernels deaf to what they must not hear, and directions of known strands."""

import numpy as np
import pytest

from ct2hair_addon.orientation import orientation_field
from ct2hair_addon.orientation.gabor import half_sphere, kernels
from ct2hair_addon.settings import OrientationSettings
from ct2hair_addon.volume import BrickVolume

SETTINGS = OrientationSettings(method="gabor")


def strand(direction, shape=(40, 40, 40)) -> tuple[np.ndarray, np.ndarray]:
    """(volume, unit direction): a lone strand of peak 100 through the middle."""
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1) - np.array(shape) / 2.0
    along = grid @ direction
    square = (grid**2).sum(-1) - along**2
    return (100.0 * np.exp(-0.5 * square / 0.85**2)).astype(np.float32), direction


def test_kernels_are_deaf_to_constants_and_alike_in_noise():
    directions = half_sphere(40)
    offsets, taps = kernels(directions)
    np.testing.assert_allclose(taps.sum(axis=1), 0.0, atol=1e-4)
    np.testing.assert_allclose((taps.astype(float) ** 2).sum(axis=1), 1.0, atol=1e-5)
    assert (np.linalg.norm(offsets, axis=1) <= 4.0).all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    nearest = np.sort(np.abs(directions @ directions.T), axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).max() < 25.0  # no hole on the half sphere


@pytest.mark.parametrize("direction", [(1, 0, 0), (0.3, 0.5, 1.0), (1, -1, 0.2), (0.1, -0.9, -0.4)])
def test_a_strand_has_its_own_direction(direction):
    volume, direction = strand(direction)
    field = orientation_field(BrickVolume.from_dense(volume, 0.4, (1.0, 2.0, 3.0)), 40.0, SETTINGS)
    places = 20.0 + np.linspace(-10, 10, 21)[:, None] * direction
    found, confidence = field.sample(field.direction.to_scan(places))
    assert np.degrees(np.arccos(np.abs(found @ direction).clip(max=1.0))).max() < 4.0
    assert confidence.min() > 0.5
    assert field.tally["with a direction"] == np.count_nonzero(field.confidence.bricks)


def test_noise_turns_directions_and_off_the_hair_there_are_none():
    volume, direction = strand((0.3, 0.5, 1.0))
    noisy = volume + np.random.default_rng(0).normal(0, 25, volume.shape).astype(np.float32)
    field = orientation_field(BrickVolume.from_dense(noisy, 0.4), 40.0, SETTINGS)
    places = 20.0 + np.linspace(-10, 10, 41)[:, None] * direction
    found, _ = field.sample(field.direction.to_scan(places))
    known = np.linalg.norm(found, axis=1) > 0.5
    assert known.mean() > 0.7
    assert np.median(np.degrees(np.arccos(np.abs(found[known] @ direction).clip(max=1.0)))) < 12.0
    assert not field.confidence.bricks[BrickVolume.from_dense(noisy, 0.4).bricks <= 40.0].any()
