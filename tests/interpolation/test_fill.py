"""Dense strands: the count, the roots' places, shapes that blend as they must, and the weights computed by hand."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.errors import Cancelled
from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.interpolation import blend, blend_weights, fill, fill_scalp
from ct2hair_addon.interpolation.fill import spread_out
from ct2hair_addon.settings import InterpolationSettings
from ct2hair_addon.strands import Strands

COUNT = 1500


@pytest.fixture(scope="module")
def dense(guides, head):
    return fill_scalp(guides, head, COUNT, seed=5)


def test_the_count_is_exact_and_the_guides_come_first_untouched(dense, guides):
    assert len(dense.strands) == COUNT
    first = dense.strands.select(np.arange(len(guides)))
    np.testing.assert_array_equal(first.points, guides.points)
    np.testing.assert_array_equal(first.offsets, guides.offsets)
    attributes = dense.strands.strand_attributes
    assert attributes["guide"].tolist() == [True] * 300 + [False] * (COUNT - 300)
    np.testing.assert_array_equal(attributes["support"][:300], guides.strand_attributes["support"])
    assert not attributes["support"][300:].any()  # no density was given
    assert dense.tally["guides"] == 300 and dense.tally["new strands"] == COUNT - 300


def test_new_roots_lie_on_the_scalp_at_their_texture_coordinates(dense, head):
    found = head.closest_scalp(dense.strands.roots)
    assert found.distance.max() < 1e-3
    np.testing.assert_allclose(dense.strands.strand_attributes["root_uv"], found.uv, atol=1e-4)


def test_all_roots_together_are_blue_noise(dense, head):
    packing = np.sqrt(head.scalp_area / COUNT * 2.0 / np.sqrt(3.0))
    nearest = cKDTree(dense.strands.roots).query(dense.strands.roots, k=2)[0][:, 1]
    assert nearest.min() > 0.5 * packing
    # and no hole: every place of the scalp has a root within little more than the packing's distance
    assert cKDTree(dense.strands.roots).query(head.sample_scalp(3000, 9).position)[0].max() < 1.3 * packing


def test_guides_of_one_shape_give_strands_of_that_shape(dense, head, shape):
    new = dense.strands.select(np.arange(300, COUNT))
    root = head.closest_scalp(new.roots)
    frames = head.frames(root.face, root.bary).astype(np.float64)
    local = np.einsum("nij,npj->npi", frames, new.resampled(60) - new.roots[:, None])
    expected = Strands.from_polylines([shape]).resampled(60)[0]
    np.testing.assert_allclose(local, np.broadcast_to(expected, local.shape), atol=0.05)


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(dense, guides, head):
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        again = fill_scalp(guides, head, COUNT, seed=5)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(again.strands.points, dense.strands.points)
    assert not np.array_equal(fill_scalp(guides, head, COUNT, seed=6).strands.points, dense.strands.points)


def test_no_new_strand_runs_through_the_head(head):
    """Guides that run flat along the ball's tangent and dive under it when blended over a curved scalp."""
    sample = head.sample_scalp(60, 3)
    frames = head.frames(sample.face, sample.bary).astype(np.float64)
    along = np.linspace(0, 60, 40)
    flat = np.stack([along, 0 * along, -(along**2) / 140.0], axis=1)  # the ball itself falls by s^2 / 160
    points = sample.position[:, None] + np.einsum("nij,pi->npj", frames, flat)
    result = fill_scalp(Strands.from_array(points.astype(np.float32)), head, 600, seed=1)
    new = result.strands.select(np.arange(60, 600))
    inner = np.ones(len(new.points), bool)
    inner[new.offsets[:-1]] = False
    assert result.tally["new strands pushed out of the head"] > 300
    assert head.signed_distance(new.points[inner]).min() > -1e-3


def test_lengths_between_two_are_blended_and_partings_are_not_crossed(head):
    sample = head.sample_scalp(400, 4)
    frames = head.frames(sample.face, sample.bary).astype(np.float64)
    # to the left on the left, to the right on the right; longer to the back
    side = np.where(sample.position[:, 0] > 0, 1.0, -1.0)
    long = 40.0 + 0.1 * sample.position[:, 1]
    t = np.linspace(0, 1, 30)
    local = np.stack([side[:, None] * 0.9 * t, 0 * side[:, None] * t, 0.45 + 0 * side[:, None] * t], axis=2)
    local[:, :, 2] *= t
    points = sample.position[:, None] + np.einsum("nij,npi->npj", frames, long[:, None, None] * local)
    guides = Strands.from_array(points.astype(np.float32))
    new = fill_scalp(guides, head, 1600, seed=2).strands.select(np.arange(400, 1600))
    expected = (40.0 + 0.1 * new.roots[:, 1]) * np.hypot(0.9, 0.45)
    assert np.abs(new.lengths() / expected - 1.0).max() < 0.06
    root = head.closest_scalp(new.roots)
    tips = np.einsum("nij,nj->ni", head.frames(root.face, root.bary), new.tips - new.roots)
    sideways = tips[:, 0] / new.lengths()
    # a mean over the parting would stand straight up
    assert np.abs(sideways).min() > 0.7


