"""Guides from pieces of fitted strands and what is traced beside them."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.evaluation.scores import strand_scores
from ct2hair_addon.guides import amend_guides
from ct2hair_addon.head import Head
from ct2hair_addon.orientation import orientation_field
from ct2hair_addon.refinement import unexplained, without_surplus
from ct2hair_addon.settings import GuideSettings
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume
from ct2hair_addon.volume.strand_signal import StrandProfile

SPACING, BLUR, LEVEL = 0.5, 0.85, 0.05


@pytest.fixture(scope="module")
def ball(make_ball) -> Head:
    return Head(make_ball(60.0))


@pytest.fixture(scope="module")
def hair(ball) -> Strands:
    """Forty strands that stand off the ball, fanned out over its top, 60 mm long."""
    lines = []
    for turn in np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False):
        lean = np.array([0.35 * np.cos(turn), 0.35 * np.sin(turn), 1.0])
        lean /= np.linalg.norm(lean)
        start = ball.closest_scalp(100.0 * lean[None]).position[0]
        lines.append(start + lean * np.linspace(0.0, 60.0, 121)[:, None])
    return Strands.from_polylines([line.astype(np.float32) for line in lines])


@pytest.fixture(scope="module")
def scan(hair) -> BrickVolume:
    return render_density(hair, SPACING, BLUR)


def test_what_was_cut_out_is_traced_anew_and_joined(ball, hair, scan):
    profile = StrandProfile.gaussian(strand_peak(BLUR), BLUR, SPACING)
    # of every fourth strand nothing is left, of a third of the others the first half
    kept = [line for n, line in enumerate(hair.polylines()) if n % 4 != 0]
    kept = [line[:60] if n % 3 == 0 else line for n, line in enumerate(kept)]
    pieces, _ = without_surplus(Strands.from_polylines(kept), scan, LEVEL, ball, profile)
    rest = partial(unexplained, pieces, scan, LEVEL, ball, profile)
    assert len(pieces) == 30
    guides = amend_guides(
        pieces, rest, scan, LEVEL, orientation_field(scan, LEVEL), ball, profile, GuideSettings(), counted=False
    )
    assert guides.tally["traced beside them"] == 20
    assert len(guides.strands) == 40
    assert strand_scores(hair, guides.strands)["consistency"] > 0.95
    support = guides.strands.strand_attributes["support"]
    assert support.dtype == np.float32 and support.min() > 0.8
    assert ball.closest_scalp(guides.strands.roots).distance.max() < 0.05
