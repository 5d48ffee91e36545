"""Roots led to the net's knots: each knot to one root, the usual miss learned, roots without a knot left about right."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.guides.knots import by_the_scalp, strands_by_knots, tie_to_knots
from ct2hair_addon.guides.roots import lead_into_scalp
from ct2hair_addon.head import Head
from ct2hair_addon.strands import Strands

BEHIND = 1.1
HIDDEN = 1.5


@pytest.fixture(scope="module")
def ball(make_ball) -> Head:
    return Head(make_ball(80.0, rings=90, sides=120))


@pytest.fixture(scope="module")
def tied_hair(ball):
    """(knots, where their hair was followed back to, its directions): 400 knots some 3 mm apart on the ball's scalp."""
    random = np.random.default_rng(5)
    radius = float(np.linalg.norm(ball.mesh.vertices[0]))
    count = 4 * int(2 * np.pi * radius**2 / 9.0)
    golden = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    height = 1.0 - (np.arange(count) + 0.5) / count * 0.5
    knots = radius * np.stack(
        [np.sqrt(1 - height**2) * np.cos(golden), np.sqrt(1 - height**2) * np.sin(golden), height], axis=1
    )
    knots = ball.closest_scalp(knots[random.permutation(count)[: count // 4]]).position.astype(float)
    normal = ball.closest_scalp(knots).normal.astype(float)
    along = np.cross(normal, [0.0, 1.0, 0.0])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normal, along)
    miss = random.normal(size=(len(knots), 2)) * [0.25, 0.15]
    found = knots - (BEHIND + miss[:, :1]) * along + miss[:, 1:] * across
    forward = 0.87 * along + 0.5 * normal
    return knots, ball.closest_scalp(found), forward


def test_roots_go_to_their_own_knots(ball, tied_hair):
    knots, found, forward = tied_hair
    roots, knot = tie_to_knots(found, forward, np.full(len(forward), HIDDEN), knots)
    tied = knot >= 0
    np.testing.assert_array_equal(roots[tied], knots[knot[tied]])
    assert tied.mean() > 0.98
    off = np.linalg.norm(roots - knots, axis=1)
    assert np.mean(off < 0.05) > 0.93, "most should find the knot that they were drawn from"
    assert len(np.unique(roots[tied].round(3), axis=0)) == tied.sum(), "a knot ties one strand"


def test_roots_without_a_knot_take_what_the_others_missed(ball, tied_hair):
    knots, found, forward = tied_hair
    seen = np.random.default_rng(1).permutation(len(knots))[: int(0.6 * len(knots))]
    roots, knot = tie_to_knots(found, forward, np.full(len(forward), HIDDEN), knots[seen])
    alone = knot < 0
    assert 0.2 < alone.mean() < 0.5
    before, after = (np.median(np.linalg.norm(some[alone] - knots[alone], axis=1)) for some in (found.position, roots))
    assert after < 0.6 * before


def test_hair_that_is_hidden_for_long_may_come_from_farther_back(ball, tied_hair):
    knots, found, forward = tied_hair
    normal = found.normal.astype(float)
    along = forward - normal * (forward * normal).sum(axis=1, keepdims=True)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    few = np.arange(0, len(knots), 25)  # far from one another
    far = ball.closest_scalp(knots[few] - 7.0 * along[few])
    roots, knot = tie_to_knots(far, forward[few], np.full(len(few), 12.0), knots[few])
    tied = knot >= 0
    assert tied.mean() > 0.9
    np.testing.assert_allclose(roots[tied], knots[few][tied])
    roots, knot = tie_to_knots(far, forward[few], np.full(len(few), HIDDEN), knots[few])
    assert np.mean(np.linalg.norm(roots - knots[few], axis=1) < 0.05) < 0.1


@pytest.mark.parametrize("knots", [np.zeros((0, 3)), np.full((5, 3), 400.0)])
def test_without_knots_by_the_scalp_nothing_moves(knots, ball, tied_hair):
    _, found, forward = tied_hair
    knots = by_the_scalp(knots, ball)
    assert not len(knots)
    roots, knot = tie_to_knots(found, forward, np.full(len(forward), HIDDEN), knots)
    np.testing.assert_array_equal(roots, found.position)
    assert (knot < 0).all()


def test_knots_tell_how_many_strands_there_are_and_where_they_can_not(ball, tied_hair):
    knots = tied_hair[0]
    off = ball.closest_scalp(knots).normal * 5.0
    apart = np.linalg.norm(knots[:, None] - knots[None] + 1e9 * np.eye(len(knots))[:, :, None], axis=2).min(axis=1)
    for spacing, merged in ((np.quantile(apart, 0.05) / 4.4, False), (np.quantile(apart, 0.05) / 3.6, True)):
        assert strands_by_knots(np.concatenate([knots, knots + off]), ball, spacing) == (len(knots), merged)
    assert strands_by_knots(None, ball, 0.4) == strands_by_knots(knots[:20], ball, 0.4) == (0, True)


def test_the_lead_starts_at_the_knot(ball, tied_hair):
    knots, _, forward = tied_hair
    knot, way = knots[:1], forward[:1]
    line = knot + 1.2 * ball.closest_scalp(knot).normal + np.linspace(0.0, 40.0, 40)[:, None] * way
    led, tied, late = lead_into_scalp(Strands.from_polylines([line]), ball, knot)
    assert (tied, late) == (1, 0)
    np.testing.assert_allclose(led.roots, knot, atol=0.02)
