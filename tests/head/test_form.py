"""The built-in mannequin: closed and even, of an adult's size, its scalp laid flat with little distortion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from ct2hair_addon.head import HeadForm, distortion
from ct2hair_addon.head.form import head_field
from ct2hair_addon.head.mesh import components, edges, face_areas


def test_it_is_one_closed_outward_surface_without_handles(template):
    pairs, count = edges(template.faces)
    assert (count == 2).all()
    assert components(template.faces).max() == 0
    assert len(template.vertices) - len(pairs) + len(template.faces) == 2
    corners = template.vertices.astype(np.float64)[template.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    # head, neck and base: some five litres
    assert 4.5e6 < volume < 6.0e6


def test_its_quads_are_even_and_its_triangles_theirs(template):
    offsets, corners = template.polygons
    assert (np.diff(offsets) == 4).all() and len(template.faces) == 2 * (len(offsets) - 1)
    quads = corners.reshape(-1, 4)
    side = np.linalg.norm(template.vertices[quads] - template.vertices[np.roll(quads, -1, axis=1)], axis=2)
    assert np.quantile(side, 0.01) > 1.8 and np.quantile(side, 0.99) < 4.5
    assert face_areas(template.vertices, template.faces).min() > 0.1
    pair = np.sort(template.faces.reshape(-1, 6), axis=1)
    assert all(set(six) == set(four) for six, four in zip(pair.tolist(), quads.tolist(), strict=True))


def test_it_is_its_own_mirror_image(template):
    distance, partner = cKDTree(template.vertices).query(template.vertices * [-1, 1, 1])
    assert distance.max() < 1e-3
    np.testing.assert_array_equal(template.scalp[partner], template.scalp)


def test_its_vertices_lie_on_the_solid_and_its_normals_point_out(template):
    field = head_field(HeadForm())
    value = field(template.vertices.astype(np.float64))
    assert np.quantile(np.abs(value), 0.99) < 0.05
    out = field(template.vertices + 1.0 * template.normals) - field(template.vertices - 1.0 * template.normals)
    assert np.mean(out > 0) > 0.99


def test_it_has_an_adults_measures(template):
    v, form = template.vertices, HeadForm()
    vault = v[v[:, 2] > 50]
    assert 2 * vault[:, 0].max() == pytest.approx(form.breadth, abs=3)
    assert vault[:, 1].max() - vault[:, 1].min() == pytest.approx(form.length, abs=4)
    assert v[:, 2].max() == pytest.approx(form.crown, abs=2)
    for height in (-110, -125):
        around = ConvexHull(v[np.abs(v[:, 2] - height) < 2.5][:, :2]).area
        assert around == pytest.approx(form.neck, rel=0.03)
    # the nose stands 15 to 30 mm before the brow, in the middle, below the eyes
    brow = v[(np.abs(v[:, 0]) < 6) & (v[:, 2] > 25) & (v[:, 2] < 60), 1].min()
    tip = v[v[:, 1].argmin()]
    assert abs(tip[0]) < 3 and -35 < tip[2] < -5 and 15 < brow - tip[1] < 30
    # ears stand 12 to 30 mm off the head, behind the tragion, 50 to 75 mm high
    ear = v[(np.abs(v[:, 2]) < 45) & (v[:, 0] > form.bitragion / 2 + 8)]
    assert 12 < ear[:, 0].max() - form.bitragion / 2 < 30
    assert 50 < np.ptp(ear[:, 2]) < 75 and ear[:, 1].min() > -15 and ear[:, 1].max() < 50


def test_its_scalp_is_an_adults_and_off_the_face_and_ears(template):
    area = face_areas(template.vertices, template.faces[template.scalp_faces]).sum()
    assert 45_000 < area < 62_000  # 450 to 620 cm^2
    scalp = template.vertices[template.scalp]
    assert scalp[:, 2].max() == template.vertices[:, 2].max()
    assert not ((scalp[:, 1] < -60) & (scalp[:, 2] < 60)).any()
    assert np.abs(scalp[:, 0]).max() < 85
    assert components(template.faces[template.scalp_faces]).max() == 0


def test_its_scalp_texture_fills_the_unit_square_with_little_distortion(template):
    uv = template.uv[template.scalp]
    assert np.isfinite(uv).all() and uv.min() >= 0.0 and uv.max() <= 1.0 and np.ptp(uv, axis=0).max() > 0.95
    assert np.isnan(template.uv[~template.scalp]).all()
    found = distortion(template)
    assert found.flipped == 0
    # as flatten.py says of it
    assert found.area < 0.15 and found.angle < 5.0 and found.area_worst < 0.6
    # v grows to the front, u to the wearer's right
    front, left = template.scalp & (template.vertices[:, 1] < -70), template.scalp & (template.vertices[:, 0] > 60)
    assert template.uv[front, 1].mean() > 0.8 and template.uv[left, 0].mean() < 0.35
