"""Strands: offsets, arc length, resampling, selection, files."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ct2hair_addon.errors import StrandFileError
from ct2hair_addon.strands import THREADED, Strands, concatenate, nearest_points, point_tree, points_around


def two_strands() -> Strands:
    return Strands(
        np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [5, 5, 5], [5, 5, 9]], np.float32),
        np.array([0, 3, 5]),
        {"support": np.array([0.25, 1.0], np.float32)},
        {"confidence": np.arange(5, dtype=np.float32)},
    )


def test_lengths_roots_and_tips():
    strands = two_strands()
    np.testing.assert_array_equal(strands.lengths(), [3, 4])
    np.testing.assert_array_equal(strands.roots, [[0, 0, 0], [5, 5, 5]])
    np.testing.assert_array_equal(strands.tips, [[1, 2, 0], [5, 5, 9]])
    np.testing.assert_array_equal(strands.strand_index, [0, 0, 0, 1, 1])


def test_resampling_keeps_ends_and_spaces_evenly():
    resampled = two_strands().resampled(4)
    np.testing.assert_allclose(resampled[0], [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 2, 0]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(resampled[1], axis=0), axis=1), 4 / 3, rtol=1e-5)


def test_resampling_by_step_never_exceeds_the_step():
    strands = two_strands().resampled_by_step(0.3)
    gaps = np.linalg.norm(np.diff(strands.points, axis=0), axis=1)
    assert np.delete(gaps, strands.offsets[1:-1] - 1).max() <= 0.3 + 1e-6
    np.testing.assert_array_equal(strands.tips, two_strands().tips)


def test_reversed_turns_only_the_chosen_strands_and_their_attributes():
    turned = two_strands().reversed(np.array([True, False]))
    np.testing.assert_array_equal(turned.points[:3], two_strands().points[2::-1])
    np.testing.assert_array_equal(turned.points[3:], two_strands().points[3:])
    np.testing.assert_array_equal(turned.point_attributes["confidence"], [2, 1, 0, 3, 4])


def test_select_by_mask_and_index_keeps_attributes():
    strands = two_strands()
    for which in (np.array([False, True]), np.array([1])):
        chosen = strands.select(which)
        np.testing.assert_array_equal(chosen.points, strands.points[3:])
        np.testing.assert_array_equal(chosen.strand_attributes["support"], [1.0])
        np.testing.assert_array_equal(chosen.point_attributes["confidence"], [3, 4])
    np.testing.assert_array_equal(strands.select(np.array([1, 0])).counts, [2, 3])


def test_transformed_applies_rotation_then_translation():
    matrix = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    np.testing.assert_allclose(two_strands().transformed(matrix).points[1], [10, 21, 30])


def test_concatenate_keeps_common_attributes():
    joined = concatenate([two_strands(), two_strands().with_attributes(extra=np.zeros(2))])
    assert len(joined) == 4 and set(joined.strand_attributes) == {"support"}
    np.testing.assert_array_equal(joined.counts, [3, 2, 3, 2])
    assert len(concatenate([])) == 0


def test_files_come_back_equal_and_byte_for_byte_the_same(tmp_path):
    strands = two_strands()
    strands.save(tmp_path / "a.npz")
    strands.save(tmp_path / "b.npz")
    back = Strands.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.points, strands.points)
    np.testing.assert_array_equal(back.strand_attributes["support"], strands.strand_attributes["support"])
    np.testing.assert_array_equal(back.point_attributes["confidence"], strands.point_attributes["confidence"])
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_damaged_and_missing_files_are_named(tmp_path):
    path = tmp_path / "broken.npz"
    path.write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(StrandFileError, match=r"broken\.npz"):
        Strands.load(path)
    with pytest.raises(StrandFileError, match="no such file"):
        Strands.load(tmp_path / "absent.npz")


def test_inconsistent_offsets_are_refused():
    with pytest.raises(ValueError, match="offsets"):
        Strands(np.zeros((3, 3)), np.array([0, 2]))
    with pytest.raises(ValueError, match="support"):
        Strands(np.zeros((3, 3)), np.array([0, 3]), {"support": np.zeros(2)})


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(2, 9), min_size=1, max_size=5), st.integers(2, 40), st.integers(0, 2**31))
def test_resampling_never_lengthens_a_strand(counts, size, seed):
    rng = np.random.default_rng(seed)
    strands = Strands.from_polylines([rng.normal(size=(n, 3)) for n in counts])
    chords = np.linalg.norm(np.diff(strands.resampled(size), axis=1), axis=2).sum(axis=1)
    assert np.all(chords <= strands.lengths() * (1 + 1e-5) + 1e-5)


@pytest.mark.parametrize("reach", [0.3, 6.0])
def test_a_tree_of_the_points_around_answers_as_one_of_all(reach):
    rng = np.random.default_rng(4)
    points = rng.uniform(-60.0, 60.0, (20_000, 3)).astype(np.float32)
    places = np.concatenate([points[:40] + np.float32(0.1), rng.uniform(-20.0, 30.0, (40, 3)), [[900.0, 0.0, 0.0]]])
    some = points_around(points, places, reach)
    assert len(some) < 0.5 * len(points)
    distance, near = point_tree(points).query(places, k=6, distance_upper_bound=reach)
    fewer, among = point_tree(points[some]).query(places, k=6, distance_upper_bound=reach)
    np.testing.assert_array_equal(fewer, distance)
    found = np.isfinite(distance)
    assert found.any()
    np.testing.assert_array_equal(some[among[found]], near[found])


def test_nothing_is_around_no_places():
    assert not len(points_around(np.zeros((5, 3), np.float32), np.zeros((0, 3)), 1.0))


def test_a_tree_is_asked_on_no_more_threads_than_kernels_run_on():
    asked = []

    class Tree:
        def query(self, places, **options):
            asked.append(options["workers"])

    most = numba.get_num_threads()
    try:
        for threads in {1, most}:
            numba.set_num_threads(threads)
            for count in (THREADED - 1, THREADED):
                nearest_points(Tree(), np.zeros((count, 3)))
            assert asked[-2:] == [1, threads]
    finally:
        numba.set_num_threads(most)


def test_the_nearest_points_are_those_within_reach():
    tree = point_tree(np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]]))
    distance, near = nearest_points(tree, np.array([[0.2, 0, 0]]), 3, 2.0)
    np.testing.assert_allclose(distance, [[0.2, 0.8, np.inf]])
    assert near.tolist() == [[0, 1, 3]]
