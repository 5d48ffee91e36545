"""HeadMesh: through a file and back, under transforms, and the small questions about faces and edges."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import HeadMesh, load_obj
from ct2hair_addon.head.mesh import (
    boundary_loops,
    components,
    edges,
    face_areas,
    face_normals,
    largest_component,
    vertex_normals,
)


def signed_volume(mesh) -> float:
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def test_a_head_comes_back_from_its_file_bit_for_bit(template, tmp_path):
    turned = template.transformed(np.array([[0, -1.03, 0, 211.7], [1.03, 0, 0, -3.1], [0, 0, 1.03, 55.5], [0, 0, 0, 1]]))
    turned.save(tmp_path / "head.obj")
    back = load_obj(tmp_path / "head.obj")
    np.testing.assert_array_equal(back.vertices, turned.vertices)
    np.testing.assert_array_equal(back.scalp, turned.scalp)
    np.testing.assert_array_equal(back.uv[back.scalp], turned.uv[turned.scalp])
    # the scalp's faces come first in the file: the same triangles in another order
    as_set = lambda faces: sorted(map(tuple, np.sort(faces, axis=1).tolist()))  # noqa: E731
    assert as_set(back.faces) == as_set(turned.faces)
    assert len(back.polygons[0]) == len(turned.polygons[0])
    assert signed_volume(back) == pytest.approx(signed_volume(turned), rel=1e-9)
    assert not back.warnings and [file.name for file in tmp_path.iterdir()] == ["head.obj"]


def test_a_mirror_keeps_the_faces_outward(template):
    mirrored = template.transformed(np.diag([-1.0, 1, 1, 1]))
    assert signed_volume(mirrored) == pytest.approx(signed_volume(template), rel=1e-6)
    flipped = template.flipped()
    assert signed_volume(flipped) == pytest.approx(-signed_volume(template), rel=1e-6)
    np.testing.assert_allclose(flipped.normals, -template.normals, atol=1e-6)
    offsets, corners = flipped.polygons
    first = corners[offsets[0] : offsets[1]]
    assert set(first) == set(template.polygons[1][:4])


def test_normals_of_a_ball_point_from_its_middle(ball):
    outward = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    assert ((vertex_normals(ball.vertices, ball.faces) * outward).sum(axis=1) > 0.999).all()
    assert ((face_normals(ball.vertices, ball.faces) * ball.vertices[ball.faces].mean(axis=1)).sum(axis=1) > 0).all()
    assert face_areas(ball.vertices, ball.faces).sum() == pytest.approx(4 * np.pi * 80.0**2, rel=0.01)


def square(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of rows x rows cells, and its faces."""
    y, x = np.divmod(np.arange((rows + 1) ** 2), rows + 1)
    cell = (np.arange(rows)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    quads = np.stack([cell, cell + 1, cell + rows + 2, cell + rows + 1], axis=1)
    return np.stack([x, y, 0 * x], axis=1).astype(float), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def test_edges_and_the_boundary_of_a_square_with_a_hole():
    _, faces = square(6)
    pairs, count = edges(faces)
    assert len(pairs) == 6 * 7 * 2 + 36 and np.count_nonzero(count == 1) == 24
    around = boundary_loops(faces)
    assert len(around) == 1 and len(around[0]) == 24
    middle = [14, 14 + 36]
    holed = np.delete(faces, middle, axis=0)
    assert sorted(len(loop) for loop in boundary_loops(holed)) == [4, 24]
    # along the direction of the faces' edges
    directed = {(a, b) for face in holed.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True)}
    for loop in boundary_loops(holed):
        assert all((a, b) in directed for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))


def test_pieces_are_told_apart_and_the_largest_kept(ball):
    _, faces = square(4)
    both = np.concatenate([faces, ball.faces + 25])
    assert np.bincount(components(both)).tolist() == [32, len(ball.faces)]
    kept = largest_component(both, np.concatenate([np.full(32, 1000.0), np.ones(len(ball.faces))]))
    assert kept[:32].all() and not kept[32:].any()
    # two squares that touch in one corner hang together over no edge
    assert components(np.array([[0, 1, 2], [2, 3, 4]])).max() == 1


def test_what_does_not_fit_together_is_refused(ball):
    with pytest.raises(ValueError, match="one row for each"):
        HeadMesh(ball.vertices, ball.faces, ball.scalp[:-1], ball.uv)
    with pytest.raises(ValueError, match="faces must name the vertices"):
        HeadMesh(ball.vertices, ball.faces + 1, ball.scalp, ball.uv)


def test_a_head_that_is_no_head_is_refused(tmp_path):
    def given(text):
        (tmp_path / "head.obj").write_text(text)
        return tmp_path / "head.obj"

    with pytest.raises(HeadError, match=r"absent\.obj: there is no such file"):
        load_obj(tmp_path / "absent.obj")
    with pytest.raises(HeadError, match=r"head\.obj: the file holds no faces"):
        load_obj(given("v 0 0 0\n"))
    with pytest.raises(HeadError, match=r"head\.obj: not a readable OBJ file \(line 2: a face names vertex 7, there are 1"):
        load_obj(given("v 0 0 0\nf 1 2 7\n".replace("2 7", "7 7")))
    with pytest.raises(HeadError, match=r"head\.obj: the mesh has no scalp.*g scalp.*head\.scalp\.json"):
        load_obj(given("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"))
    with pytest.raises(HeadError, match="no head's in millimetres"):
        load_obj(given("v 0 0 0\nv 1 0 0\nv 0 1 0\ng scalp\nf 1 2 3\n"))
