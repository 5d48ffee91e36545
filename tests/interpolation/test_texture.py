"""The paper's texels and the weights of eq. 3, on a flat scalp and by hand."""

import numpy as np
import pytest

from ct2hair_addon.head import ScalpPoints
from ct2hair_addon.interpolation import fill_scalp
from ct2hair_addon.interpolation.texture import drawn_texels, eq3_weights, texels_of
from ct2hair_addon.settings import InterpolationSettings
from ct2hair_addon.strands import Strands

SIDE = 64
SETTINGS = InterpolationSettings(method="texture", texture=SIDE, nearest=0.6, farthest=6.0, similarity=0.0)


class Flat:
    """A square scalp of 100 mm in the plane z = 0, its texture its right half turned off: u < 0.5 is scalp."""

    def on_scalp(self, uv):
        uv = np.asarray(uv, float)
        there = uv[:, 0] < 0.5
        return self._points(uv, np.where(there, 0, -1).astype(np.int32))

    def closest_scalp(self, points):
        uv = np.asarray(points, float)[:, :2] / 100.0
        return self._points(uv, np.zeros(len(uv), np.int32), np.abs(points[:, 2]))

    def _points(self, uv, face, distance=None):
        position = np.concatenate([100.0 * uv, np.zeros((len(uv), 1))], axis=1).astype(np.float32)
        normal = np.tile(np.float32([0, 0, 1]), (len(uv), 1))
        bary = np.tile(np.float32([1, 0, 0]), (len(uv), 1))
        distance = np.zeros(len(uv), np.float32) if distance is None else distance
        return ScalpPoints(distance, position, normal, face, bary, uv.astype(np.float32))

    def frames(self, face, bary):
        return np.tile(np.eye(3, dtype=np.float32), (len(face), 1, 1))


def guides(*roots, length=30.0):
    lines = [np.array([x, y, 0.0]) + np.linspace(0, length, 16)[:, None] * [0, 0, 1.0] for x, y in roots]
    return Strands.from_polylines([line.astype(np.float32) for line in lines])


def test_texels_lie_on_the_scalp_within_the_two_distances_and_once_each():
    uv = np.array([[0.25, 0.5], [0.26, 0.52]])
    points, tally = drawn_texels(Flat(), uv, 1500, SETTINGS, 3)
    texels = texels_of(points.uv, SIDE)
    assert len(np.unique(texels, axis=0)) == len(texels) > 80
    away = np.linalg.norm(texels[:, None] - texels_of(uv, SIDE)[None], axis=2).min(axis=1)
    assert away.min() >= 1.0 and away.max() <= 6.0 and (points.uv[:, 0] < 0.5).all()
    assert tally["texels drawn"] == 1500
    discarded = sum(count for name, count in tally.items() if "discarded" in name)
    assert discarded + len(points) == 1500
    again, _ = drawn_texels(Flat(), uv, 1500, SETTINGS, 3)
    np.testing.assert_array_equal(again.uv, points.uv)


def test_no_more_texels_are_drawn_than_the_scalp_has():
    _, tally = drawn_texels(Flat(), np.array([[0.25, 0.5]]), 10**6, SETTINGS, 0)
    assert tally["texels drawn"] == SIDE * SIDE // 2


def test_the_weights_of_equation_3_by_hand():
    codes = np.array([[1.0, 0.0], [0.6, 0.8], [-1.0, 0.0]])
    # nearness 1, 1/2, 1/4; likeness to the first 1, 0.6 and none for the one that points away: 1 to 0.3
    weights = eq3_weights(np.array([[1.0, 2.0, 4.0]]), np.array([[0, 1, 2]]), codes)
    np.testing.assert_allclose(weights, [[1.0 / 1.3, 0.3 / 1.3, 0.0]], atol=1e-6)
    nothing = eq3_weights(np.array([[1.0, 2.0]]), np.array([[0, 1]]), np.zeros((2, 3)))
    np.testing.assert_allclose(nothing, [[1.0, 0.0]], atol=1e-6)


def test_new_strands_are_blends_and_every_guide_stays():
    # two kinds of hair side by side: a new strand between them is as long as its weights say, none longer than the longest
    long, short = guides((20, 50), (22, 54), length=40.0), guides((24, 50), length=20.0)
    everyone = Strands.from_polylines([*long.polylines(), *short.polylines()])
    dense = fill_scalp(everyone, Flat(), 1500, SETTINGS, seed=1)
    assert (dense.strands.strand_attributes["guide"][:3]).all() and len(dense.strands) > 60
    lengths = dense.strands.lengths()
    np.testing.assert_allclose(lengths[:3], [40, 40, 20], atol=1e-3)
    assert lengths.min() >= 20 - 1e-3 and lengths.max() <= 40 + 1e-3
    assert np.ptp(lengths[3:]) > 3.0
    assert dense.strands.roots[:, 2] == pytest.approx(0.0, abs=1e-5)
