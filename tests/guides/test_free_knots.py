"""Hair that streams over other hair's roots: what has no knot is led back to one that is left, over the way that it came."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.guides.free_knots import AS_FAR, LEAVING, lead_to_free_knots, usually_followed
from ct2hair_addon.guides.growing import WALK_STEP, follow_to_scalp, walked_back
from ct2hair_addon.guides.roots import lead_into_scalp
from ct2hair_addon.head import Head
from ct2hair_addon.strands import Strands

RADIUS = 80.0
APART = 0.02
"""Radians of azimuth between two hairs."""


@pytest.fixture(scope="module")
def ball(make_ball) -> Head:
    return Head(make_ball(RADIUS, rings=90, sides=180))


def place(azimuth, s, height):
    """Where a meridian is `s` mm from near the ball's top, `height` mm over it."""
    polar, radius = 0.4 + np.asarray(s) / RADIUS, RADIUS + np.asarray(height)
    outwards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.asarray(radius)[..., None] * (np.sin(polar)[..., None] * outwards + np.cos(polar)[..., None] * [0, 0, 1.0])


def lying(azimuth: float, start: float, end: float) -> np.ndarray:
    s = np.arange(start, end, WALK_STEP)
    return place(azimuth, s, 1.0 + 0.05 * s)


@pytest.fixture(scope="module")
def stream(ball):
    """(strands, made, rest, knots): twelve that come from the top, five between them that begin in the stream, and their knots
    12 to 20 mm before; of the latter the first two were followed back a while."""
    whole = [lying(APART * n, 0.0, 70.0) for n in range(12)]
    late = [APART * (n + 0.5) for n in (1, 3, 5, 7, 9)]
    knots = np.array([ball.closest_scalp(place(a, [14.0 + 2 * n], 0.0)).position[0] for n, a in enumerate(late)], float)
    strands = Strands.from_polylines([*whole, *(lying(a, 20.0 if n < 2 else 32.0, 70.0) for n, a in enumerate(late))])
    made = np.array([30] * 12 + [24] * 2 + [0] * 3)
    return strands, made, np.arange(12, 17), knots


def test_each_finds_the_knot_that_it_passed(ball, stream):
    strands, made, rest, knots = stream
    led, roots, tied = lead_to_free_knots(strands, made, rest, knots, ball)
    assert np.flatnonzero(tied).tolist() == rest.tolist()
    np.testing.assert_allclose(roots[rest], knots)
    np.testing.assert_array_equal(led.tips, strands.tips)
    for n, line in enumerate(led.polylines()):
        old = strands.polylines()[n]
        if n < 12:
            np.testing.assert_array_equal(line, old)
            continue
        np.testing.assert_array_equal(line[-60:], old[-60:])  # what was traced stays
        height = ball.signed_distance(line)
        assert height[0] < 1.6 and height.min() > 0.5 and np.diff(height).min() > -0.1, "rises from the scalp to its trace"
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 1.6
        assert np.linalg.norm(line[0] - knots[n - 12]) < 6.0


def test_a_knot_is_given_once_and_the_nearest_way_wins(ball, stream):
    strands, made, rest, knots = stream
    led, roots, tied = lead_to_free_knots(strands, made, rest, knots[[3]], ball)
    assert np.flatnonzero(tied).tolist() == [15]
    np.testing.assert_allclose(roots[15], knots[3])
    others = np.arange(len(strands)) != 15
    for line, old in zip(led.select(others).polylines(), strands.select(others).polylines(), strict=True):
        np.testing.assert_array_equal(line, old)


def test_where_hair_stands_up_no_knot_is_looked_for_far_back(ball, stream):
    strands, made, rest, knots = stream
    short = np.minimum(made, 1)
    assert AS_FAR * WALK_STEP < LEAVING
    led, _, tied = lead_to_free_knots(strands, short, rest, knots, ball)
    assert not tied.any()
    np.testing.assert_array_equal(led.points, strands.points)
    led, _, tied = lead_to_free_knots(strands, made, rest[:0], knots, ball)
    assert not tied.any() and led is strands


def test_what_the_wig_usually_shows_stands_for_what_is_followed_again(ball, stream):
    strands, made, rest, knots = stream
    usual = usually_followed(strands, made)
    assert 10.0 < usual < 16.0 and usually_followed(strands, 0 * made) == 0.0
    _, _, tied = lead_to_free_knots(strands, np.minimum(made, 1), rest, knots, ball, usual=usual)
    assert tied[rest].all()
    _, _, tied = lead_to_free_knots(strands, made, rest, knots, ball, usual=0.0)
    assert not tied.any()


def test_none_is_led_through_the_air_over_the_hair_that_it_passed(ball):
    """Hair lies low, then lifts off the scalp, as before a tail's tie: a strand seen from there on came along under it."""

    def lifting(azimuth: float, start: float) -> np.ndarray:
        s = np.arange(start, 90.0, WALK_STEP)
        return place(azimuth, s, 1.0 + 0.02 * s + 0.04 * np.maximum(s - 55.0, 0.0) ** 2)

    late = APART * 5.5
    knot = np.array(ball.closest_scalp(place(late, [15.0], 0.0)).position, float)
    strands = Strands.from_polylines([*(lifting(APART * n, 0.0) for n in range(12)), lifting(late, 72.0)])
    led, _, tied = lead_to_free_knots(strands, np.zeros(13, int), np.array([12]), knot, ball, usual=30.0)
    assert tied[12]
    line, hair = led.polylines()[12], np.concatenate(strands.polylines()[:12])
    passed = ball.signed_distance(line[: -strands.counts[12]])
    beside = ball.signed_distance(hair)[cKDTree(hair).query(line[: -strands.counts[12]])[1]]
    assert passed.max() > 5.0 and (passed < beside + 0.7).all()


