"""Refinement on phantoms: displaced strands and helices find back to the volume, and nothing else of them changes."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.errors import Cancelled
from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.refinement import refine, scan_agreement
from ct2hair_addon.settings import RefinementSettings
from ct2hair_addon.strands import Strands

SPACING, BLUR = 0.6, 0.85
LEVEL = 0.35 * strand_peak(BLUR)


def on_the_ball(count: int, seed: int):
    """Unit directions over the ball's upper half, far apart."""
    d = np.random.default_rng(seed).normal(size=(4000, 3))
    d[:, 2] = np.abs(d[:, 2]) + 0.2
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    kept = [0]
    for n in range(1, len(d)):
        if (d[kept] @ d[n]).max() < 0.93 and len(kept) < count:
            kept.append(n)
    return d[kept]


def across(d):
    """Two unit directions across d."""
    u = np.cross(d, [0.3, 0.9, -0.3])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(d, u)


def straight(seed=0, count=12):
    d = on_the_ball(count, seed)
    return (d[:, None] * np.linspace(40, 85, 60)[None, :, None]).astype(np.float32), d


def curly(seed=0, count=12, radius=4.0, pitch=14.0):
    d = on_the_ball(count, seed)
    u, v = across(d)
    s = np.linspace(0, 45.0, 150)
    turn, wide = 2 * np.pi * s / pitch, radius * np.minimum(s / 8.0, 1.0)
    along = d[:, None] * (40 + s)[None, :, None]
    return (
        along + u[:, None] * (wide * np.cos(turn))[None, :, None] + v[:, None] * (wide * np.sin(turn))[None, :, None]
    ).astype(np.float32), d


def displaced(points, d, by, seed=1):
    """Moved aside by `by` mm (each its own way), roots held, the move growing over the first 15 mm."""
    u, v = across(d)
    a = np.random.default_rng(seed).uniform(0, 2 * np.pi, (len(d), 1))
    aside = np.cos(a) * u + np.sin(a) * v
    reach = np.linalg.norm(points - points[:, :1], axis=2, keepdims=True)
    return (points + by * np.minimum(reach / 15.0, 1.0) * aside[:, None]).astype(np.float32)


KINDS = {"straight": (straight, 1.2), "curly": (curly, 0.9)}


@pytest.fixture(scope="module")
def fitted(head, profile):
    """Each kind of phantom: (truth, what was given, the result, the scan)."""
    made = {}
    for kind, (make, by) in KINDS.items():
        points, d = make()
        truth, given = Strands.from_array(points), Strands.from_array(displaced(points, d, by), root_uv=np.zeros((len(d), 2)))
        density = render_density(truth, SPACING, BLUR)
        made[kind] = truth, given, refine(given, density, LEVEL, head, profile=profile), density
    return made


def off(strands, truth):
    """(M,) mm from points along the strands (not the first 3 mm) to the true ones."""
    fine = strands.resampled_by_step(0.5)
    free = np.linalg.norm(fine.points - fine.roots[fine.strand_index], axis=1) > 3.0
    return cKDTree(truth.resampled_by_step(0.1).points).query(fine.points[free])[0]


@pytest.mark.parametrize("kind", KINDS)
def test_displaced_strands_find_back_to_the_volume(kind, fitted):
    truth, given, result, _ = fitted[kind]
    before, after = off(given, truth), off(result.strands, truth)
    assert np.median(before) > 0.5
    assert np.median(after) < 0.1 and np.quantile(after, 0.9) < 0.3
    # strand by strand, not onto a neighbour
    apart = np.linalg.norm(result.strands.resampled(30) - truth.resampled(30), axis=2)
    assert np.median(apart) < 0.25 and apart.max() < 2.0


@pytest.mark.parametrize(("kind", "stretch"), [("straight", 5e-4), ("curly", 0.02)])
def test_lengths_are_kept_and_roots_held(kind, stretch, fitted):
    _, given, result, _ = fitted[kind]
    np.testing.assert_array_equal(result.strands.roots, given.roots)
    assert np.abs(result.strands.lengths() / given.lengths() - 1.0).max() < stretch
    np.testing.assert_array_equal(result.strands.strand_attributes["root_uv"], given.strand_attributes["root_uv"])


def test_curls_keep_their_radius(fitted):
    _, d = curly()
    result = fitted["curly"][2].strands
    for line, direction in zip(result.resampled(200), d, strict=True):
        free = line[60:-10]
        radius = np.linalg.norm(free - (free @ direction)[:, None] * direction, axis=1)
        assert radius.mean() == pytest.approx(4.0, abs=0.25)


