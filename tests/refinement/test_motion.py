"""How strands give way: the band solver, smooth steps, kept lengths, planes of the head; curves to control points and back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.refinement.boundary import LEAVES, MARGIN, STANDS, Boundary
from ct2hair_addon.refinement.curves import _evaluate_cubics, control_points, local_curvature, polylines, segment_lengths
from ct2hair_addon.refinement.fit import SMOOTH_TURN, pyramid, shares
from ct2hair_addon.refinement.motion import keep_lengths, smooth_step, solve_bands
from ct2hair_addon.refinement.splat import render
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume


@pytest.mark.parametrize("size", [1, 2, 3, 12])
def test_the_bands_are_solved_as_the_whole_matrix(size):
    rng = np.random.default_rng(0)
    near = np.abs(np.subtract.outer(range(size), range(size))) < 4
    factor = np.tril(rng.normal(size=(size, size)) * 0.3, 0) * near + np.eye(size)
    whole, right = factor @ factor.T, rng.normal(size=(size, 3))
    band = np.array([[whole[i, i + k] if i + k < size else 0.0 for k in range(4)] for i in range(size)])
    found = right.copy()
    solve_bands(band, found)
    np.testing.assert_allclose(found, np.linalg.solve(whole, right), atol=1e-9)


def line(size=20, step=2.0):
    points = np.zeros((size, 3))
    points[:, 2] = step * np.arange(size)
    return points, np.array([0, size])


def stepped(forces, weights=None, stiffness=3.0, limit=100.0, points=None, friction=0.0):
    rest, offsets = line()
    points = rest.copy() if points is None else points
    velocity = np.zeros_like(points)
    weights = np.ones(len(points)) if weights is None else weights
    firm = np.full(len(points), float(stiffness))
    smooth_step(points, rest, offsets, forces, weights, firm, 1.0, friction, limit, velocity)
    return points, rest


def test_without_a_force_nothing_moves_and_a_bend_from_rest_relaxes():
    points, rest = stepped(np.zeros((20, 3)))
    np.testing.assert_array_equal(points, rest)
    bent = rest.copy()
    bent[10, 0] = 1.0
    relaxed, _ = stepped(np.zeros((20, 3)), points=bent.copy())
    assert 0 < relaxed[10, 0] < 0.6


def test_a_common_force_moves_all_but_the_root_and_a_single_one_is_spread():
    force = np.zeros((20, 3))
    force[:, 0] = 1.0
    points, _ = stepped(force, stiffness=1.0)
    assert not points[0].any()
    np.testing.assert_allclose(points[8:, 0], 1.0, atol=0.1)
    force[:] = 0.0
    force[10, 0] = 1.0
    loose, _ = stepped(force, stiffness=0.5)
    stiff, _ = stepped(force, stiffness=8.0)
    assert loose[10, 0] > 0.9 and abs(loose[13, 0]) < 0.01
    assert stiff[10, 0] < 0.3 and stiff[13, 0] > 0.5 * stiff[10, 0]


def test_points_without_weight_follow_their_neighbours_and_no_step_is_longer_than_the_limit():
    force = np.zeros((20, 3))
    force[:, 1] = 1.0
    weights = np.ones(20)
    weights[8:12] = 0.0
    points, _ = stepped(force, weights)
    assert points[8:12, 1].min() > 0.7
    points, rest = stepped(50.0 * force, limit=0.5)
    assert np.linalg.norm(points - rest, axis=1).max() == pytest.approx(0.5)


def test_lengths_are_pulled_back_with_the_root_held():
    generator = np.random.default_rng(1)
    rest, offsets = line()
    lengths = segment_lengths(rest, offsets)
    assert lengths.tolist() == [2.0] * 19 + [0.0]
    points = rest + generator.normal(0, 0.15, rest.shape)
    points[0] = rest[0]
    free = points.copy()
    keep_lengths(free, offsets, np.array([False]), lengths, 60)
    np.testing.assert_array_equal(free, points)
    keep_lengths(points, offsets, np.array([True]), lengths, 60)
    np.testing.assert_array_equal(points[0], rest[0])
    np.testing.assert_allclose(segment_lengths(points, offsets)[:-1], 2.0, rtol=5e-3)


def test_points_are_pushed_off_the_head_but_roots(head):
    generator = np.random.default_rng(2)
    inside = generator.normal(size=(40, 3))
    inside *= (37.0 + generator.uniform(0, 6.0, (40, 1))) / np.linalg.norm(inside, axis=1, keepdims=True)
    offsets = np.arange(0, 41, 4)
    boundary = Boundary(head, 0.0, 0.6)
    assert (boundary.look(inside) == 1.0).all()
    pushed = inside.copy()
    boundary.push(pushed, offsets)
    free = np.ones(40, bool)
    free[offsets[:-1]] = False
    np.testing.assert_array_equal(pushed[~free], inside[~free])
    assert head.signed_distance(pushed[free]).min() > MARGIN - 0.1
    far = head.signed_distance(inside) > MARGIN + 0.02
    np.testing.assert_allclose(pushed[far & free], inside[far & free], atol=1e-6)
    cleared, count = boundary.clear(inside, offsets)
    assert head.signed_distance(cleared[free]).min() > 0
    assert count == np.count_nonzero(head.signed_distance(inside[free]) < 0.5 * MARGIN)


def test_hair_rises_from_its_root_but_what_stands_and_what_lies_farther_on_stays(head):
    along = np.arange(0.0, 20.0, 1.0)
    lying = 40.1 * np.stack([np.sin(along / 40.1), 0.0 * along, np.cos(along / 40.1)], axis=1)
    lying[0] *= 40.0 / 40.1
    standing = np.array([0.0, 40.0, 0.0]) + along[:, None] * [0.2, 0.9, 0.0]
    points, offsets = np.concatenate([lying, standing, lying[:1]]), np.array([0, 20, 40, 41])
    raised = Boundary(head, 0.0, 0.6).raised(points, offsets)
    height = head.signed_distance(raised[:20])
    np.testing.assert_allclose(height[1:4], LEAVES * along[1:4], atol=0.05)
    np.testing.assert_allclose(height[4:9], STANDS, atol=0.05)
    kept = np.append(np.arange(12, 41), 0)
    np.testing.assert_array_equal(raised[kept], points[kept])
    assert Boundary(head, 0.0, 0.6).raised(points[:0], np.zeros(1, int)).shape == (0, 3)


def test_what_the_net_hides_fades_in_over_a_voxel(head):
    heights = np.array([0.0, 1.0, 1.7, 2.0, 2.15, 2.4, 5.0])
    points = (40.0 + heights)[:, None] * np.array([0.0, 0.0, 1.0])
    shown = Boundary(head, 2.0, 0.6).look(points)
    np.testing.assert_allclose(shown, np.clip((heights - 2.0) / 0.6 + 0.5, 0, 1), atol=0.1)


def helix(radius=4.0, pitch=12.0, turns=4):
    s = np.linspace(0, 2 * np.pi * turns, 400)
    return np.stack([radius * np.cos(s), radius * np.sin(s), pitch * s / (2 * np.pi)], axis=1)


def test_a_helix_survives_control_points_and_back():
    strands = Strands.from_polylines([helix().astype(np.float32), np.linspace([0, 0, 0], [0, 0, 80], 300, dtype=np.float32)])
    points, offsets = control_points(strands, 64)
    # more points where there are turns, and the ends stay
    counts = np.diff(offsets)
    assert 50 <= counts[0] <= 64 and counts[1] == 41
    np.testing.assert_allclose(points[offsets[:-1]], strands.roots, atol=1e-5)
    fine, fine_offsets = polylines(points, offsets)
    assert ((np.diff(fine_offsets) >= 16) & (np.diff(fine_offsets) <= 128)).all()
    back = fine[: fine_offsets[1]]
    off = np.abs(np.hypot(back[:, 0], back[:, 1]) - 4.0)
    assert off[6:-6].max() < 0.03 and off.max() < 0.2  # at the ends a neighbour is missing
    np.testing.assert_allclose(fine[fine_offsets[1:] - 1], strands.tips, atol=1e-4)
    few, few_offsets = control_points(strands, 8)
    assert np.diff(few_offsets).tolist() == [8, 8] and len(few) == 16


def test_points_lie_closer_where_hair_bends():
    """Bent by a right angle in the first 4 mm, then straight: a polyline of 16 points keeps to within a few hundredths."""
    bend = np.linspace(0.0, np.pi / 2, 40)
    arc = 2.5 * np.stack([1.0 - np.cos(bend), np.sin(bend), 0.0 * bend], axis=1)
    line = np.concatenate([arc, arc[-1] + np.linspace(1.0, 60.0, 60)[:, None] * [1.0, 0.0, 0.0]])
    points, offsets = control_points(Strands.from_polylines([line.astype(np.float32)]), 128)
    fine, fine_offsets = polylines(points, offsets)
    assert fine_offsets[1] == 16
    edges = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    assert edges[:4].max() < 0.35 * edges[-4:].max()
    assert (edges[1:] / edges[:-1]).max() < 2.5
    curve, _ = _evaluated(points, offsets, 2000)
    closest = cKDTree(Strands.from_polylines([fine]).resampled(4000)[0]).query(curve)[0]
    evenly, _ = _evaluated(points, offsets, 16)
    even = cKDTree(Strands.from_polylines([evenly]).resampled(4000)[0]).query(curve)[0]
    assert closest.max() < 0.15 and closest.max() < 0.4 * even.max()


def _evaluated(points, offsets, count):
    """`count` points of one strand's cubic, even in its parameter."""
    wanted, out = np.arange(len(points), dtype=float), np.empty((count, 3), np.float32)
    _evaluate_cubics(points, offsets, wanted, np.array([0, count]), out)
    return out, np.array([0, count])