def test_a_way_back_is_no_longer_than_asked_and_otherwise_the_same(ball, stream):
    strands, _, rest, _ = stream
    whole, taken, _ = walked_back(strands, rest, ball, 0.8, glide=True)
    path, fewer, _ = walked_back(strands, rest, ball, 0.8, glide=True, longest=8.0)
    assert taken.min() > 8.0 / WALK_STEP and fewer.tolist() == [round(8.0 / WALK_STEP)] * len(rest)
    np.testing.assert_array_equal(path, whole[: len(path)])


def test_strands_followed_past_their_knots_come_back_to_them(ball, stream):
    """As the guides do it: what begins in the stream is followed to where that begins, where the knots are others'."""
    strands, _, rest, knots = stream
    of_others = np.array([ball.closest_scalp(place(APART * n, [-8.0], 0.0)).position[0] for n in range(12)], float)
    seen = Strands.from_polylines([*strands.polylines()[:12], *(lying(APART * (n + 0.5), 44.0, 70.0) for n in (1, 3, 5, 7, 9))])
    bodies, low, _ = follow_to_scalp(seen, ball, 1.4)
    assert low.all()
    made = bodies.counts - seen.counts
    rooted, tied, late = lead_into_scalp(bodies, ball, np.concatenate([of_others, knots]), made)
    assert late == len(rest) and tied >= len(rest)
    np.testing.assert_allclose(rooted.roots[rest], knots, atol=0.05)
    assert ball.signed_distance(rooted.points).min() > -0.2


def test_a_knot_far_below_a_way_is_none_that_it_passed(ball):
    """Hair streams high over the head: a knot below it is 30 mm from where the strand is seen, however short its way there."""

    def high(azimuth: float, start: float) -> np.ndarray:
        s = np.arange(start, 70.0, WALK_STEP)
        return place(azimuth, s, 30.0 + 0.0 * s)

    late = APART * 5.5
    strands = Strands.from_polylines([*(high(APART * n, 0.0) for n in range(12)), high(late, 30.0)])
    knot = np.array(ball.closest_scalp(place(late, [24.0], 0.0)).position, float)
    asked = strands, np.zeros(13, int), np.array([12]), knot, ball
    led, _, tied = lead_to_free_knots(*asked, usual=20.0 / AS_FAR)
    assert not tied.any()
    np.testing.assert_array_equal(led.points, strands.points)
    assert lead_to_free_knots(*asked, usual=40.0 / AS_FAR)[2][12]


def test_hair_that_passes_beside_the_scalp_makes_no_jump_to_its_edge(make_ball):
    """A way from the scalp's rim down beside it: what is laid anew stays by it, though the closest scalp is but its edge."""
    bald_below = Head(make_ball(RADIUS, scalp_over=RADIUS * np.cos(0.4 + 12.0 / RADIUS), rings=90, sides=180))
    late = APART * 5.5
    strands = Strands.from_polylines([*(lying(APART * n, 0.0, 90.0) for n in range(12)), lying(late, 60.0, 90.0)])
    knot = np.array(bald_below.closest_scalp(place(late, [8.0], 0.0)).position, float)
    led, _, tied = lead_to_free_knots(strands, np.zeros(13, int), np.array([12]), knot, bald_below, usual=80.0 / AS_FAR)
    assert tied[12]
    line = led.polylines()[12]
    assert len(line) > strands.counts[12] + 40
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 1.6
    assert np.linalg.norm(line[0] - knot[0]) < 6.0
    assert bald_below.signed_distance(line).min() > 0.4


def test_where_hair_is_hidden_for_long_a_knot_may_lie_farther_beside_the_way(ball):
    """Strands that make room for each other: of two whose ways pass one knot, one goes to the next, 8 mm aside."""
    late = APART * 5.5
    strands = Strands.from_polylines([*(lying(APART * n, 0.0, 70.0) for n in range(12)), lying(late, 40.0, 70.0)])
    polar = 0.4 + 15.0 / RADIUS
    aside = late + 8.0 / (RADIUS * np.sin(polar))
    knot = np.array(ball.closest_scalp(place(aside, [15.0], 0.0)).position, float)
    asked = strands, np.zeros(13, int), np.array([12]), knot, ball
    assert not lead_to_free_knots(*asked, usual=40.0 / AS_FAR)[2][12]
    led, roots, tied = lead_to_free_knots(*asked, usual=100.0 / AS_FAR)
    assert tied[12]
    np.testing.assert_allclose(roots[12], knot[0])
    line = led.polylines()[12]
    assert np.linalg.norm(line[0] - knot[0]) < 6.0 and np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 1.6
