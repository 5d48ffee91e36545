"""What is taken away because the scan does not need it: doubles, tips in the air, strands that cross the air to dense hair."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.refinement.pruning import CUT_BACK, REMOVED, prune
from ct2hair_addon.strands import Strands, concatenate
from ct2hair_addon.volume.strand_signal import StrandProfile

VOXEL = 0.5
BLUR = 0.85
PROFILE = StrandProfile.gaussian(strand_peak(BLUR), BLUR, VOXEL)
LENGTH = 40.0


def line(x: float, low: float = 0.0, high: float = LENGTH) -> Strands:
    # slanted, so that no strand lies on the lattice
    points = np.linspace([x + 0.13 * low, 0.09 * low, low], [x + 0.13 * high, 0.09 * high, high], 41)
    return Strands.from_array(points[None].astype(np.float32))


def pruned(
    hair: Strands, strands: Strands, reach: float = 0.0, traced: list[bool] | None = None, fewest: int = 0
) -> np.ndarray:
    """How many of its points each of `strands` keeps over a scan that shows `hair`."""
    scan = render_density(concatenate([hair, line(-20.0, -10.0, 50.0)]), VOXEL, BLUR)
    kept, tally = prune(
        strands.points.astype(np.float64),
        strands.offsets,
        np.ones(len(strands.points)),
        scan,
        PROFILE,
        reach=reach,
        traced=None if traced is None else np.array(traced),
        fewest=fewest,
    )
    assert tally[REMOVED] == np.count_nonzero(kept == 0)
    assert tally[CUT_BACK] == np.count_nonzero((kept > 0) & (kept < strands.counts))
    return kept


def test_what_the_scan_shows_stays_whole():
    hair = concatenate([line(0.0), line(4.0)])
    assert pruned(hair, hair).tolist() == [41, 41]


def test_of_two_where_the_scan_shows_one_one_stays():
    assert sorted(pruned(line(0.0), concatenate([line(0.0), line(0.1)])).tolist()) == [0, 41]


def test_a_traced_strand_goes_only_where_it_doubles_others_all_along():
    hair = line(0.0)
    assert sorted(pruned(hair, concatenate([hair, line(0.1)]), traced=[True, True]).tolist()) == [0, 41]
    short, beside = line(4.0, 0.0, 10.0), line(4.4, 0.0, 10.0)  # 0.8 voxels off its hair: it earns too little if made up
    assert pruned(short, beside).tolist() == [0]
    assert pruned(short, beside, traced=[True]).tolist() == [41]
    aside = np.linspace(-15.0, 15.0, 41).clip(0.0)
    parting = Strands.from_array(line(0.0).points[None] + aside[:, None] * np.array([1.0, 0.0, 0.0], np.float32))
    both = concatenate([hair, parting])  # one strand in the first half, two in the second
    scan = concatenate([hair, Strands.from_array(parting.points[None, 20:])])
    assert 0 in pruned(scan, both)
    assert pruned(scan, both, traced=[True, True]).tolist() == [41, 41]


def test_where_no_more_traced_ones_are_left_than_are_known_none_goes_but_made_up_ones():
    hair, three = line(0.0), concatenate([line(0.0), line(0.1), line(0.2)])
    for fewest, left in ((0, 1), (1, 1), (2, 2), (3, 3), (9, 3)):
        assert np.count_nonzero(pruned(hair, three, traced=[True] * 3, fewest=fewest)) == left
    stay = pruned(hair, concatenate([three, line(8.0)]), traced=[True, True, True, False], fewest=3)
    assert stay.tolist() == [41, 41, 41, 0]


def test_two_where_the_scan_shows_two_stay():
    hair = concatenate([line(0.0), line(0.6)])
    assert pruned(hair, hair).tolist() == [41, 41]


def test_a_tip_in_the_air_is_cut_and_a_strand_in_the_air_goes():
    stay = pruned(line(0.0, 0.0, 25.0), concatenate([line(0.0), line(8.0)]))
    assert stay[0] == pytest.approx(26, abs=1) and stay[1] == 0


def test_what_crosses_the_air_to_hair_that_lacks_strands_goes_once_it_is_fitted():
    hair = concatenate([line(x, 24.0) for x in np.linspace(-0.4, 0.4, 12)])
    crossing = line(0.0)
    assert pruned(hair, crossing, reach=2.0).tolist() == [41]  # before the fit, strands may still be beside their hair
    assert pruned(hair, crossing).tolist() == [0]
    assert pruned(hair, line(0.0, 22.0)).tolist() == [41]