def test_the_pyramid_is_coarsest_first_and_each_level_a_rendering_of_its_own_blur():
    values = BrickVolume.from_dense(np.ones((64, 64, 64), np.float32), 0.4, (1.0, 2.0, 3.0))
    points = np.linspace([8.0, 20.0, 30.0], [56.0, 44.0, 34.0], 12)
    offsets, visible = np.array([0, 12]), np.ones(12)
    bricks = np.maximum(render(points, offsets, visible, values, 0.85), np.float32(1e-30))  # air, not cleared
    density = BrickVolume(values.table, bricks, 0.4, values.origin)
    levels = pyramid(density, 0.85, 4.0)
    assert [level.scan.spacing for level in levels] == pytest.approx([1.6, 0.8, 0.4])
    assert levels[-1].scan is density and levels[-1].blur == 0.85
    for level in levels[:-1]:
        here = level.scan.to_voxel(density.to_scan(points))
        gain = (0.4 / level.scan.spacing) ** 2  # the same line mass over a larger voxel
        expected = gain * render(here, offsets, visible, level.scan, level.blur)
        assert np.abs(level.scan.bricks - expected).max() < 0.08 * expected.max()
        assert level.scan.bricks.sum() == pytest.approx(expected.sum(), rel=0.01)


@pytest.mark.parametrize(("iterations", "levels"), [(60, 1), (60, 3), (7, 3), (0, 3), (1, 4)])
def test_the_iterations_are_shared_out_whole(iterations, levels):
    found = shares(iterations, levels)
    assert len(found) == levels and sum(found) == iterations and min(found) >= 0
    assert found[-1] >= iterations // 2