@pytest.mark.parametrize("kind", KINDS)
def test_support_and_scores_say_that_the_scan_backs_them_now(kind, fitted):
    _, given, result, _ = fitted[kind]
    support = result.strands.strand_attributes["support"]
    assert support.min() > 0.85 and support.max() <= 1.0
    assert result.strands.point_attributes["support"].shape == (len(result.strands.points),)
    for voxel in result.scores["after"]:
        before, after = result.scores["before"][voxel], result.scores["after"][voxel]
        assert after["iou"] > before["iou"] + 0.1 and after["iou"] > 0.8
    finest = [value for name, value in result.tally.items() if name.startswith("misfit after, 0.60")]
    assert finest and finest[0] < 100
    assert result.tally["strands"] == len(given)


def test_nothing_is_left_inside_the_head(head, profile):
    """Strands that lie on the ball, given half a millimetre inside it."""
    d = on_the_ball(12, 3)
    u, _ = across(d)
    a = np.linspace(0, 0.8, 40)[None, :, None]
    way = d[:, None] * np.cos(a) + u[:, None] * np.sin(a)
    truth, given = (Strands.from_array((way * radius).astype(np.float32)) for radius in (40.5, 39.5))
    given = given.with_points(
        np.where(np.arange(len(given.points))[:, None] % 40 == 0, given.points * (40 / 39.5), given.points)
    )
    result = refine(given, render_density(truth, SPACING, BLUR), LEVEL, head, profile=profile).strands
    inner = np.ones(len(result.points), bool)
    inner[result.offsets[:-1]] = False
    assert head.signed_distance(result.points[inner]).min() > 0.0
    assert result.tips is not None and np.median(off(result, truth)) < 0.25


def test_the_same_input_gives_the_same_bits_on_any_number_of_threads(fitted, head, profile):
    _, given, result, density = fitted["straight"]
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        again = refine(given, density, LEVEL, head, profile=profile)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(again.strands.points, result.strands.points)
    assert again.scores == result.scores


def test_without_iterations_strands_stay_but_for_their_points(fitted, head, profile):
    _, given, _, density = fitted["straight"]
    result = refine(given, density, LEVEL, head, RefinementSettings(iterations=0), profile=profile)
    assert np.median(off(result.strands, given)) < 0.05
    assert result.scores["before"] == result.scores["after"]


def test_strands_that_are_worked_on_are_fitted_alike_but_not_judged(fitted, head, profile):
    _, given, result, density = fitted["straight"]
    found = refine(given, density, LEVEL, head, profile=profile, final=False)
    np.testing.assert_array_equal(found.strands.tips, result.strands.tips)
    np.testing.assert_array_equal(found.strands.roots, result.strands.roots)
    assert {name: result.tally[name] for name in found.tally} == found.tally
    lines = found.strands.resampled_by_step(0.02)
    distance, nearest = cKDTree(lines.points).query(result.strands.points)
    assert distance.max() < 0.03
    np.testing.assert_array_equal(lines.strand_index[nearest], result.strands.strand_index)
    assert found.scores == {} and not any("after fitting" in name for name in found.tally)
    assert result.scores and any("after fitting" in name for name in result.tally)


def test_bad_strands_are_dropped_and_counted_and_an_empty_scan_moves_nothing(fitted, head, profile):
    _, given, _, density = fitted["straight"]
    points = given.points.copy()
    points[65] = np.nan
    result = refine(given.with_points(points), density, LEVEL, head, RefinementSettings(iterations=2), profile=profile)
    assert len(result.strands) == len(given) - 1
    assert result.tally["dropped: not finite or fewer than two points"] == 1
    nothing = replace(density, table=np.full_like(density.table, -1), bricks=density.bricks[:0])
    untouched = refine(given, nothing, LEVEL, head)
    np.testing.assert_array_equal(untouched.strands.points, given.points)
    assert not untouched.strands.strand_attributes["support"].any() and untouched.scores == {}


def test_it_can_be_cancelled(fitted, head, profile):
    _, given, _, density = fitted["straight"]

    def stop(done, total):
        if done / total > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        refine(given, density, LEVEL, head, progress=stop, profile=profile)


def test_strands_agree_with_their_own_rendering(fitted, profile):
    truth, given, _, density = fitted["curly"]
    for score in scan_agreement(truth, density, profile).values():
        assert score["iou"] > 0.85 and score["precision"] > 0.93 and score["recall"] > 0.9
    for score in scan_agreement(given, density, profile).values():
        assert score["iou"] < 0.7
    # hidden parts count on neither side of precision
    none = scan_agreement(truth, density, profile, np.zeros(len(truth.points)))
    assert all(score["recall"] == 0.0 for score in none.values())
