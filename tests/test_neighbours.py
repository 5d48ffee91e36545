"""The grid of cells: the same nearest points as scipy's tree, and of equally near ones the first."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.neighbours import PointGrid


@pytest.mark.parametrize(("count", "reach"), [(16, 3.0), (1, 3.0), (1, np.inf), (5, np.inf)])
def test_the_nearest_are_those_of_scipys_tree(count, reach):
    generator = np.random.default_rng(count)
    points = (generator.normal(size=(3000, 3)) * [30, 5, 1]).astype(np.float32)
    queries = (generator.normal(size=(2000, 3)) * [35, 8, 4]).astype(np.float32)
    index, distance = PointGrid.build(points).nearest(queries, count, reach)
    tree = cKDTree(points.astype(np.float64))
    expected = tree.query(queries.astype(np.float64), k=[*range(1, count + 1)], distance_upper_bound=reach)[0]
    np.testing.assert_allclose(distance, expected, rtol=1e-12)
    known = index >= 0
    assert known.any() and known.all() == np.isinf(reach)
    away = np.linalg.norm(points[index[known]].astype(np.float64) - np.repeat(queries, known.sum(axis=1), axis=0), axis=1)
    np.testing.assert_allclose(away, distance[known], rtol=1e-12)


def test_of_equally_near_points_the_first_counts():
    """Corners of a lattice around the middle of each of its cubes: eight at one distance, in cells of their own."""
    lattice = np.stack(np.meshgrid(*3 * [np.arange(8.0)], indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    points = np.concatenate([lattice, lattice])
    middles = lattice[(lattice < 7).all(axis=1)] + np.float32(0.5)
    index, distance = PointGrid.build(points).nearest(middles, 3, np.inf)
    np.testing.assert_allclose(distance, np.sqrt(0.75), rtol=1e-6)
    lowest = (middles - 0.5) @ [64, 8, 1]
    np.testing.assert_array_equal(index, lowest[:, None] + [0, 1, 8])


def test_a_query_far_from_all_points_finds_them():
    points = np.random.default_rng(0).uniform(0, 10, (500, 3)).astype(np.float32)
    queries = np.array([[200.0, -80.0, 5.0], [5.0, 5.0, 40.0]], np.float32)
    index, distance = PointGrid.build(points).nearest(queries, 2, np.inf)
    expected, nearest = cKDTree(points.astype(np.float64)).query(queries.astype(np.float64), k=2)
    np.testing.assert_allclose(distance, expected, rtol=1e-12)
    np.testing.assert_array_equal(index, nearest)


def test_no_points_are_no_neighbours():
    index, distance = PointGrid.build(np.zeros((0, 3))).nearest(np.zeros((4, 3)), 2, 1.0)
    assert (index == -1).all() and np.isinf(distance).all()


def test_more_than_there_are_end_with_none():
    points = np.random.default_rng(0).uniform(0, 10, (5, 3)).astype(np.float32)
    index, distance = PointGrid.build(points).nearest(np.array([[5.0, 5.0, 5.0], [-40.0, 90.0, 5.0]], np.float32), 8, np.inf)
    np.testing.assert_array_equal(np.sort(index, axis=1)[:, 3:], [[*range(5)]] * 2)
    assert (index[:, 5:] == -1).all() and np.isinf(distance[:, 5:]).all() and (np.diff(distance[:, :5]) >= 0).all()