def test_where_more_guides_are_given_than_wanted_the_best_backed_stay(guides, head):
    result = fill_scalp(guides, head, 100)
    support = guides.strand_attributes["support"]
    kept = np.sort(np.argsort(-support, kind="stable")[:100])
    np.testing.assert_array_equal(result.strands.points, guides.select(kept).points)
    assert result.tally["guides left out: more than strands wanted, least backed"] == 200
    assert result.strands.strand_attributes["guide"].all()


def test_without_a_count_the_distances_decide(guides, head, monkeypatch):
    monkeypatch.setattr(fill, "PAPER_SAMPLES", 3000)
    settings = InterpolationSettings(texture=2048, nearest=8.0, farthest=60.0)
    result = fill_scalp(guides, head, 0, settings)
    uv = result.strands.strand_attributes["root_uv"]
    texels = cKDTree(uv[:300]).query(uv[300:])[0] * 2048
    assert len(texels) > 500 and texels.min() >= 8.0 and texels.max() <= 60.0
    # farther than allowed gives way to a count, and is counted
    made = fill_scalp(guides, head, 800, replace(settings, nearest=0.0, farthest=5.0))
    assert len(made.strands) == 800 and made.tally["new roots beyond the farthest texel"] > 0


def test_support_is_what_the_scan_holds(guides, head, dense):
    new = dense.strands.select(np.arange(300, COUNT))
    left = new.select(new.roots[:, 0] > 30)
    density = render_density(left, 1.0, 0.85)
    result = fill_scalp(guides, head, COUNT, seed=5, density=density, hair_level=0.35 * strand_peak(0.85))
    support = result.strands.strand_attributes["support"][300:]
    assert support[new.roots[:, 0] > 30].min() > 0.6
    assert support[new.roots[:, 0] < -40].max() < 0.05


def test_no_guides_are_no_strands(head):
    result = fill_scalp(Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64)), head, 100)
    assert len(result.strands) == 0 and set(result.strands.strand_attributes) == {"root_uv", "support", "guide"}


def test_it_can_be_cancelled(guides, head):
    def stop(done, total):
        if done > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        fill_scalp(guides, head, COUNT, progress=stop)


def test_guides_without_attributes_get_the_scalps(guides, head):
    bare = replace(guides, strand_attributes={})
    attributes = fill_scalp(bare, head, 400).strands.strand_attributes
    np.testing.assert_allclose(attributes["root_uv"][:300], guides.strand_attributes["root_uv"], atol=1e-4)
    assert (attributes["support"][:300] == 1.0).all()


UP, OVER, DOWN = [0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, -1.0]


@pytest.mark.parametrize(
    ("distance", "directions", "lengths", "least", "expected"),
    [
        # alike: by nearness alone
        ([1, 2, 4], [UP, UP, UP], [10, 10, 10], 0.85, [4 / 7, 2 / 7, 1 / 7]),
        # the opposite one parts ways
        ([1, 2, 4], [UP, UP, DOWN], [10, 10, 10], 0.85, [2 / 3, 1 / 3, 0]),
        # cosine 0.8: out at 0.85, in at 0.7 with its likeness for a weight
        ([1, 1, 2], [UP, OVER, UP], [10, 10, 10], 0.85, [2 / 3, 0, 1 / 3]),
        ([1, 1, 2], [UP, OVER, UP], [10, 10, 10], 0.7, [1 / 2.3, 0.8 / 2.3, 0.5 / 2.3]),
        # nine tenths of the length, either way round; and half of it
        ([1, 1, 1], [UP, UP, UP], [9, 10, 4.5], 0.85, [1 / 1.9, 0.9 / 1.9, 0]),
        # on a guide itself
        ([0, 2, 4], [UP, UP, UP], [10, 10, 10], 0.85, [1, 0, 0]),
    ],
)
def test_blend_weights_by_hand(distance, directions, lengths, least, expected):
    found = blend_weights(
        np.array([distance], float),
        np.array([[0, 1, 2]]),
        np.array(directions, float)[:, None],
        np.array(lengths, float),
        least,
    )
    np.testing.assert_allclose(found, [expected], atol=1e-6)


def test_a_blend_is_the_weighted_sum():
    codes = np.array([[[1.0, 0.0], [0.0, 2.0]], [[4.0, 4.0], [8.0, 0.0]]], np.float32)
    np.testing.assert_allclose(blend(codes, np.array([[0.5, 0.5], [0.25, 0.75]], np.float32)), [[0.5, 1.0], [7.0, 1.0]])


def test_darts_keep_their_distance_from_the_taken_and_from_each_other():
    generator = np.random.default_rng(0)
    candidates, taken = generator.uniform(0, 10, (4000, 3)) * [1, 1, 0], np.array([[5.0, 5.0, 0.0], [-3.0, 12.0, 0.0]])
    chosen = spread_out(candidates, taken, 1.0, 1.0, 4000)
    every = np.concatenate([taken, candidates[chosen]])
    assert cKDTree(every).query(every, k=2)[0][:, 1].min() >= 1.0
    assert len(set(chosen.tolist())) == len(chosen)
    # full: no candidate is left that would have kept the distance
    assert cKDTree(every).query(candidates)[0].max() < 1.0
    # relaxed until the count is there
    assert len(spread_out(candidates, taken, 1.0, 0.0, 500)) == 500
