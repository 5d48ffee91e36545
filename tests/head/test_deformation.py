"""The B-spline lattice: what it can follow exactly, what the penalties say of it, and its solver against numpy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix, identity

from ct2hair_addon.head.deformation import Lattice, least_squares


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(10).uniform(-60, 60, (700, 3))


@pytest.fixture(scope="module")
def lattice(points):
    return Lattice.over(points, 30.0)


def test_the_weights_of_a_point_add_up_to_1(lattice, points):
    assert lattice.rows.shape[0] == len(points)
    np.testing.assert_allclose(lattice.rows.sum(axis=1), 1.0, rtol=1e-12)
    assert lattice.rows.min() >= 0.0


def test_an_affine_displacement_is_followed_exactly_at_no_bending(lattice, points):
    matrix = np.array([[0.1, -0.2, 0.05], [0.0, 0.15, 0.1], [-0.1, 0.02, -0.05]])
    wanted = points @ matrix.T + [3.0, -2.0, 1.0]
    start = np.zeros((lattice.rows.shape[1], 3))
    found = lattice.fitted(identity(len(points), format="csr"), wanted, np.ones(len(points)), 1e-3, 0.0, start)
    np.testing.assert_allclose(lattice.rows @ found, wanted, atol=0.2)  # the solver stops at a thousandth


def test_the_penalties_of_a_shift_are_none_and_of_a_slope_its_integral(points):
    lattice = Lattice.over(points, 30.0)
    count = lattice.rows.shape[1]
    shift = np.ones(count)
    assert shift @ lattice.bending @ shift == pytest.approx(0.0, abs=1e-9)
    assert shift @ lattice.slope @ shift == pytest.approx(0.0, abs=1e-9)
    noise = np.random.default_rng(1).normal(size=count)
    assert noise @ lattice.bending @ noise > 0 and noise @ lattice.slope @ noise > 0
    for matrix in (lattice.bending, lattice.slope):
        assert abs(matrix - matrix.T).max() < 1e-12


def test_more_bending_penalty_makes_a_smoother_displacement(lattice, points):
    wanted = np.random.default_rng(2).normal(0, 3.0, points.shape)
    start = np.zeros((lattice.rows.shape[1], 3))
    blend = identity(len(points), format="csr")
    loose, stiff = (
        lattice.rows @ lattice.fitted(blend, wanted, np.ones(len(points)), bending, 0.0, start) for bending in (1.0, 1e4)
    )
    assert np.std(stiff) < 0.5 * np.std(loose)


def test_the_solver_is_least_squares():
    generator = np.random.default_rng(3)
    rows, weight = generator.normal(size=(60, 12)), generator.uniform(0.1, 2.0, 60)
    wanted = generator.normal(size=(60, 3))
    penalty = np.diag(generator.uniform(0.1, 1.0, 12))
    exact = np.linalg.solve(rows.T @ (weight[:, None] * rows) + penalty, rows.T @ (weight[:, None] * wanted))
    found = least_squares(csr_matrix(rows), wanted, weight, csr_matrix(penalty), np.zeros((12, 3)))
    np.testing.assert_allclose(found, exact, atol=5e-3)
