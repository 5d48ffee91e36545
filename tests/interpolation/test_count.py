"""The number of strands in a scan, from its density and a part of its strands."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.interpolation import estimate_strand_count
from ct2hair_addon.interpolation.count import FEWEST, MOST, shown_lengths
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume

SPACING, BLUR = 0.8, 0.85
LEVEL = 0.35 * strand_peak(BLUR)


@pytest.fixture(scope="module")
def hair(head) -> Strands:
    """700 bent strands of 30 to 60 mm on the ball: sparse enough that some run alone."""
    generator = np.random.default_rng(7)
    sample = head.sample_scalp(700, 7)
    t = np.linspace(0, 1, 30)[None, :, None]
    long, bend = generator.uniform(30, 60, (700, 1, 1)), generator.normal(0, 6.0, (700, 1, 3))
    points = sample.position[:, None] + sample.normal[:, None] * long * t + bend * t**2
    return Strands.from_array(points.astype(np.float32))


def found_guides(hair: Strands, share: float, seed: int) -> Strands:
    """As tracing finds them: a long strand likelier than a short one."""
    lengths = hair.lengths().astype(np.float64)
    count = int(share * len(hair))
    chosen = np.random.default_rng(seed).choice(len(hair), count, replace=False, p=lengths / lengths.sum())
    return hair.select(np.sort(chosen)).with_attributes(support=np.ones(count, np.float32))


@pytest.mark.parametrize("share", [0.3, 0.8])
@pytest.mark.parametrize("noise", [0.0, 0.25])
def test_the_count_is_within_15_percent_of_the_truth(share, noise, hair, head):
    density = render_density(hair, SPACING, BLUR)
    if noise:
        values = density.bricks + np.random.default_rng(1).normal(0, noise * strand_peak(BLUR), density.bricks.shape)
        density = BrickVolume(density.table, values.astype(np.float32), SPACING, density.origin)
    found = estimate_strand_count(density, LEVEL, found_guides(hair, share, 3), head)
    assert found == pytest.approx(len(hair), rel=0.15)


def test_the_zone_that_the_net_left_empty_counts_in_neither_length(hair, head):
    steps = hair.resampled_by_step(0.5)
    shown = Strands.from_polylines([line[head.signed_distance(line) > 6.0] for line in steps.polylines()])
    density = render_density(shown, SPACING, BLUR)
    found = estimate_strand_count(density, LEVEL, found_guides(hair, 0.5, 3), head)
    assert found == pytest.approx(len(hair), rel=0.15)


def test_shown_lengths_leave_the_zone_out(hair, head):
    whole = shown_lengths(hair, head, 0.0)
    np.testing.assert_allclose(whole, hair.lengths())
    assert np.median(whole - shown_lengths(hair, head, 6.0)) == pytest.approx(6.0, abs=1.0)


def test_the_count_stays_within_its_bounds(hair, head):
    density = render_density(hair, SPACING, BLUR)
    none = Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
    assert estimate_strand_count(density, LEVEL, none, head) == FEWEST
    few = render_density(hair.select(np.arange(20)), SPACING, BLUR)
    assert estimate_strand_count(few, LEVEL, found_guides(hair, 0.5, 3), head) == FEWEST
    dense = BrickVolume(density.table, density.bricks * 1e5, SPACING, density.origin)
    assert estimate_strand_count(dense, LEVEL, found_guides(hair, 0.5, 3), head) <= MOST
