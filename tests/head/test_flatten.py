"""The scalp laid flat: exactly where that can be, with little distortion on a half ball, and patches that can't be refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import HeadMesh, distortion, unwrap


def sheet(columns=30, rows=20):
    """(u, v) of a grid of 2 x 3 mm cells, faces; bent by whoever calls."""
    v, u = np.divmod(np.arange((rows + 1) * (columns + 1)), columns + 1)
    cell = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    quads = np.stack([cell, cell + 1, cell + columns + 2, cell + columns + 1], axis=1)
    return 2.0 * u, 3.0 * v, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def scalp_only(vertices, faces):
    return HeadMesh(vertices, faces, np.ones(len(vertices), bool), np.full((len(vertices), 2), np.nan), name="sheet")


def test_a_piece_of_a_cylinder_is_laid_flat_without_distortion():
    u, v, faces = sheet()
    radius = 25.0
    bent = np.stack([radius * np.sin(u / radius), v, radius * np.cos(u / radius)], axis=1)
    flat = unwrap(scalp_only(bent, faces))
    found = distortion(flat)
    # chords instead of arcs, all alike: the mesh itself is developable
    assert found.flipped == 0 and found.area_worst < 1e-3 and found.angle < 0.1
    # one scale for u and v, whole into the unit square
    span = np.ptp(flat.uv, axis=0)
    assert span.max() == pytest.approx(0.98, abs=1e-3) and flat.uv.min() >= 0.0
    assert sorted(span / span.max()) == pytest.approx(sorted(np.array([60.0, 60.0]) / 60.0), rel=0.01)


def test_distortion_reads_a_known_stretch():
    u, v, faces = sheet()
    mesh = scalp_only(np.stack([u, v, 0 * u], axis=1), faces)
    uv = np.stack([u, v], axis=1) / 100.0
    assert distortion(replace(mesh, uv=uv)).angle == pytest.approx(0.0, abs=1e-2)
    assert distortion(replace(mesh, uv=uv[:, ::-1])).flipped == 0  # either handedness as a whole
    stretched = distortion(replace(mesh, uv=uv * [2.0, 1.0]))
    assert stretched.angle == pytest.approx(np.degrees(np.arcsin(1.0 / 3.0)), abs=0.01)
    assert stretched.area == pytest.approx(0.0, abs=1e-4)  # one area scale for all is none
    turned = uv.copy()
    turned[0] = uv[35]  # a corner folded over
    assert distortion(replace(mesh, uv=turned)).flipped > 0


def test_a_half_ball_is_laid_flat_round_and_one_to_one(ball):
    flat = unwrap(ball)
    found = distortion(flat)
    assert found.flipped == 0 and found.area < 0.25 and found.angle < 12.0
    rim = flat.scalp & (np.abs(ball.vertices[:, 2]) < 1e-3)
    radius = np.linalg.norm(flat.uv[rim] - 0.5, axis=1)
    assert np.ptp(radius) < 0.02 and radius.mean() == pytest.approx(0.49, abs=0.01)
    # v to the front (-y), u to the wearer's right (-x), not mirrored
    for axis, direction in ((1, [0, -1, 0]), (0, [-1, 0, 0])):
        far = flat.scalp & (ball.vertices @ direction > 70.0)
        assert flat.uv[far, axis].min() > 0.8
    assert np.isnan(flat.uv[~flat.scalp]).all()


def test_a_hole_in_the_scalp_is_bridged(ball):
    middle = ball.vertices[ball.faces].mean(axis=1)
    holed = replace(ball, faces=ball.faces[np.linalg.norm(middle - [0, 40, 69], axis=1) > 12.0])
    found = distortion(unwrap(holed))
    assert found.flipped == 0 and found.area < 0.25


def test_of_several_pieces_the_largest_is_kept_and_said(ball):
    scalp = (ball.vertices[:, 2] > -20.0) & (np.abs(ball.vertices[:, 2] - 10.0) > 7.0)
    flat = unwrap(replace(ball, scalp=scalp))
    assert any("several pieces; the largest is used" in text for text in flat.warnings)
    assert not flat.scalp[np.abs(ball.vertices[:, 2]) < 3].any() and flat.scalp[ball.vertices[:, 2] > 20].all()


def test_what_can_not_be_laid_flat_is_refused(ball):
    with pytest.raises(HeadError, match="the scalp is closed on itself; it must be a patch"):
        unwrap(replace(ball, scalp=np.ones(len(ball.vertices), bool)))
    faces = sheet()[2]
    with pytest.raises(HeadError, match="the scalp has no area"):
        unwrap(scalp_only(np.zeros((faces.max() + 1, 3)), faces))
    # a torus with a piece out of it has a handle
    columns, rows = 30, 20
    a, b = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    index = lambda i, j: (i % columns) * rows + j % rows  # noqa: E731
    quads = np.stack([index(a, b), index(a + 1, b), index(a + 1, b + 1), index(a, b + 1)], axis=-1).reshape(-1, 4)[3:]
    turn, tube = 2 * np.pi * a / columns, 2 * np.pi * b / rows
    across = 30 + 10 * np.cos(tube)
    torus = np.stack([across * np.cos(turn), across * np.sin(turn), 10 * np.sin(tube)], axis=-1).reshape(-1, 3)
    with pytest.raises(HeadError, match=r"has a handle.*mark a simple cap"):
        unwrap(scalp_only(torus, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])))
