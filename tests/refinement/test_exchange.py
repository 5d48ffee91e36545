"""Tips exchanged, or taken over, where strands went over to each other's course."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from ct2hair_addon.refinement.curves import even_lines
from ct2hair_addon.refinement.exchange import exchange_tips

VOXEL = 0.4
ALONG = np.arange(0.0, 42.0, 2.0)


def strands(*paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate(paths), np.cumsum([0, *map(len, paths)])


def straight(slope: float, place: float = 0.0) -> np.ndarray:
    """A line along x that is at `place` in the middle."""
    return np.stack([ALONG, place + slope * (ALONG - 20.0), np.zeros_like(ALONG)], axis=1)


def exchanged(points, offsets, may=None):
    may = np.ones(len(offsets) - 1, bool) if may is None else np.array(may)
    return exchange_tips(points, offsets, VOXEL, may, int(np.diff(offsets).max(initial=2)))


def bounced(slope: float = 0.1, round_off: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """Two lines that cross at 20 mm, traced as if they kept to their sides: each is bent to go on along the other."""
    away = slope * np.sqrt((ALONG - 20.0) ** 2 + round_off**2)
    flat = np.zeros_like(ALONG)
    return strands(np.stack([ALONG, away, flat], axis=1), np.stack([ALONG, -away, flat], axis=1))


def test_strands_that_bounce_off_each_other_are_made_to_cross():
    points, offsets = bounced()
    moved, ends, made = exchanged(points, offsets)
    assert made == 1
    np.testing.assert_allclose(moved[ends[:-1]], points[offsets[:-1]], atol=1e-4)
    np.testing.assert_allclose(moved[ends[1:] - 1], points[offsets[1:] - 1][::-1], atol=1e-4)
    for n, slope in enumerate((-0.1, 0.1)):
        path = moved[ends[n] : ends[n + 1]]
        np.testing.assert_allclose(path[:, 1], slope * (path[:, 0] - 20.0), atol=0.12)


def test_strands_that_cross_run_beside_each_other_or_curl_together_stay():
    curl = np.stack([ALONG, 4.0 * np.cos(ALONG / 4.0), 4.0 * np.sin(ALONG / 4.0)], axis=1)
    lower = curl - [0.0, 0.6, 0.0]
    for points, offsets in (
        strands(straight(0.1), straight(-0.1)),
        strands(straight(0.0), straight(0.0, 0.5)),
        strands(curl, lower),
    ):
        moved, ends, made = exchanged(points, offsets)
        assert made == 0
        np.testing.assert_array_equal(ends, offsets)
        np.testing.assert_allclose(moved, points, atol=0.02)


def test_one_that_hops_through_three_lanes_comes_back_to_its_own():
    step = 1.0 / (1.0 + np.exp(-(ALONG - 20.0)))  # 0 before, 1 behind, over some 5 mm
    lanes = [0.0, 0.6, 1.2]
    turned = [0.6 * step, 0.6 + 0.6 * step, 1.2 - 1.2 * step]
    points, offsets = strands(*(np.stack([ALONG, y, np.zeros_like(ALONG)], axis=1) for y in turned))
    moved, ends, made = exchanged(points, offsets)
    assert made == 2
    for n, lane in enumerate(lanes):
        assert moved[ends[n], 1] == pytest.approx(lane, abs=1e-3)
        assert moved[ends[n + 1] - 1, 1] == pytest.approx(lane, abs=1e-3)
        assert np.abs(moved[ends[n] : ends[n + 1], 1] - lane).max() < 0.15


def came_over(slope: float = 0.4) -> np.ndarray:
    """From a lane aside onto y = 0 at 20 mm, and on along it."""
    return np.stack([ALONG, slope * 0.5 * (20.0 - ALONG + np.hypot(ALONG - 20.0, 1.5)), np.zeros_like(ALONG)], axis=1)


def test_one_that_ends_where_another_comes_over_into_its_lane_takes_that_ones_tip_over():
    whole, ended = straight(0.0), straight(0.0)[:11]
    for order in (1, -1):
        points, offsets = strands(*(ended, came_over())[::order])
        moved, ends, made = exchanged(points, offsets)
        assert made == 1
        mine, others = (moved[ends[n] : ends[n + 1]] for n in (0, 1)[::order])
        np.testing.assert_allclose(mine[[0, -1]], whole[[0, -1]], atol=0.05)
        assert np.abs(mine[:, 1]).max() < 0.1
        assert others[-1, 0] == pytest.approx(20.0, abs=0.5)
        np.testing.assert_allclose(others[0], came_over()[0], atol=1e-4)


def test_one_that_ends_beside_others_that_go_on_as_they_came_keeps_its_end():
    ended = straight(0.05)[:11]
    for other in (straight(0.0, 0.3), straight(-0.1, 0.2), came_over() + [0.0, 0.0, 1.2]):
        points, offsets = strands(ended, other)
        moved, ends, made = exchanged(points, offsets)
        assert made == 0
        np.testing.assert_allclose(moved[ends[1:] - 1], points[offsets[1:] - 1], atol=1e-3)


def test_strands_that_may_not_and_those_of_other_ways_keep_their_tips():
    points, offsets = bounced()
    for may in ([False, False], [True, False]):
        moved, _, made = exchanged(points, offsets, may)
        assert made == 0
        np.testing.assert_allclose(moved, points, atol=0.02)
    assert exchanged(*strands(straight(0.0)[:11], came_over()), [True, False])[2] == 0
    back = strands(points[offsets[0] : offsets[1]], points[offsets[1] : offsets[2]][::-1])
    assert exchanged(*back)[2] == 0


def test_short_strands_and_none_are_left_as_they_are():
    points, offsets = strands(straight(0.1)[:2], straight(-0.1)[:3])
    moved, ends, made = exchanged(points, offsets)
    assert made == 0
    assert len(ends) == 3
    np.testing.assert_allclose(moved[ends[1:] - 1], points[offsets[1:] - 1], atol=1e-4)
    empty, ends, made = exchanged(np.zeros((0, 3)), np.zeros(1, np.int64))
    assert (len(empty), len(ends), made) == (0, 1, 0)


def test_any_number_of_threads_gives_the_same_bits():
    rng = np.random.default_rng(3)
    paths = [
        bounced(slope, 1.0)[0] + [0.0, 0.0, z] for slope, z in zip(rng.uniform(0.1, 0.2, 40), 3.0 * np.arange(40), strict=True)
    ]
    points, offsets = strands(*(half for path in paths for half in np.split(path, 2)))
    known = numba.get_num_threads()
    results = []
    try:
        for threads in {1, known}:
            numba.set_num_threads(threads)
            results.append(exchanged(points, offsets))
    finally:
        numba.set_num_threads(known)
    assert results[0][2] >= 35
    for moved, ends, _ in results[1:]:
        np.testing.assert_array_equal(moved, results[0][0])
        np.testing.assert_array_equal(ends, results[0][1])


def test_even_lines_lie_on_the_cubics_a_step_apart():
    turn = np.linspace(0.0, np.pi, 12)
    points, offsets = strands(np.stack([10.0 * np.cos(turn), 10.0 * np.sin(turn), turn], axis=1), straight(0.0)[:2])
    lines, starts = even_lines(points, offsets, 0.4)
    assert len(starts) == 3
    np.testing.assert_allclose(lines[starts[:-1]], points[offsets[:-1]])
    np.testing.assert_allclose(lines[starts[1:] - 1], points[offsets[1:] - 1])
    arc = lines[: starts[1]]
    inner = arc[8:-8]  # end segments are flatter
    np.testing.assert_allclose(np.hypot(inner[:, 0], inner[:, 1]), 10.0, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(np.diff(arc, axis=0), axis=1), 0.4, rtol=0.1)
