"""The triangle tree against brute force: closest points and winding numbers of triangles at random."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.head.nearest import TriangleTree


@pytest.fixture(scope="module")
def soup():
    """300 triangles at random, some of no area, and 400 points."""
    generator = np.random.default_rng(6)
    vertices = generator.uniform(-50, 50, (300, 1, 3)) + generator.normal(0, 8, (300, 3, 3))
    vertices[::50, 2] = vertices[::50, 1]
    return vertices.reshape(-1, 3), np.arange(900).reshape(-1, 3), generator.uniform(-80, 80, (400, 3))


def closest_by_brute_force(a, b, c, p):
    """(F,) distances from p to triangles: the plane where the foot lies inside, else the nearest of the edges."""

    def to_edge(u, v):
        along = v - u
        t = np.clip(((p - u) * along).sum(1) / np.maximum((along**2).sum(1), 1e-30), 0, 1)
        return np.linalg.norm(p - u - t[:, None] * along, axis=1)

    least = np.minimum.reduce([to_edge(a, b), to_edge(b, c), to_edge(c, a)])
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(size, 1e-30)[:, None]
    height = ((p - a) * normal).sum(1)
    foot = p - height[:, None] * normal
    inside = size > 1e-9
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(v - u, foot - u) * normal).sum(1) >= 0
    return np.where(inside, np.abs(height), least)


def test_nearest_is_what_brute_force_finds(soup):
    vertices, faces, points = soup
    distance, face, bary = TriangleTree.build(vertices, faces).nearest(points)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    every = np.array([closest_by_brute_force(a, b, c, p) for p in points])
    np.testing.assert_allclose(distance, every.min(axis=1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(every[np.arange(len(points)), face], distance, rtol=1e-9, atol=1e-9)
    assert bary.min() >= -1e-9
    np.testing.assert_allclose(bary.sum(axis=1), 1.0)
    found = (vertices[faces[face]] * bary[:, :, None]).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), distance, rtol=1e-9, atol=1e-9)


def test_beyond_the_reach_there_is_nothing(soup):
    vertices, faces, points = soup
    tree = TriangleTree.build(vertices, faces)
    everywhere, _, _ = tree.nearest(points)
    distance, face, _ = tree.nearest(points, 10.0)
    near = everywhere < 10.0
    assert 0 < near.sum() < len(points)
    np.testing.assert_array_equal(face >= 0, near)
    np.testing.assert_array_equal(distance[near], everywhere[near])
    assert np.isinf(distance[~near]).all()


def solid_angle(a, b, c):
    """Van Oosterom and Strackee 1983."""
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    top = np.einsum("ij,ij->i", a, np.cross(b, c))
    bottom = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return 2.0 * np.arctan2(top, bottom)


def test_winding_numbers_are_the_solid_angles(soup, ball):
    _, _, points = soup
    faces, vertices = ball.faces, ball.vertices.astype(np.float64)
    points = 1.3 * points
    found = TriangleTree.build(vertices, faces).winding(points)
    exact = np.array([solid_angle(*(vertices[faces[:, k]] - p for k in range(3))).sum() for p in points]) / (4 * np.pi)
    np.testing.assert_allclose(found, exact, atol=0.05)
    assert 20 < np.count_nonzero(exact > 0.5) < 380


def test_a_refitted_tree_answers_as_a_new_one(soup):
    vertices, faces, points = soup
    moved = vertices + np.random.default_rng(7).normal(0, 3, vertices.shape)
    refitted = TriangleTree.build(vertices, faces).refitted(moved, faces)
    new = TriangleTree.build(moved, faces)
    np.testing.assert_allclose(refitted.nearest(points)[0], new.nearest(points)[0], rtol=1e-12)
    assert not np.allclose(refitted.nearest(points)[0], TriangleTree.build(vertices, faces).nearest(points)[0])
