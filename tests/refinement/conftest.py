"""A ball of 40 mm and a lone strand's signature, as exact as the renderer makes it."""

from __future__ import annotations

import pytest

from ct2hair_addon.evaluation import strand_peak
from ct2hair_addon.head import Head
from ct2hair_addon.volume.strand_signal import StrandProfile

SPACING, BLUR = 0.6, 0.85


@pytest.fixture(scope="session")
def head(make_ball) -> Head:
    return Head(make_ball(40.0))


@pytest.fixture(scope="session")
def profile() -> StrandProfile:
    """Of what `render_density` makes at 0.6 mm: two points a voxel under a Gaussian of 0.85 voxel."""
    peak = strand_peak(BLUR)
    return StrandProfile.gaussian(peak, BLUR, SPACING, 1000)
