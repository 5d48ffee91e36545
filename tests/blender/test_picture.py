"""The Cycles picture, and that the scene is as before."""

import bpy
import numpy as np
import pytest

from ct2hair_addon import scene
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.scene.picture import LENS, _add_camera, _axes

from .conftest import block_counts


def test_head_and_hair_are_in_the_picture_and_the_scene_is_as_before(job_folder, tmp_path):
    result = scene.load_result(job_folder, colour="platinum")
    before = block_counts()
    path = scene.render_picture(result, tmp_path / "render.png", view="front", samples=4, size=64)
    assert block_counts() == before
    assert [p.name for p in tmp_path.glob("*.png")] == ["render.png"]
    image = bpy.data.images.load(str(path))
    pixels = np.array(image.pixels[:]).reshape(64, 64, 4)[..., :3]
    border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
    assert np.ptp(border.mean(axis=1)) < 0.35  # nothing but the backdrop at the edge
    middle = pixels[20:44, 20:44].mean()
    assert middle > 0.15 and pixels.std() > 0.03
    with pytest.raises(CT2HairError, match="view 'below'"):
        scene.render_picture(result, path, view="below")


@pytest.mark.parametrize(("around", "elevation"), [(0, 0), (-35, 10), (180, 40)])
def test_the_camera_just_holds_all_points(around, elevation):
    points = np.random.default_rng(0).normal(size=(500, 3)) * [0.1, 0.12, 0.2] + [0.3, -0.2, 1.6]
    made = bpy.data.scenes.new("Studio")
    camera, _ = _add_camera(made, points, _axes(around, elevation))
    matrix = np.linalg.inv(np.array(camera.matrix_basis if camera.parent is None else camera.matrix_world))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    assert (seen[:, 2] < 0).all()
    reach = np.abs(seen[:, :2] / -seen[:, 2:]).max(axis=0) / (18 / LENS)
    assert reach.max() == pytest.approx(0.9, abs=1e-4)
