"""The paper's way to guides: each step of it on phantoms worked out by hand, and the whole on a ball of a head."""

import numba
import numpy as np
import pytest

from ct2hair_addon.guides import trace_guides
from ct2hair_addon.guides.paper import (
    OrientedPoints,
    euler_segments,
    filtered_points,
    fine_and_poor,
    grow_poor,
)
from ct2hair_addon.head import Head
from ct2hair_addon.orientation import OrientationField
from ct2hair_addon.settings import GuideSettings
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume

SPACING, RADIUS = 0.5, 20.0
SETTINGS = GuideSettings(method="paper")


@pytest.fixture(scope="module")
def ball(make_ball) -> Head:
    """A sphere of 20 mm around the origin whose upper half is scalp."""
    return Head(make_ball(RADIUS, 2.0, rings=24, sides=48))


def tubes(curves, shape, radius=1.2, tilt=0.0, seed=0) -> tuple[BrickVolume, BrickVolume]:
    """(direction, confidence) around curves (voxels, fine): voxels within `radius` take the nearest point's tangent, turned
    at random by about `tilt` radians and of either sign, as an estimate would be."""
    generator = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1).reshape(-1, 3)
    nearest, vectors = np.full(len(grid), np.inf), np.zeros((len(grid), 3))
    for curve in curves:
        tangents = np.gradient(curve, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        for place, tangent in zip(curve, tangents, strict=True):
            distance = np.linalg.norm(grid - place, axis=1)
            closer = distance < nearest
            nearest[closer], vectors[closer] = distance[closer], tangent
    vectors += generator.normal(0, tilt, vectors.shape)
    vectors *= generator.choice([-1, 1], (len(grid), 1)) / np.linalg.norm(vectors, axis=1, keepdims=True).clip(1e-9)
    inside = (nearest <= radius).reshape(shape)
    direction = np.where(inside[..., None], np.rint(127 * vectors.reshape(*shape, 3)), 0).astype(np.int8)
    size = tuple(-(-n // 16) for n in shape)
    table = np.arange(np.prod(size), dtype=np.int32).reshape(size)
    bricks = np.zeros((table.size, 16, 16, 16, 3), np.int8)
    sure = np.zeros((table.size, 16, 16, 16), np.uint8)
    for I, J, K in np.ndindex(*size):
        part = tuple(slice(16 * n, 16 * n + 16) for n in (I, J, K))
        block = direction[part]
        bricks[table[I, J, K], : block.shape[0], : block.shape[1], : block.shape[2]] = block
        sure[table[I, J, K], : block.shape[0], : block.shape[1], : block.shape[2]] = 200 * inside[part]
    return BrickVolume(table, bricks, SPACING, (0, 0, 0)), BrickVolume(table, sure, SPACING, (0, 0, 0))


def straight(start, end, step=0.5):
    start, end = np.array(start, float), np.array(end, float)
    count = int(np.linalg.norm(end - start) / step) + 1
    return start + np.linspace(0, 1, count)[:, None] * (end - start)


def away(points, curve):
    return np.sqrt(((points[:, None] - curve[None]) ** 2).sum(-1).min(1))


def test_the_mean_shift_draws_points_onto_the_line_and_averages_orientations():
    curve = straight((4, 15.4, 14.8), (44, 18.2, 16.1), 0.1)
    direction, confidence = tubes([curve], (48, 32, 32), radius=1.6, tilt=0.15)
    points = filtered_points(direction, confidence)
    index = np.argwhere(confidence.block((0, 0, 0), (48, 32, 32)) > 0)
    assert len(points) == len(index) > 200
    inner = (points.places[:, 0] > 8) & (points.places[:, 0] < 40)
    before, after = away(index.astype(float), curve), away(points.places, curve)
    assert after[inner].mean() < 0.35 * before.mean()
    truth = (curve[-1] - curve[0]) / np.linalg.norm(curve[-1] - curve[0])
    error = np.degrees(np.arccos(np.abs(points.directions @ truth).clip(max=1)))
    assert np.median(error[inner]) < 4.0  # one voxel's own error is 12 degrees
    np.testing.assert_allclose(np.linalg.norm(points.directions, axis=1), 1.0, atol=1e-4)


def test_a_point_moves_in_the_plane_normal_to_its_orientation():
    # a lone row of voxels along x with a gap at one end: an ordinary mean shift would draw its points along x
    curve = straight((4, 16, 16), (12, 16, 16), 0.1)
    points = filtered_points(*tubes([curve], (32, 32, 32), radius=0.4))
    np.testing.assert_allclose(np.sort(points.places[:, 0]), np.arange(4, 13), atol=0.02)
    np.testing.assert_allclose(points.places[:, 1:], 16.0, atol=0.02)


def test_segments_follow_their_lines_and_share_no_points():
    curves = [straight((4, 12, 12), (60, 14, 12), 0.25), straight((4, 22, 20), (60, 22, 24), 0.25)]
    turn = np.linspace(0, 1.2 * np.pi, 200)
    curves.append(np.stack([32 + 18 * np.cos(turn), 40 + 18 * np.sin(turn), 40 + 3 * turn], 1))
    direction, confidence = tubes(curves, (64, 64, 64))
    points = filtered_points(direction, confidence)
    segments, tally = euler_segments(points, confidence.table.shape, SPACING, SETTINGS, 0)
    assert len(segments) == 3 == tally["segments"]
    assert sum(count for name, count in tally.items() if name.startswith("ended")) == 6
    for curve in curves:
        line = min(segments.polylines(), key=lambda line: away(line, curve).max())
        assert away(line, curve)[2:-2].max() < 0.5
        assert away(line, curve).max() < 2.1  # an end overshoots by a capture radius and a step
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).sum() > np.linalg.norm(np.diff(curve, axis=0), axis=1).sum() - 3


def test_two_strands_closer_than_the_bandwidth_become_one():
    # what the density could tell apart, its binary points can't: the paper's limit, and why tracing is our default
    curves = [straight((4, 16, 16), (44, 16, 16)), straight((4, 17.2, 16), (44, 17.2, 16))]
    direction, confidence = tubes(curves, (48, 32, 32), radius=0.9)
    segments, _ = euler_segments(filtered_points(direction, confidence), confidence.table.shape, SPACING, SETTINGS, 0)
    assert len(segments) == 1
    assert (np.abs(segments.points[2:-2, 1] - 16.6) < 0.6).all()


def test_a_ring_is_walked_once():
    turn = np.linspace(0, 2 * np.pi, 400)
    curve = np.stack([24 + 15 * np.cos(turn), 24 + 15 * np.sin(turn), np.full(400, 16.0)], 1)
    direction, confidence = tubes([curve], (48, 48, 32))
    segments, _ = euler_segments(filtered_points(direction, confidence), confidence.table.shape, SPACING, SETTINGS, 0)
    assert len(segments) == 1
    assert 0.85 * 2 * np.pi * 15 < segments.lengths()[0] < 1.2 * 2 * np.pi * 15


def test_no_points_give_no_segments():
    nothing = OrientedPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.uint8))
    segments, tally = euler_segments(nothing, (2, 2, 2), SPACING, SETTINGS, 0)
    assert len(segments) == 0 and tally["segments"] == 0


