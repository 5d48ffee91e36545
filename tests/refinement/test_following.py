"""Traces that hop between neighbours are drawn along the orientation field; curls, roots and what disagrees stay."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.refinement.following import along_field
from ct2hair_addon.strands import Strands

VOXEL = 0.4


def upward(points):
    """A field of hair that all runs along z, told with either sign."""
    directions = np.zeros((len(points), 3), np.float32)
    directions[:, 2] = np.where(np.arange(len(points)) % 2, 1.0, -1.0)
    return directions, np.ones(len(points), np.float32)


def hopping(length: float = 60.0, aside: float = 0.5) -> Strands:
    """Along z, from one neighbour to the next and back, 0.5 mm aside, every 6 mm."""
    z = np.arange(0.0, length, VOXEL)
    x = aside * (np.floor(z / 6.0) % 2)
    x = np.convolve(np.pad(x, 4, mode="edge"), np.ones(9) / 9.0, mode="valid")
    return Strands.from_array(np.stack([x - x[0], 0.0 * z, z], axis=1)[None].astype(np.float32), root_uv=np.full((1, 2), 0.5))


def steepest(strands: Strands) -> float:
    """The 90 % quantile of the angle to z, degrees."""
    return float(np.quantile(np.degrees(np.arccos(np.clip(np.abs(strands.tangents()[:, 2]), 0.0, 1.0))), 0.9))


def test_hops_give_way_to_the_field_and_places_stay():
    strands = hopping()
    drawn = along_field(strands, np.array([12 * VOXEL]), upward, VOXEL)
    assert steepest(strands) > 7.0 and steepest(drawn) < 3.0
    np.testing.assert_array_equal(drawn.roots, strands.roots)
    assert np.abs(drawn.points[:, 0]).max() < 0.6 and drawn.points[20:, 0].mean() == pytest.approx(0.25, abs=0.06)
    assert drawn.lengths()[0] == pytest.approx(strands.lengths()[0], rel=0.02)
    assert "root_uv" in drawn.strand_attributes


def test_a_length_of_zero_leaves_a_strand_as_it_is():
    two = Strands.from_array(np.repeat(hopping().points[None], 2, axis=0))
    drawn = along_field(two, np.array([0.0, 12 * VOXEL]), upward, VOXEL)
    even = two.resampled_by_step(VOXEL)
    half = even.offsets[1]
    np.testing.assert_allclose(drawn.points[:half], even.points[:half], atol=1e-5)
    assert np.abs(drawn.points[half:] - even.points[half:]).max() > 0.1


def test_a_field_of_other_hair_or_without_confidence_changes_little():
    strands = hopping()
    even = strands.resampled_by_step(VOXEL).points

    def sideways(points):
        directions = np.zeros((len(points), 3), np.float32)
        directions[:, 1] = 1.0
        return directions, np.ones(len(points), np.float32)

    def nothing(points):
        return np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)

    for field in (sideways, nothing):
        drawn = along_field(strands, np.array([12 * VOXEL]), field, VOXEL)
        assert np.abs(drawn.points[:, 1]).max() < 1e-4 and np.abs(drawn.points - even).max() < 0.25


def test_no_strands_and_progress():
    none = Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
    assert len(along_field(none, np.zeros(0), upward, VOXEL)) == 0
    told = []
    along_field(hopping(), np.array([5.0]), upward, VOXEL, lambda done, total: told.append(done / total))
    assert told[-1] == 1.0
