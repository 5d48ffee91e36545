"""A lone strand's profile is measured where strands run alone, and taken from the thresholds' peak where none does."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.guides.profile import strand_profile
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume
from ct2hair_addon.volume.strand_signal import TYPICAL_BLUR, StrandProfile, alone, data_floor, lone_profile

SPACING, BLUR = 0.4, 0.85
PEAK = strand_peak(BLUR)
LEVEL = 0.4 * PEAK


def parallel(across: np.ndarray, seed: int) -> Strands:
    """Strands of 60 mm at `across` (N, 2) mm, all but parallel to (0.36, 0.48, 0.8)."""
    generator = np.random.default_rng(seed)
    axis = np.array([0.36, 0.48, 0.8])
    u = np.cross(axis, [0.0, 0.0, 1.0])
    u /= np.linalg.norm(u)
    start = across[:, :1] * u + across[:, 1:] * np.cross(axis, u)
    lean = axis + generator.normal(0.0, 0.01, (len(across), 3))
    return Strands.from_array((start[:, None] + np.linspace(0, 60, 80)[None, :, None] * lean[:, None]).astype(np.float32))


@pytest.fixture(scope="module")
def lone():
    grid = np.stack(np.meshgrid(np.arange(7), np.arange(7)), -1).reshape(-1, 2)
    strands = parallel(6.0 * grid + np.random.default_rng(1).uniform(-1, 1, (49, 2)), 2)
    return strands, render_density(strands, SPACING, BLUR)


@pytest.fixture(scope="module")
def rope():
    """Pairs, threes and a core of many, none alone."""
    generator = np.random.default_rng(3)
    core = generator.normal(0.0, 1.0, (150, 2))
    edge = np.repeat(np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2) * 7.0 + 8.0, 3, axis=0)
    strands = parallel(np.concatenate([core, edge + generator.normal(0.0, 0.05, edge.shape)]), 4)
    return strands, render_density(strands, SPACING, BLUR)


def candidates(strands: Strands, density):
    """Voxels and directions of hair, as the guides' seeds are."""
    steps = strands.resampled_by_step(3.0)
    return np.rint(density.to_voxel(steps.points)), steps.tangents().astype(np.float64)


def mass(profile: StrandProfile) -> float:
    """Over that of one strand."""
    return profile.line_mass / StrandProfile.gaussian(PEAK, BLUR, SPACING).line_mass


@pytest.mark.parametrize("peak", [0.0, 1.06 * PEAK], ids=["unknown", "known"])
def test_lone_strands_are_measured(lone, peak):
    strands, density = lone
    for profile in (
        lone_profile(density, LEVEL, strands, peak),
        strand_profile(density, LEVEL, *candidates(strands, density), peak),
    ):
        assert profile.pieces > 0
        assert mass(profile) == pytest.approx(1.0, rel=0.08)
        assert profile.blur == pytest.approx(BLUR, abs=0.04)


def test_among_bundles_the_thresholds_peak_stands_in(rope):
    strands, density = rope
    known = StrandProfile.gaussian(PEAK, TYPICAL_BLUR, SPACING)
    fooled = strand_profile(density, LEVEL, *candidates(strands, density))
    assert mass(fooled) > 1.4
    assert strand_profile(density, LEVEL, *candidates(strands, density), PEAK) == known
    assert mass(lone_profile(density, LEVEL, strands, PEAK)) == pytest.approx(mass(known))


@pytest.mark.parametrize("blur", [0.6, 0.85, 1.1])
def test_another_blur_is_no_bundle(blur):
    measured = StrandProfile.gaussian(1.0, blur, SPACING, 100)
    seen = blur**2 / (blur**2 + 1.0) / (TYPICAL_BLUR**2 / (TYPICAL_BLUR**2 + 1.0))  # the peak that thresholds take it for
    assert alone(measured, seen, SPACING) is measured
    assert alone(measured, seen / 1.3, SPACING).peak == pytest.approx(seen / 1.3)
    assert alone(measured, 0.0, SPACING) is measured


class Ball:
    """A head of which every distance is known."""

    def signed_distance(self, points, beyond=np.inf):
        return np.linalg.norm(np.asarray(points, np.float64) - 20.0, axis=1) - 9.0


@pytest.mark.parametrize("cut", [0.0, 1.5, 3.0])
def test_the_floor_is_where_hair_begins_over_the_head_a_few_left_overs_aside(cut):
    places = np.stack(np.meshgrid(*3 * [np.arange(80)], indexing="ij"), axis=-1).reshape(-1, 3)
    over = Ball().signed_distance(0.5 * places).reshape(80, 80, 80)
    hair = np.where((over > cut) & (over < 8.0), 50.0, 0.0).astype(np.float32)
    hair[40 + 20, 40, 40] = hair[40, 40, 40 + 20] = 50.0  # on the skin
    found = data_floor(BrickVolume.from_dense(hair, 0.5), 20.0, Ball())
    assert found == pytest.approx(cut, abs=0.25)
    assert data_floor(BrickVolume.from_dense(np.zeros((16, 16, 16), np.float32), 0.5), 20.0, Ball()) == 0.0
