"""Head: distances, sides, texture and frames on a ball, where each is known, and on the template against brute force."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import Head

RADIUS = 80.0
SAGITTA = RADIUS * (1.0 - np.cos(np.pi / 40) ** 2)
"""How far the ball's facets lie below the sphere at most."""


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(8).uniform(-140, 140, (5000, 3))


def test_the_signed_distance_is_the_spheres_to_the_depth_of_a_facet(ball_queries, points):
    found = ball_queries.signed_distance(points)
    exact = np.linalg.norm(points, axis=1) - RADIUS
    assert found.dtype == np.float32
    error = found - exact
    assert error.min() > -0.01 and error.max() < SAGITTA + 0.01
    clear = np.abs(exact) > SAGITTA
    np.testing.assert_array_equal(found[clear] < 0, exact[clear] < 0)


def test_the_signed_distance_is_the_trees_and_the_winding_numbers(template_queries):
    generator = np.random.default_rng(9)
    low, high = template_queries.mesh.vertices.min(axis=0) - 30, template_queries.mesh.vertices.max(axis=0) + 30
    near = template_queries.mesh.vertices[generator.integers(0, 20_000, 2000)] + generator.normal(0, 2.0, (2000, 3))
    points = np.concatenate([generator.uniform(low, high, (2000, 3)), near])
    tree = template_queries.solid_tree
    distance, _, _ = tree.nearest(points)
    expected = np.where(tree.winding(points) > 0.5, -distance, distance)
    np.testing.assert_allclose(template_queries.signed_distance(points), expected, atol=1e-4)


def test_outward_is_the_slope_of_the_signed_distance(template_queries):
    generator = np.random.default_rng(10)
    points = template_queries.mesh.vertices[generator.integers(0, 20_000, 3000)] + generator.normal(0, 3.0, (3000, 3))
    found, h = template_queries.outward(points), 0.01
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-9)
    steps = h * np.concatenate([np.eye(3), -np.eye(3)])
    values = template_queries.signed_distance((points[None] + steps[:, None]).reshape(-1, 3)).astype(float).reshape(6, -1)
    slope = (values[:3] - values[3:]).T / (2.0 * h)
    smooth = np.abs(np.linalg.norm(slope, axis=1) - 1.0) < 0.01  # not where two places of the head are equally near
    assert smooth.mean() > 0.95
    assert np.einsum("ni,ni->n", found, slope)[smooth].min() > 0.99
    assert np.quantile(np.einsum("ni,ni->n", found, slope), 0.05) > 0.95


