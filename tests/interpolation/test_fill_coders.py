"""Filling a scalp: the guides stay, the count is met, the same bits on any threads, by every coder."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from ct2hair_addon.evaluation import hairstyle
from ct2hair_addon.head import Head, template_head
from ct2hair_addon.interpolation import fill_scalp
from ct2hair_addon.settings import Settings


@pytest.fixture(scope="module")
def dressed():
    mesh = template_head()
    return Head(mesh), hairstyle("jheri_curl", mesh, 400, 77)


@pytest.mark.parametrize("coder", ["network", "linear", "euclidean"])
def test_every_coder_fills_the_scalp(dressed, coder):
    head, guides = dressed
    settings = Settings().changed({"interpolation.coder": coder, "interpolation.similarity": 0.5}).interpolation
    dense = fill_scalp(guides, head, 700, settings, seed=5)
    strands = dense.strands
    assert len(strands) == 700 and dense.tally["new strands"] == 300
    np.testing.assert_array_equal(strands.select(np.arange(400)).points, guides.points)
    new = strands.select(np.arange(400, 700))
    assert np.isfinite(new.points).all()
    assert head.closest_scalp(new.roots).distance.max() < 0.01
    assert (head.signed_distance(new.points) < -0.05).mean() < 1e-3
    # as long as the guides, give or take what a blend costs
    assert np.median(new.lengths()) == pytest.approx(np.median(guides.lengths()), rel=0.12)


def test_the_learned_fill_is_the_same_bit_for_bit_on_any_threads(dressed):
    head, guides = dressed
    first = fill_scalp(guides, head, 700, seed=5).strands
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        again = fill_scalp(guides, head, 700, seed=5).strands
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(first.points, again.points)
