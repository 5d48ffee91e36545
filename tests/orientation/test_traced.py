"""The field along traced strands: their directions where they run, its own elsewhere; how far each is trusted."""

import numba
import numpy as np

from ct2hair_addon.orientation import OrientationField, field_along
from ct2hair_addon.orientation.trust import DOUBT
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume

SPACING, ORIGIN = 0.5, np.array([1.0, 2.0, 3.0])


def field_of(direction, sure, shape=(32, 32, 32)):
    """A field with `direction` and the confidence `sure` (0..255) at every voxel."""
    bricks = BrickVolume.from_dense(np.full(shape, sure, np.uint8), SPACING, ORIGIN)
    directions = bricks.like(np.int8, (3,))
    directions.bricks[:] = np.round(127.0 * np.array(direction))
    return OrientationField(directions, bricks, {"hair voxels": bricks.bricks.size})


def strand(start, end):
    """From voxel to voxel."""
    points = ORIGIN + SPACING * np.linspace(start, end, 40)
    return Strands.from_polylines([points.astype(np.float32)])


def at(field, *voxel):
    direction, confidence = field.sample((ORIGIN + SPACING * np.array([voxel])).astype(np.float32))
    return np.abs(direction[0]), confidence[0]


def test_voxels_by_a_strand_take_its_direction_and_others_keep_theirs():
    field = field_along(field_of((0, 0, 1), 150), strand((2, 16, 16), (30, 16, 16)))  # across the edges of bricks
    for x in (4, 15, 16, 27):
        for y, z in ((16, 16), (17, 15)):
            direction, confidence = at(field, x, y, z)
            np.testing.assert_allclose(direction, [1, 0, 0], atol=0.02)
            assert confidence > 0.9
    direction, confidence = at(field, 16, 24, 16)
    np.testing.assert_allclose(direction, [0, 0, 1], atol=0.01)
    assert abs(confidence - 150 / 255) < 0.01
    assert field.tally == {"hair voxels": 32**3}


def test_a_sure_direction_weighs_and_a_split_one_is_unsure():
    diagonal = np.array([1, 0, 1]) / np.sqrt(2)
    sure = at(field_along(field_of(diagonal, 255), strand((2, 16, 16), (30, 16, 16))), 16, 16, 16)
    unsure = at(field_along(field_of(diagonal, 100), strand((2, 16, 16), (30, 16, 16))), 16, 16, 16)
    assert sure[0][2] > 0.1 and unsure[0][2] < 0.05
    assert sure[1] < unsure[1]
    cross = Strands.from_polylines(
        [*strand((2, 16, 16), (30, 16, 16)).polylines(), *strand((16, 2, 16), (16, 30, 16)).polylines()]
    )
    assert at(field_along(field_of((0, 0, 1), 100), cross), 16, 16, 16)[1] < 0.7


def test_directions_are_only_where_there_was_hair():
    hair = np.zeros((32, 32, 32), np.uint8)
    hair[10:20, 16, 16] = 200
    bricks = BrickVolume.from_dense(hair, SPACING, ORIGIN)
    field = OrientationField(bricks.like(np.int8, (3,)), bricks, {})
    field.direction.bricks[bricks.bricks > 0] = (0, 127, 0)
    after = field_along(field, strand((2, 16, 16), (60, 16, 16)))  # out of the table as well
    np.testing.assert_array_equal(after.confidence.bricks > 0, bricks.bricks > 0)
    assert not after.direction.bricks[bricks.bricks == 0].any()
    np.testing.assert_allclose(at(after, 15, 16, 16)[0], [1, 0, 0], atol=0.02)
    assert field_along(field, Strands.from_polylines([])).confidence.bricks.tobytes() == bricks.bricks.tobytes()


def test_the_same_bits_on_any_number_of_threads():
    rng = np.random.default_rng(0)
    strands = Strands.from_polylines(
        [(ORIGIN + SPACING * np.linspace(*rng.uniform(0, 32, (2, 3)), 30)).astype(np.float32) for _ in range(40)]
    )
    field, before = field_of((0, 0, 1), 200), numba.get_num_threads()
    many = field_along(field, strands)
    try:
        numba.set_num_threads(1)
        one = field_along(field, strands)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(one.direction.bricks, many.direction.bricks)
    np.testing.assert_array_equal(one.confidence.bricks, many.confidence.bricks)


def test_the_course_is_as_long_as_it_is_sure():
    for sure, expected in ((255, 127), (round(255 * (1 - DOUBT)), 64), (128, 1), (0, 0)):
        course = field_of((0, 0, 0.8), 255)
        course.confidence.bricks[:] = sure
        lengths = np.linalg.norm(course.course().bricks[0, 3, 3, 3].astype(float))
        assert abs(lengths - expected) <= 2
