"""Registration: a head at a known place in the scan is found from its knots, through noise, junk and a wrong guess."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import Head, fit_to_roots, register_head
from ct2hair_addon.head.registration import axis_rotation, orientations
from ct2hair_addon.settings import HeadSettings
from ct2hair_addon.volume import BrickVolume

EMPTY = BrickVolume(np.full((1, 1, 1), -1, np.int32), np.zeros((0, 16, 16, 16), np.float32), 0.8, np.zeros(3))


def placed(face: str, up: str, scale: float, lean: float) -> np.ndarray:
    """(4, 4): head frame -> scan, the head leaning by some degrees about a skew axis."""
    axis = np.array([0.5, -0.3, 0.8])
    axis /= np.linalg.norm(axis)
    a = np.radians(lean)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross
    matrix = np.eye(4)
    matrix[:3, :3] = scale * axis_rotation(face, up) @ turn
    matrix[:3, 3] = 140.0, 95.0, -60.0
    return matrix


def scanned(head: Head, matrix, count=1800, noise=0.4, junk=0.3, seed=0):
    """(knots, mannequin points) of a template placed in the scan: noise on the knots, and a share of junk in the hair."""
    generator = np.random.default_rng(seed)
    sample = head.sample_scalp(count, seed)
    knots = sample.position + generator.normal(0, noise, sample.position.shape)
    loose = head.sample_scalp(int(count * junk / (1 - junk)), seed + 1)
    loose = loose.position + loose.normal * generator.uniform(6.0, 90.0, (len(loose), 1)) + [0, 15, -10]
    skin = head.mesh.vertices[~head.mesh.scalp & (head.mesh.vertices[:, 2] > -120)]
    skin = skin[generator.permutation(len(skin))[:3000]]
    into = lambda points: points @ matrix[:3, :3].T + matrix[:3, 3]  # noqa: E731
    return into(np.concatenate([knots, loose])).astype(np.float32), into(skin).astype(np.float32)


def off(found, template, matrix) -> np.ndarray:
    """(V,) mm: how far each scalp vertex of the fitted head is from where it is in truth."""
    truth = template.vertices[template.scalp] @ matrix[:3, :3].T + matrix[:3, 3]
    return np.linalg.norm(found.head.vertices[template.scalp] - truth, axis=1)


@pytest.mark.parametrize(
    ("face", "up", "scale", "lean"), [("-y", "+z", 1.0, 0.0), ("+x", "-y", 1.06, 8.0), ("+z", "+x", 0.94, 12.0)]
)
def test_a_known_place_is_found_in_any_orientation_through_noise_and_junk(face, up, scale, lean, template, template_queries):
    matrix = placed(face, up, scale, lean)
    knots, solid = scanned(template_queries, matrix)
    found = register_head(template, knots, solid, EMPTY, 50.0, HeadSettings())
    assert (found.face_axis, found.up_axis) == (face, up) and found.certainty > 0.5 and not found.warnings
    assert np.median(off(found, template, matrix)) < 1.5
    # across the surface, which strands are rooted on, less still
    truth = Head(template.transformed(matrix))
    fitted = found.head.vertices[template.scalp]
    assert np.median(np.abs(truth.signed_distance(fitted))) < 0.4
    assert np.cbrt(np.linalg.det(found.matrix[:3, :3])) == pytest.approx(scale, rel=0.02)
    assert found.residual_mm < 0.6
    tally = found.tally
    assert tally["knot and net points"] == len(knots) and tally["mannequin surface points"] == len(solid)
    assert tally["used: on the fitted scalp"] > 0.6 * tally["kept after thinning"]


def test_given_axes_are_respected_even_where_they_are_wrong(template, template_queries):
    knots, solid = scanned(template_queries, placed("-y", "+z", 1.0, 0.0), 800)
    found = register_head(template, knots, solid, EMPTY, 50.0, HeadSettings(face="+y", up="+z"))
    assert (found.face_axis, found.up_axis, found.certainty) == ("+y", "+z", 1.0)
    # still facing the wrong way round: the fit turns a head a little, not about
    assert found.matrix[:3, :3][1, 1] < 0


def test_orientations_are_24_and_those_that_agree_with_what_is_given():
    assert len(orientations()) == len(set(orientations())) == 24
    assert orientations("-y", "+z") == [("-y", "+z")]
    assert sorted(up for _, up in orientations("+x")) == ["+y", "+z", "-y", "-z"]
    for face, up in orientations():
        turn = axis_rotation(face, up)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3))
        assert np.linalg.det(turn) == pytest.approx(1.0)
        sign = {"+": 1.0, "-": -1.0}
        assert turn[:, 1]["xyz".index(face[1])] == -sign[face[0]] and turn[:, 2]["xyz".index(up[1])] == sign[up[0]]


@pytest.mark.parametrize("up", ["+y", "-y"])
def test_axes_that_can_not_be_are_refused(up, template, template_queries):
    knots, solid = scanned(template_queries, placed("-y", "+z", 1.0, 0.0), 400)
    with pytest.raises(HeadError, match=rf"the face \(-y\) and up \({'[+]' if up[0] == '+' else '-'}y\) axes must be at right"):
        register_head(template, knots, solid, EMPTY, 50.0, HeadSettings(face="-y", up=up))


def test_too_few_points_and_points_on_no_head_are_refused(template, template_queries):
    knots, solid = scanned(template_queries, placed("-y", "+z", 1.0, 0.0), 400)
    with pytest.raises(HeadError, match=r"only 150 points .*at least 200 are needed.*Set scan\.knots lower"):
        register_head(template, knots[:150], solid, EMPTY, 50.0, HeadSettings())
    broken = knots.copy()
    broken[150:] = np.nan
    with pytest.raises(HeadError, match="only 150 points"):
        register_head(template, broken, solid, EMPTY, 50.0, HeadSettings())
    wall = np.random.default_rng(1).uniform(-400, 400, (2000, 3)) * [1, 1, 0.01]
    with pytest.raises(HeadError, match="no scalp was found"):
        register_head(template, wall, solid, EMPTY, 50.0, HeadSettings())


def test_a_head_is_bent_onto_anothers_roots(template, template_queries):
    """Another head: a fifth longer than wide against the template, with a flattened back."""
    stretched = template.vertices * [0.95, 1.05, 1.02]
    stretched[:, 1] -= 0.0015 * np.maximum(stretched[:, 1] - 40.0, 0.0) ** 2
    other = Head(template.with_vertices(stretched))
    roots = other.sample_scalp(5000, 3).position
    found = fit_to_roots(template, roots)
    assert np.median(np.abs(other.signed_distance(found.head.vertices[found.head.scalp]))) < 0.3
    fitted = Head(found.head)
    assert np.quantile(fitted.closest_scalp(roots).distance, 0.95) < 1.0
    assert found.face_axis == "-y" and found.up_axis == "+z"