def test_a_strand_gives_way_where_it_is_soft():
    """A single force moves a soft stretch alone, a stiff one with its neighbours."""
    rest, offsets = line(40)
    firm = np.where(np.arange(40) < 20, 1.0, 12.0)
    force = np.zeros((40, 3))
    moves = []
    for at in (10, 30):
        points = rest.copy()
        force[:] = 0.0
        force[at, 0] = 0.5
        smooth_step(points, rest, offsets, force, np.ones(40), firm, 1.0, 0.0, 100.0, np.zeros((40, 3)))
        moved = points[:, 0] - rest[:, 0]
        moves.append((moved[at], np.abs(moved[max(at - 5, 0) : at + 6]).sum() / moved[at]))
    assert moves[0][0] > 2.0 * moves[1][0]
    assert moves[0][1] < 0.7 * moves[1][1]


def smoothed(points, smooth, offsets=None):
    """Where points without a shape of their own end, each drawn to where it was."""
    at, offsets = np.array(points, float), np.array([0, len(points)]) if offsets is None else offsets
    for _ in range(60):
        force = points - at
        smooth_step(
            at, np.zeros_like(at), offsets, force, np.ones(len(at)), np.full(len(at), smooth), 1.0, 0.0, 1.0, np.zeros_like(at)
        )
    return at


def test_noise_of_traced_hair_goes_and_its_bend_stays():
    t = np.arange(0.0, 120.0, 0.8) / 60.0
    arc = 60.0 * np.stack([np.cos(t), np.sin(t), 0.0 * t], axis=1)
    noisy = arc + np.random.default_rng(1).normal(size=arc.shape) * 0.08
    found = smoothed(noisy, 3.0)
    before, after = (np.sqrt(((some - arc)[12:-12] ** 2).sum(axis=1).mean()) for some in (noisy, found))
    assert after < 0.5 * before
    np.testing.assert_array_equal(found[0], noisy[0])
    np.testing.assert_allclose(smoothed(arc, 3.0), arc, atol=0.01)


def test_a_curl_smoothed_by_as_much_as_its_turn_allows_keeps_its_radius():
    s = np.arange(0.0, 100.0, 0.8)
    curl = np.stack([4.0 * np.cos(s / 4.0), 4.0 * np.sin(s / 4.0), 0.2 * s], axis=1)
    found = smoothed(curl, SMOOTH_TURN * 4.0)
    np.testing.assert_allclose(np.hypot(found[9:-9, 0], found[9:-9, 1]), 4.0, atol=0.01)


def test_each_strand_is_smoothed_by_itself_and_the_shortest_by_nothing():
    rng = np.random.default_rng(2)
    parts = [np.cumsum(rng.normal(size=(size, 3)), axis=0) for size in (40, 3, 25)]
    together = smoothed(np.concatenate(parts), 2.0, np.array([0, 40, 43, 68]))
    np.testing.assert_allclose(together, np.concatenate([smoothed(part, 2.0) for part in parts]), atol=1e-9)
    np.testing.assert_allclose(together[40:43], parts[1], atol=1e-6)


def test_curvature_is_local():
    bend = np.linspace(0.0, np.pi / 2, 20)
    arc = 5.0 * np.stack([1.0 - np.cos(bend), np.sin(bend), 0.0 * bend], axis=1)
    straight = arc[-1] + np.arange(1.0, 31.0)[:, None] * [0.41, 0.0, 0.0]
    points = np.concatenate([arc, straight])
    found = local_curvature(points, np.array([0, len(points)]))
    np.testing.assert_allclose(found[2:16], 1 / 5.0, rtol=0.02)
    np.testing.assert_allclose(found[23:], 0.0, atol=1e-6)
    assert local_curvature(points[:2], np.array([0, 2])).tolist() == [0.0, 0.0]
