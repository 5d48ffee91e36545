"""The matrices between scan, head and scene."""

import numpy as np
import pytest

from ct2hair_addon.scene import frames

from .conftest import SCALE, head_to_scan


def test_scene_from_scan_undoes_the_registration_at_true_size():
    place = head_to_scan()
    head = np.array([[10.0, -100.0, 40.0], [0.0, 0.0, 0.0]])
    scan = head * SCALE @ (place[:3, :3] / SCALE).T + place[:3, 3]
    scene = scan @ frames.scene_from_scan(place)[:3, :3].T + frames.scene_from_scan(place)[:3, 3]
    np.testing.assert_allclose(scene, head * SCALE / 1000, atol=1e-12)


def test_rigid_leaves_the_scale_out():
    out = frames.rigid(head_to_scan())
    np.testing.assert_allclose(out[:3, :3] @ out[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(out[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("matrix", [np.diag([1, 1, -1, 1.0]), np.diag([1, 2, 1, 1.0]), np.full((4, 4), np.nan)])
def test_rigid_refuses_what_is_no_placement(matrix):
    with pytest.raises(ValueError, match="rotation"):
        frames.rigid(matrix)


def test_an_unregistered_scan_stands_on_the_ground():
    matrix = frames.scene_from_unregistered_scan([100, 200, 300], [300, 600, 400])
    np.testing.assert_allclose(matrix @ [200, 400, 300, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(matrix @ [200, 400, 400, 1], [0, 0, 0.1, 1], atol=1e-12)
