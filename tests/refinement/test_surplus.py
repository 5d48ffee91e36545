"""What fitted strands have too many is cut out, and what the scan shows beyond the rest is left to be traced."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.evaluation import render_density
from ct2hair_addon.refinement import refine, unexplained, without_surplus
from ct2hair_addon.strands import Strands, concatenate
from ct2hair_addon.volume import BrickVolume
from ct2hair_addon.volume.grid import trilinear

SPACING, BLUR, LEVEL = 0.6, 0.85, 0.02
ALONG = np.linspace(0.0, 60.0, 121)
LANES = (0.0, 2.4)


def path(across: np.ndarray) -> Strands:
    """A strand over the ball, 12 mm above it, slanted so that none lies on the lattice."""
    points = np.stack([across + 0.11 * ALONG, 0.07 * ALONG - 2.0, 52.0 + ALONG], axis=1)
    return Strands.from_array(points[None].astype(np.float32))


def lane(place: float) -> Strands:
    return path(np.full_like(ALONG, place))


def hopped() -> Strands:
    """From one lane over to the other at 30 mm."""
    return path(LANES[0] + (LANES[1] - LANES[0]) / (1.0 + np.exp(30.0 - ALONG)))


@pytest.fixture(scope="module")
def scan():
    return render_density(concatenate([*map(lane, LANES)]), SPACING, BLUR)


def left_at(rest, place: float, along: float, peak: float) -> float:
    """The density that is left on a lane, of a lone strand's: the scan counts points in whole voxels, to a quarter."""
    point = rest.to_voxel(np.array([[place + 0.11 * along, 0.07 * along - 2.0, 52.0 + along]]))[0]
    return trilinear(rest.table, rest.bricks, np.float32(0.0), *point) / peak


def judged(strands: Strands, scan, head, profile):
    """(pieces, what is left of the scan, control points cut out)"""
    pieces, tally = without_surplus(strands, scan, LEVEL, head, profile)
    assert tally["pieces kept"] == len(pieces)
    rest = unexplained(pieces, scan, LEVEL, head, profile)
    return pieces, rest, tally["stretches cut out, control points"]


def test_strands_that_explain_the_scan_stay_and_leave_nothing(scan, head, profile):
    given = concatenate([*map(lane, LANES)])
    pieces, rest, cut = judged(given, scan, head, profile)
    assert cut == 0
    assert len(pieces) == 2
    np.testing.assert_allclose(pieces.lengths(), given.lengths(), rtol=1e-3)
    for place in LANES:
        for along in np.arange(6.0, 54.0, 1.0):
            assert left_at(rest, place, along, profile.seen) == pytest.approx(0.0, abs=0.25)


def test_bent_strands_are_fitted_and_kept_as_curves_not_as_chords(head, profile):
    angle = np.linspace(0.0, 1.5, 121)
    arc = np.stack([30.0 * np.cos(angle) - 30.0, 0.0 * angle, 52.0 + 30.0 * np.sin(angle)], axis=1)
    given = Strands.from_array(arc[None].astype(np.float32)).with_attributes(guide=np.ones(1, bool))
    scan = render_density(given, SPACING, BLUR)
    fitted = refine(given, scan, LEVEL, head, profile=profile, final=False).strands
    pieces, _ = without_surplus(fitted, scan, LEVEL, head, profile)
    assert len(pieces) == 1
    for points in (fitted.points, pieces.points):
        radius = np.hypot(points[:, 0] + 30.0, points[:, 2] - 52.0)
        assert np.abs(radius - 30.0)[5:-5].max() < 0.15 * SPACING
        middle = 0.5 * (points[1:] + points[:-1])
        sag = 0.5 * (radius[1:] + radius[:-1]) - np.hypot(middle[:, 0] + 30.0, middle[:, 2] - 52.0)
        assert np.abs(sag)[5:-5].max() < 0.02 * SPACING


@pytest.mark.parametrize(("value", "whole"), [(0.0, True), (1e-30, False)], ids=["cleared", "air"])
def test_what_runs_where_the_scan_was_cleared_is_no_surplus(scan, head, profile, value, whole):
    given = concatenate([*map(lane, LANES)])
    height = scan.origin[2] + SPACING * (16 * scan.brick_index[:, 2, None] + np.arange(16))
    bricks = np.where((height > 80.0)[:, None, None, :], np.float32(value), np.maximum(scan.bricks, np.float32(1e-30)))
    holed = BrickVolume(scan.table, bricks, scan.spacing, scan.origin)
    pieces, rest, cut = judged(given, holed, head, profile)
    assert (cut == 0) == whole
    assert pieces.points[:, 2].max() == pytest.approx(112.0 if whole else 80.0, abs=3.0)
    if whole:
        assert left_at(rest, LANES[0], 40.0, profile.seen) == 0.0


def test_one_that_went_over_is_cut_where_it_doubles_and_its_own_way_is_left(scan, head, profile):
    pieces, rest, cut = judged(concatenate([lane(LANES[1]), hopped()]), scan, head, profile)
    assert cut > 0
    heights = [(part[0, 2] - 52.0, part[-1, 2] - 52.0) for part in np.split(pieces.points, pieces.offsets[1:-1])]
    assert pieces.lengths().sum() == pytest.approx(90.0, abs=8.0)  # of 60 and 60 mm, 30 are doubled
    assert min(low for low, _ in heights) < 1.0 and max(high for _, high in heights) > 59.0
    for along in (40.0, 50.0):
        assert left_at(rest, LANES[0], along, profile.seen) == pytest.approx(1.0, abs=0.25)
        assert left_at(rest, LANES[1], along, profile.seen) == pytest.approx(0.0, abs=0.25)
    for place in LANES:
        assert left_at(rest, place, 12.0, profile.seen) == pytest.approx(0.0, abs=0.25)


def test_where_all_is_surplus_nothing_is_kept(scan, head, profile):
    away = lane(20.0)
    pieces, rest, _ = judged(away, scan, head, profile)
    assert len(pieces) == 0
    np.testing.assert_allclose(rest.bricks, scan.bricks, atol=1e-6)
