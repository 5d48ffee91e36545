"""The head as a mesh object, and back."""

import bpy
import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import load_obj
from ct2hair_addon.scene import NewData, add_scalp_uv, head_mesh, new_head, save_head

from .conftest import block_counts


@pytest.fixture
def head_object(dome):
    with NewData() as new:
        ob = new_head(new, "Head", dome)
    bpy.context.scene.collection.objects.link(ob)
    return ob


def test_the_mesh_is_in_metres_with_its_polygons_smooth_and_textured(head_object, dome):
    mesh = head_object.data
    assert len(mesh.polygons) == len(dome.polygons[0]) - 1
    assert max(vertex.co.length for vertex in mesh.vertices) == pytest.approx(0.09, abs=1e-6)
    assert all(polygon.use_smooth for polygon in mesh.polygons)
    assert not mesh.validate()
    assert head_object.add_rest_position_attribute
    assert [layer.name for layer in mesh.uv_layers] == ["scalp_uv"]


def test_normals_point_outward(head_object):
    for polygon in head_object.data.polygons:
        assert polygon.normal.dot(polygon.center) > 0


def test_blender_splits_the_scalp_as_the_head_does(head_object, dome):
    mesh = head_object.data
    mesh.calc_loop_triangles()
    ours = {tuple(sorted(face)) for face in dome.faces[dome.scalp_faces].tolist()}
    theirs = {tuple(sorted(triangle.vertices)) for triangle in mesh.loop_triangles}
    assert ours <= theirs


def test_a_head_comes_back_as_it_went(head_object, dome):
    back = head_mesh(head_object)
    np.testing.assert_allclose(back.vertices, dome.vertices, atol=1e-4)
    np.testing.assert_array_equal(back.scalp, dome.scalp)
    whole = np.isfinite(back.uv).all(axis=1)
    np.testing.assert_allclose(back.uv[whole], dome.uv[whole], atol=1e-6)
    assert whole[np.unique(dome.faces[dome.scalp_faces])].all()


def test_off_the_scalp_no_texture_coordinate_has_area(head_object, dome):
    uv = np.empty(len(head_object.data.loops) * 2, np.float32)
    head_object.data.uv_layers["scalp_uv"].uv.foreach_get("vector", uv)
    off = [p for p in head_object.data.polygons if not all(dome.scalp[v] for v in p.vertices)]
    corners = np.concatenate([list(p.loop_indices) for p in off])
    assert (uv.reshape(-1, 2)[corners] == -1).all()


def test_a_posed_head_can_be_read(head_object):
    head_object.shape_key_add(name="Basis")
    key = head_object.shape_key_add(name="Up")
    for point in key.data:
        point.co.z += 0.01
    key.value = 1.0
    lifted = head_mesh(head_object, evaluated=True).vertices - head_mesh(head_object).vertices
    np.testing.assert_allclose(lifted, [[0, 0, 10]] * len(lifted), atol=1e-3)


def test_the_user_is_told_what_a_head_needs(head_object):
    with pytest.raises(HeadError, match="not a mesh"):
        head_mesh(bpy.data.objects.new("Empty", None))
    head_object.vertex_groups.clear()
    with pytest.raises(HeadError, match="vertex group 'scalp'"):
        head_mesh(head_object)
    head_object.vertex_groups.new(name="Scalp")
    with pytest.raises(HeadError, match="covers no face"):
        head_mesh(head_object)


def test_a_users_head_gets_a_scalp_texture_and_goes_to_the_engine(head_object, dome, tmp_path):
    head_object.data.uv_layers.remove(head_object.data.uv_layers["scalp_uv"])
    assert not head_object.data.uv_layers
    add_scalp_uv(head_object)
    uv = head_mesh(head_object).uv[np.unique(dome.faces[dome.scalp_faces])]
    assert uv.min() >= 0 and uv.max() <= 1 and np.ptp(uv, axis=0).min() > 0.5
    head_object.scale = 1.1, 1.1, 1.1
    head_object.location.z = 0.02
    bpy.context.view_layer.update()
    back = load_obj(save_head(head_object, tmp_path / "new" / "head.obj"))
    np.testing.assert_allclose(back.vertices, 1.1 * dome.vertices + [0, 0, 20], atol=1e-3)
    np.testing.assert_array_equal(back.scalp, dome.scalp)


def test_failed_data_is_removed_again(dome):
    before = block_counts()
    with pytest.raises(RuntimeError), NewData() as new:
        new_head(new, "Head", dome)
        raise RuntimeError
    assert block_counts() == before