def ray(direction, start, end, step=1.0) -> np.ndarray:
    """Points over the ball along a radius, from `start` to `end` mm over the skin."""
    direction = np.array(direction, float) / np.linalg.norm(direction)
    return (RADIUS + np.arange(start, end + 1e-9, step))[:, None] * direction


def test_algorithm_1_separates_fine_from_poor(ball):
    up = (0.2, 0.1, 1.0)
    lines = [
        ray(up, 3, 50),  # long, near the scalp: fine
        ray(up, 3, 50)[::-1],  # the same, the other way round: fine, reversed
        ray(up, 3, 30),  # 27 mm: shorter than tau_l
        ray(up, 9, 60),  # starts farther than tau_c from the scalp
        # starts near the scalp, but 80 degrees off its normal
        np.array([0, 0, RADIUS + 3.0]) + np.arange(0, 50)[:, None] * [np.sin(np.radians(80)), 0, np.cos(np.radians(80))],
    ]
    fine, poor = fine_and_poor(Strands.from_polylines(lines), ball, SETTINGS)
    assert len(fine) == 2 and len(poor) == 3
    for line in fine.polylines():
        # the scalp's nearest point was put before the segment
        assert np.linalg.norm(line[0]) == pytest.approx(RADIUS, abs=0.2)
        np.testing.assert_allclose(line[1:], lines[0], atol=1e-4)