def test_outward_on_the_surface_is_the_triangles_normal(template_queries):
    mesh = template_queries.mesh
    corner = mesh.vertices.astype(np.float64)[mesh.faces[::50]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = template_queries.outward(corner.mean(axis=1))
    assert np.quantile(np.einsum("ni,ni->n", found, normal), 0.02) > 0.99
    assert template_queries.outward(np.zeros((0, 3))).shape == (0, 3)


def test_where_a_mesh_runs_through_itself_the_inner_walls_are_none(ball):
    """A second ball is sunk into the first, below its scalp: what of each lies in the other has the inside on both sides."""
    moved = ball.vertices + np.float32([0.0, 0.0, -60.0])
    count = len(ball.vertices)
    both = Head(
        replace(
            ball,
            vertices=np.concatenate([ball.vertices, moved]),
            faces=np.concatenate([ball.faces, ball.faces + count]),
            uv=np.concatenate([ball.uv, np.full_like(ball.uv, np.nan)]),
            scalp=np.concatenate([ball.scalp, np.zeros(count, bool)]),
        )
    )
    generator = np.random.default_rng(5)
    points = both.mesh.vertices[generator.integers(0, 2 * count, 4000)] + generator.normal(0, 1.5, (4000, 3))
    inside = np.minimum(np.linalg.norm(points, axis=1), np.linalg.norm(points - [0.0, 0.0, -60.0], axis=1)) < RADIUS - SAGITTA
    clear = both.solid_tree.nearest(points)[0] > 1e-3
    assert 0.1 < both.walls.mean() < 0.9 and inside.mean() > 0.3
    found = both.signed_distance(points) < 0.0
    np.testing.assert_array_equal(found[clear], both.solid_tree.winding(points)[clear] > 0.5)
    assert found[inside].all()


@pytest.mark.parametrize("beyond", [0.05, 4.0, 30.0])
def test_beyond_what_is_asked_a_bound_of_the_distance_is_told(template_queries, beyond):
    points = np.random.default_rng(3).uniform(-200, 400, (4000, 3)) + template_queries.mesh.vertices.mean(axis=0) - 100.0
    exact, told = template_queries.signed_distance(points), template_queries.signed_distance(points, beyond)
    near = np.abs(exact) <= beyond
    np.testing.assert_array_equal(told[near], exact[near])
    assert (np.sign(told) == np.sign(exact)).all()
    assert (np.abs(told[~near]) >= beyond - 1e-4).all() and (np.abs(told) <= np.abs(exact) + 1e-4).all()
    assert (told != exact).any()


def test_threads_change_no_bit(template_queries, points):
    before = numba.get_num_threads()
    many = template_queries.signed_distance(points), template_queries.closest_scalp(points).position
    try:
        numba.set_num_threads(1)
        one = template_queries.signed_distance(points), template_queries.closest_scalp(points).position
    finally:
        numba.set_num_threads(before)
    for a, b in zip(many, one, strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_open_mesh_has_an_inside(ball, ball_queries, points):
    low = ball.vertices[ball.faces][:, :, 2].max(axis=1) < -60.0
    opened = Head(replace(ball, faces=ball.faces[~low]))
    kept = points[points[:, 2] > -40]
    np.testing.assert_allclose(opened.signed_distance(kept) < 0, ball_queries.signed_distance(kept) < 0)
    under = np.array([[0.0, 0.0, -55.0], [0.0, 0.0, -70.0]])
    assert (np.sign(opened.signed_distance(under)) == [-1, 1]).all()


def test_the_closest_scalp_is_straight_above_or_on_the_rim(ball_queries, points):
    found = ball_queries.closest_scalp(points)
    above = points[:, 2] > 0
    radius = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(found.distance[above], np.abs(radius - RADIUS)[above], atol=SAGITTA)
    rim = np.hypot(np.hypot(points[:, 0], points[:, 1]) - RADIUS, points[:, 2])
    np.testing.assert_allclose(found.distance[~above], rim[~above], atol=0.5)
    np.testing.assert_allclose(np.linalg.norm(found.position - points, axis=1), found.distance, atol=1e-3)
    direction = found.position / np.linalg.norm(found.position, axis=1, keepdims=True)
    assert ((found.normal * direction).sum(axis=1) > 0.995).all()
    corners = ball_queries.mesh.vertices[ball_queries.mesh.faces[found.face]]
    np.testing.assert_allclose((corners * found.bary[:, :, None]).sum(axis=1), found.position, atol=1e-3)
    near = ball_queries.closest_scalp(points, 20.0)
    np.testing.assert_array_equal(near.valid, found.distance < 20.0)
    assert np.isnan(near.position[~near.valid]).all() and (near.face[~near.valid] == -1).all()


def test_the_texture_leads_back_to_the_scalp(template_queries):
    sample = template_queries.sample_scalp(3000, 4)
    found = template_queries.on_scalp(sample.uv)
    assert found.valid.mean() > 0.999
    off = np.linalg.norm(found.position - sample.position, axis=1)[found.valid]
    assert off.max() < 0.05
    assert not template_queries.on_scalp(np.array([[0.0, 0.0], [1.0, 1.0], [-0.5, 0.5], [2.0, 2.0]])).valid.any()


def test_frames_are_orthonormal_right_handed_and_follow_the_texture(template_queries):
    sample = template_queries.sample_scalp(4000, 5)
    frames = template_queries.frames(sample.face, sample.bary).astype(np.float64)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-5)
    np.testing.assert_allclose(frames[:, 2], sample.normal, atol=1e-5)
    # a step along the tangent grows u, along the bitangent v
    for row, other in ((0, 1), (1, 0)):
        moved = template_queries.closest_scalp(sample.position + 2.0 * frames[:, row])
        inner = moved.distance < 0.5
        step = (moved.uv - sample.uv)[inner]
        assert inner.mean() > 0.95
        assert np.mean(step[:, row] > 0) > 0.995
        assert np.median(np.abs(step[:, other]) / step[:, row]) < 0.15


def test_frames_turn_smoothly(template_queries):
    sample = template_queries.sample_scalp(6000, 6)
    frames = template_queries.frames(sample.face, sample.bary)
    distance, near = cKDTree(sample.position).query(sample.position, k=2)
    angle = np.degrees(np.arccos(np.clip((frames * frames[near[:, 1]]).sum(axis=2), -1, 1)))
    assert distance[:, 1].max() < 5.0
    assert np.quantile(angle, 0.999) < 25.0 and np.median(angle) < 4.0


def test_samples_are_even_apart_and_the_same_for_a_seed(ball_queries):
    sample = ball_queries.sample_scalp(2000, 7)
    again, other = ball_queries.sample_scalp(2000, 7), ball_queries.sample_scalp(2000, 8)
    np.testing.assert_array_equal(sample.position, again.position)
    assert not np.array_equal(sample.position, other.position)
    assert len(sample) == 2000 and (sample.position[:, 2] > -1e-3).all()
    np.testing.assert_allclose(np.linalg.norm(sample.position, axis=1), RADIUS, atol=SAGITTA)
    # on a half sphere the height is uniform, and so is the angle (Archimedes)
    for values, high in (
        (sample.position[:, 2], RADIUS),
        (np.arctan2(sample.position[:, 1], sample.position[:, 0]) + np.pi, 2 * np.pi),
    ):
        counts, _ = np.histogram(values, 10, (0.0, high))
        assert np.abs(counts - 200).max() < 45
    # blue noise: nearest neighbours keep most of the distance of the densest packing, where chance alone keeps none
    packing = np.sqrt(2 * np.pi * RADIUS**2 / 2000 * 2 / np.sqrt(3))
    nearest = cKDTree(sample.position).query(sample.position, k=2)[0][:, 1]
    assert nearest.min() > 0.55 * packing
    # any first part is spread over the whole scalp, too
    first = cKDTree(sample.position[:200]).query(sample.position)[0]
    assert first.max() < 2.0 * packing * np.sqrt(10)


def test_a_head_without_a_scalp_is_refused(ball):
    bare = replace(ball, scalp=np.zeros(len(ball.vertices), bool))
    with pytest.raises(HeadError, match=r"the mesh has no scalp\. Mark it with a vertex group 'scalp'"):
        Head(bare)
    broken = ball.vertices.copy()
    broken[3] = np.nan
    with pytest.raises(HeadError, match="not finite numbers; repair it"):
        Head(replace(ball, vertices=broken))
    with pytest.raises(HeadError, match="the mesh has no faces"):
        Head(replace(ball, faces=np.zeros((0, 3), np.int32)))
