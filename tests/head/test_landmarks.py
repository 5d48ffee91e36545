"""Landmarks of a scalp, and the pose that they give."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import fit_landmarks, scalp_landmarks, template_head
from ct2hair_addon.head.landmarks import LANDMARKS


@pytest.fixture(scope="module")
def template():
    return template_head()


def test_the_template_has_its_landmarks_where_they_belong(template):
    found = scalp_landmarks(template)
    assert tuple(found) == LANDMARKS
    scalp = template.vertices[template.scalp]
    assert found["crown"][2] == pytest.approx(scalp[:, 2].max(), abs=1.0)
    assert found["forehead"][1] < found["crown"][1] < found["nape"][1]
    assert found["nape"][2] < found["forehead"][2]
    assert found["left side"][0] > 40.0 and found["right side"][0] < -40.0
    np.testing.assert_allclose(found["left side"] * [-1, 1, 1], found["right side"], atol=3.0)


def test_a_scalp_that_is_no_cap_is_refused(template):
    vertices = template.vertices.copy()
    vertices[:, 1] = 0.0  # no front and no back
    with pytest.raises(HeadError, match="must look to -y"):
        scalp_landmarks(template.with_vertices(vertices))


@pytest.mark.parametrize("seed", range(3))
def test_a_similarity_is_found_again(seed):
    rng = np.random.default_rng(seed)
    own = rng.normal(size=(5, 3)) * 80.0
    turn, scale, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(0.7, 1.4), rng.normal(size=3) * 100.0
    matrix, left = fit_landmarks(own, scale * own @ turn.T + shift)
    np.testing.assert_allclose(matrix[:3, :3], scale * turn, atol=1e-9)
    np.testing.assert_allclose(matrix[:3, 3], shift, atol=1e-7)
    assert left < 1e-8


def test_the_rest_is_what_no_similarity_explains():
    own = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    off = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, -1]])  # a saddle: nothing that turning or scaling gives
    matrix, left = fit_landmarks(own, own + off)
    np.testing.assert_allclose(matrix, np.eye(4), atol=1e-9)
    assert left == pytest.approx(1.0)


def test_too_few_landmarks_or_a_line_are_refused():
    with pytest.raises(HeadError, match="at least 3"):
        fit_landmarks(np.eye(3)[:2], np.eye(3)[:2])
    line = np.outer(np.arange(4.0), [1.0, 2.0, 3.0])
    with pytest.raises(HeadError, match="on one line"):
        fit_landmarks(line, line)
