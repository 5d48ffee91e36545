"""Heads that a user brings: units, axes, bodies, the ways to mark a scalp, and MakeHuman's mesh as the real thing."""

from __future__ import annotations

import gzip
import json
from itertools import pairwise

import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import Head, distortion, load_obj


def written(path, mesh, scale=1.0, turn=None, mark="g scalp", off="g skin"):
    """An OBJ as some program might write it: quads where the template has quads, the scalp marked by a line."""
    vertices = mesh.vertices.astype(np.float64) @ (np.eye(3) if turn is None else np.asarray(turn)).T / scale
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices.tolist()]
    offsets, corners = mesh.polygons
    polygons = [corners[a:b] for a, b in pairwise(offsets)]
    on = [mesh.scalp[polygon].all() for polygon in polygons]
    for marked, line in ((True, mark), (False, off)):
        lines += [line] if line else []
        lines += ["f " + " ".join(str(v + 1) for v in p) for p, s in zip(polygons, on, strict=True) if s == marked]
    path.write_text("\n".join(lines) + "\n")
    return path


def in_place(found, template):
    """The same vertices (the file's order), the same scalp."""
    assert len(found.vertices) == len(template.vertices)
    np.testing.assert_allclose(found.vertices, template.vertices, atol=2e-3)
    np.testing.assert_array_equal(found.scalp, template.scalp)


Y_UP = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
"""Head frame -> a frame with y up and the face along z, as most programs write."""


@pytest.mark.parametrize(("scale", "unit"), [(1.0, ""), (10.0, "centimetres"), (1000.0, "metres"), (25.4, "inches")])
def test_units_are_told_by_the_scalps_size_and_said(scale, unit, template, tmp_path):
    found = load_obj(written(tmp_path / "head.obj", template, scale))
    in_place(found, template)
    assert [text for text in found.warnings if "units" in text] == (
        [f"head.obj: units taken for {unit}, by the size of the scalp"] if unit else []
    )


def test_axes_are_told_by_the_scalps_shape_and_said(template, tmp_path):
    found = load_obj(written(tmp_path / "head.obj", template, turn=Y_UP))
    in_place(found, template)
    assert any("+y taken for up and +z for the face" in text for text in found.warnings)
    kept = load_obj(tmp_path / "head.obj", align=False)
    np.testing.assert_allclose(kept.vertices, template.vertices @ np.array(Y_UP).T, atol=1e-3)


@pytest.mark.parametrize("mark", ["g Scalp", "o my_scalp", "usemtl SCALP.001", "g head scalp"])
def test_a_group_an_object_or_a_material_marks_the_scalp(mark, template, tmp_path):
    off = mark.split()[0] + " rest"
    found = load_obj(written(tmp_path / "head.obj", template, mark=mark, off=off))
    np.testing.assert_array_equal(found.scalp, template.scalp)
    assert np.isfinite(found.uv[found.scalp]).all()
    head = Head(found)
    assert head.scalp_area == pytest.approx(Head(template).scalp_area, rel=1e-3)


@pytest.mark.parametrize("name", ["head.scalp.json", "head.scalp.json.gz", "scalp_of_mine.json", "argument"])
def test_a_list_of_faces_marks_the_scalp(name, template, tmp_path):
    path = written(tmp_path / "head.obj", template, mark="g a", off="g b")
    offsets, _ = template.polygons
    count = sum(template.scalp[template.polygons[1][a:b]].all() for a, b in pairwise(offsets))
    listed = list(range(count))  # `written` puts the scalp's faces first
    if name != "argument":
        text = json.dumps(listed if name.startswith("head") else {str(n): {} for n in listed}).encode()
        (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    found = load_obj(path, listed if name == "argument" else None)
    np.testing.assert_array_equal(found.scalp, template.scalp)
    with pytest.raises(HeadError, match=r"names face 99999999, the mesh has faces 0 to"):
        load_obj(path, [99999999])


def test_a_mesh_without_a_scalp_is_taken_as_a_plain_solid_where_that_is_asked(template, tmp_path):
    path = written(tmp_path / "head.obj", template, mark="g a", off="g b")
    with pytest.raises(HeadError, match="has no scalp"):
        load_obj(path)
    solid = load_obj(path, need_scalp=False)
    assert len(solid.faces) == len(template.faces) and not solid.scalp.any()


def test_makehumans_mesh_becomes_a_head_in_millimetres(shared_data):
    """As anyone would use it: the file as it comes, with the list of its scalp's faces beside it."""
    found = load_obj(shared_data / "mpfb_head" / "base.obj")
    assert any("decimetres" in text for text in found.warnings)
    assert any("+y taken for up and +z for the face" in text for text in found.warnings)
    assert any("a body; cut" in text for text in found.warnings)
    head = Head(found)
    assert 35_000 < head.scalp_area < 80_000
    scalp, vertices = found.vertices[found.scalp], found.vertices
    assert scalp[:, 2].max() == pytest.approx(vertices[:, 2].max(), abs=1.0)
    assert 300 < np.ptp(vertices[:, 2]) < 335
    # its nose is before the scalp, in the middle; it is as wide left as right
    tip = vertices[vertices[:, 1].argmin()]
    assert abs(tip[0]) < 2.0 and tip[1] < scalp[:, 1].min() and tip[2] < scalp[:, 2].mean()
    assert np.abs(scalp[:, 0]).max() == pytest.approx(-scalp[:, 0].min(), rel=0.02) and 55 < scalp[:, 0].max() < 100
    bend = distortion(head.mesh)
    assert bend.flipped == 0 and bend.area < 0.3 and bend.angle < 10.0
    middle = scalp.mean(axis=0)
    assert head.signed_distance(np.array([middle - [0, 0, 30.0], middle + [0, 0, 200.0]]))[0] < 0
    inside = head.signed_distance(scalp - 8.0 * found.normals[found.scalp])
    assert np.mean(inside < 0) > 0.99


def test_sintels_head_without_a_scalp_is_refused_by_name(shared_data):
    with pytest.raises(HeadError, match=r"head\.obj: the mesh has no scalp"):
        load_obj(shared_data / "sintel" / "head.obj")
