"""The scalp's surface from knots: harmonics, a sphere through junk, a bumpy cap with gaps."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import scalp_surface
from ct2hair_addon.head.scalp_surface import DEGREE, harmonics, scalp_sphere

CENTRE = np.array([120.0, -30.0, 60.0])


def directions(count, seed, lowest=-0.2):
    """Unit vectors over a cap."""
    d = np.random.default_rng(seed).normal(size=(8 * count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return d[d[:, 2] > lowest][:count]


def radius_of(d):
    """A head: 20 mm longer than wide, with a low bump on one side."""
    return 85.0 + 8.0 * (d[:, 1] ** 2 - d[:, 0] ** 2) + 3.0 * np.exp(-((d - [0.6, 0.3, 0.74]) ** 2).sum(axis=1) / 0.08)


def knots(count, junk, noise=0.3, seed=0):
    d = directions(count, seed)
    generator = np.random.default_rng(seed + 1)
    points = CENTRE + d * (radius_of(d) + generator.normal(0, noise, len(d)))[:, None]
    loose = directions(junk, seed + 2, -1.0)
    loose = CENTRE + loose * (95.0 + generator.uniform(0, 120.0, len(loose)))[:, None]
    return np.concatenate([points, loose])


def test_harmonics_are_orthonormal():
    # Gauss quadrature over heights, even angles around: exact for the products of degree 16
    z, weight = np.polynomial.legendre.leggauss(20)
    turn = 2 * np.pi * np.arange(40) / 40
    level = np.sqrt(1 - z**2)
    d = np.stack([np.outer(level, np.cos(turn)), np.outer(level, np.sin(turn)), np.outer(z, np.ones(40))], -1).reshape(-1, 3)
    basis = harmonics(d)
    assert basis.shape == (800, (DEGREE + 1) ** 2)
    product = basis.T @ (np.repeat(weight, 40)[:, None] * basis) * 2 * np.pi / 40
    np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-10)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.5])
def test_the_sphere_is_found_among_junk(share):
    d = directions(1500, 3)
    generator = np.random.default_rng(4)
    good = CENTRE + 88.0 * d + generator.normal(0, 0.5, d.shape)
    loose = CENTRE + directions(int(1500 * share), 5, -1.0) * generator.uniform(100, 220, (int(1500 * share), 1))
    points = np.concatenate([good, loose])
    centre, radius, found = scalp_sphere(points, np.ones(len(points)))
    np.testing.assert_allclose(centre, CENTRE, atol=1.0)
    assert radius == pytest.approx(88.0, abs=1.0)
    assert found == pytest.approx(1 / (1 + share), abs=0.12)


@pytest.mark.parametrize("junk", [0, 900, 2500])
def test_a_bumpy_cap_is_followed_through_junk(junk):
    surface = scalp_surface(knots(2500, junk))
    d = directions(4000, 9, -0.1)
    off = surface.distance(CENTRE + d * radius_of(d)[:, None])
    assert np.median(np.abs(off)) < 0.6 and np.quantile(np.abs(off), 0.95) < 2.0
    # positive outside
    assert (surface.distance(CENTRE + d * (radius_of(d) + 10.0)[:, None]) > 5.0).all()


def test_a_gap_without_knots_is_bridged_roundly():
    points = knots(3000, 0)
    toward = (points - CENTRE) / np.linalg.norm(points - CENTRE, axis=1, keepdims=True)
    surface = scalp_surface(points[toward[:, 1] < 0.75])
    d = directions(4000, 9, 0.0)
    gap = d[d[:, 1] > 0.75]
    off = surface.distance(CENTRE + gap * radius_of(gap)[:, None])
    assert np.abs(off).max() < 8.0 and np.median(np.abs(off)) < 3.0


def test_points_on_no_head_are_refused():
    box = np.random.default_rng(0).uniform(-600, 600, (3000, 3))
    with pytest.raises(HeadError, match=r"no scalp was found: only \d+% of the 3000 .*set scan\.knots"):
        scalp_surface(box)