def test_poor_segments_grow_by_their_neighbours_steps(ball):
    up = np.array([0.0, 0.0, 1.0])
    fine = Strands.from_polylines([ray(up, 0, 60)])
    beside = np.array([2.0, 0.0, 0.0])
    lines = [
        ray(up, 20, 40) + beside,  # as it is
        ray(up, 20, 40)[::-1] + beside,  # turned
        ray(up, 20, 40) + 5 * beside,  # no fine strand within tau_s
        # begins beside the fine strand, ends away from it: no growing at the tip
        np.array([2.0, 0, RADIUS + 20]) + np.arange(0, 20)[:, None] * [0.8, 0, 0.6],
        # the same from its other end
        (np.array([2.0, 0, RADIUS + 20]) + np.arange(0, 20)[:, None] * [0.8, 0, 0.6])[::-1],
        # only its tip is beside the fine strand: it could grow only forward
        np.array([2.0 + 0.8 * 19, 0, RADIUS + 20]) + np.arange(0, 20)[:, None] * [-0.8, 0, 0.6],
        # from both ends its way in leads down, against the fine strand's growing direction
        np.array([[2, 0, 60], [2, 0, 59], [4, 0, 58], [4, 0, 59], [2, 0, 60.5], [2, 0, 61.5]], float),
    ]
    poor = Strands.from_polylines(lines)
    grown, source, tally = grow_poor(poor, fine, ball, SETTINGS)
    assert source.tolist() == [0, 1, 3, 4]
    assert tally["deleted: no fine strand near"] == 1
    assert tally["deleted: grows only forward"] == 1
    assert tally["deleted: ends disagree"] == 1
    # root end: from 20 mm down to where tau_c = 8 mm is reached; tip: on to the fine strand's own at 60 mm
    for line in grown.polylines()[:2]:
        # the first point within 8 mm of the ball: at 7 mm over its pole, 2 mm aside (28 mm up it is 8.07 mm away)
        np.testing.assert_allclose(line, ray(up, 7, 60) + beside, atol=1e-3)
    for line in grown.polylines()[2:]:
        np.testing.assert_allclose(line[-1], lines[3][-1], atol=1e-4)
        np.testing.assert_allclose(line[:12, 0], 2.0, atol=1e-3)


def test_without_fine_strands_nothing_grows(ball):
    nothing = Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
    grown, source, tally = grow_poor(Strands.from_polylines([ray((0, 0, 1), 20, 40)]), nothing, ball, SETTINGS)
    assert len(grown) == len(source) == 0 and tally["deleted: no fine strand near"] == 1


def test_the_whole_gives_rooted_guides_the_same_on_any_number_of_threads(ball):
    # hairs over the ball, 4 to 44 mm from its skin, in a volume whose origin is not the ball's centre
    origin = np.array([-12.0, -12.0, 18.0])
    curves = [ray((x, y, 1.0), 4, 44, 0.2) for x in (-0.12, 0.0, 0.12) for y in (-0.1, 0.1)]
    direction, confidence = tubes([(curve - origin) / SPACING for curve in curves], (48, 48, 96), tilt=0.05)
    placed = [BrickVolume(v.table, v.bricks, SPACING, origin) for v in (direction, confidence)]
    field = OrientationField(*placed, {})
    density = BrickVolume(placed[1].table, placed[1].bricks.astype(np.float32), SPACING, origin)
    guides = trace_guides(density, 1.0, field, ball, SETTINGS)
    assert len(guides.strands) == len(curves) == guides.tally["fine segments"]
    assert ball.closest_scalp(guides.strands.roots).distance.max() < 1e-3
    assert (np.linalg.norm(guides.strands.tips, axis=1) > RADIUS + 40).all()
    support = guides.strands.strand_attributes["support"]
    assert support.min() > 0.8 and guides.strands.strand_attributes["root_uv"].shape == (len(curves), 2)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = trace_guides(density, 1.0, field, ball, SETTINGS)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(one.strands.points, guides.strands.points)
