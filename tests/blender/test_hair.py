"""Hair curves attached to the head: attributes, following shape keys and armatures, and back to Strands."""

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from ct2hair_addon.errors import HeadError, StrandFileError
from ct2hair_addon.scene import NewData, full_width_factor, new_hair, new_head, set_width_factor, strands_of
from ct2hair_addon.scene.attributes import read_attribute
from ct2hair_addon.strands import Strands

from .conftest import strands_on

FOLLOWS = 0.01
"""mm: how far a root may be from where its spot on the scalp has gone."""


def build(dome, strands, **options):
    with NewData() as new:
        head = new_head(new, "Head", dome)
        made = new_hair(new, "Hair", strands, head, **options)
    for ob in (head, made.object):
        bpy.context.scene.collection.objects.link(ob)
    return head, made


def test_strands_come_back_with_their_attributes(dome):
    strands, *_ = strands_on(dome, 50)
    backed = np.random.default_rng(5).random(len(strands.points)).astype(np.float32)
    strands = Strands(strands.points, strands.offsets, strands.strand_attributes, {"support": backed})  # a name used twice
    _, made = build(dome, strands, group_id=4)
    back = strands_of(made.object)
    np.testing.assert_array_equal(back.point_attributes["support"], backed)
    np.testing.assert_allclose(back.points, strands.points, atol=2e-5)
    np.testing.assert_array_equal(back.offsets, strands.offsets)
    np.testing.assert_array_equal(back.strand_attributes["root_uv"], strands.strand_attributes["root_uv"])
    np.testing.assert_array_equal(back.strand_attributes["support"], strands.strand_attributes["support"])
    assert (back.strand_attributes["group_id"] == 4).all()
    at_rest = strands_of(made.object, evaluated=True)
    np.testing.assert_allclose(at_rest.points, strands.points, atol=1e-3)


def test_radii_are_of_real_hair_and_thin_to_the_tip(dome):
    strands, *_ = strands_on(dome, 500, points=32)
    _, made = build(dome, strands)
    diameter = 2000 * read_attribute(made.object.data, "radius").reshape(500, 32)
    assert diameter[:, 0].min() >= 0.0399 and diameter[:, 0].max() <= 0.1201
    assert diameter[:, 0].mean() == pytest.approx(0.075, abs=0.003)
    assert (diameter[:, 20] == diameter[:, 0]).all()
    np.testing.assert_allclose(diameter[:, -1], 0.35 * diameter[:, 0], rtol=1e-5)
    assert (np.diff(diameter, axis=1) <= 1e-9).all()


def test_what_cannot_be_shown_is_dropped_and_counted(dome):
    line = np.array([[0, 0, 90.0], [0, 0, 100]])
    broken = np.array([[0, 0, 90.0], [0, np.nan, 100]])
    strands = Strands.from_polylines([line, line[:1], broken, line], root_uv=np.full((4, 2), 0.5, np.float32))
    _, made = build(dome, strands)
    assert len(made.object.data.curves) == 2
    assert made.tally["dropped: fewer than two points"] == 1
    assert made.tally["dropped: a point that is not finite"] == 1
    with pytest.raises(StrandFileError, match="no strand"):
        build(dome, strands.select(np.array([1])))


def test_roots_without_texture_coordinates_get_the_nearest(dome):
    strands, *_ = strands_on(dome, 40)
    bare = Strands(strands.points, strands.offsets)
    _, made = build(dome, bare)
    found = strands_of(made.object).strand_attributes["root_uv"]
    np.testing.assert_allclose(found, strands.strand_attributes["root_uv"], atol=1e-3)
    assert made.tally["root placed by the closest point of the scalp"] == 40


def test_hair_follows_a_shape_key(dome):
    strands, face, bary = strands_on(dome, 400)
    head, made = build(dome, strands)
    head.shape_key_add(name="Basis")
    key = head.shape_key_add(name="Twist")
    moved = dome.vertices / 1000
    moved = moved + 0.02 * np.stack([np.sin(20 * moved[:, 2]), 2 * moved[:, 0], np.cos(15 * moved[:, 1])], axis=1)
    key.data.foreach_set("co", moved.astype(np.float32).ravel())
    key.value = 1.0
    bpy.context.view_layer.update()
    wanted = 1000 * np.einsum("nc,ncx->nx", bary, moved[dome.faces[face]])
    roots = strands_of(made.object, evaluated=True).roots
    assert np.linalg.norm(wanted - strands.roots, axis=1).min() > 1.0
    assert np.linalg.norm(roots - wanted, axis=1).max() < FOLLOWS
    assert np.abs(strands_of(made.object, evaluated=True).lengths() - strands.lengths()).max() < 0.5


def test_hair_follows_an_armature(dome):
    strands, face, bary = strands_on(dome, 400)
    head, made = build(dome, strands)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    bone = armature.data.edit_bones.new("Head")
    bone.head, bone.tail = (0, 0, -0.1), (0, 0, 0.1)
    bpy.ops.object.mode_set(mode="OBJECT")
    head.vertex_groups.new(name="Head").add(list(range(len(dome.vertices))), 1.0, "REPLACE")
    head.modifiers.new("Armature", "ARMATURE").object = armature
    pose = armature.pose.bones["Head"]
    pose.rotation_mode = "XYZ"
    pose.rotation_euler = (0.5, 0.3, -0.4)
    pose.location = (0.01, 0.05, -0.02)
    bpy.context.view_layer.update()
    posed = np.empty(len(dome.vertices) * 3, np.float32)
    head.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.vertices.foreach_get("co", posed)
    wanted = 1000 * np.einsum("nc,ncx->nx", bary, posed.reshape(-1, 3)[dome.faces[face]])
    following = strands_of(made.object, evaluated=True)
    assert np.linalg.norm(wanted - strands.roots, axis=1).min() > 1.0
    assert np.linalg.norm(following.roots - wanted, axis=1).max() < FOLLOWS
    # the whole head turned as one: so did every strand, tips included
    turn = np.array(armature.matrix_world @ pose.matrix @ pose.bone.matrix_local.inverted())
    tips = (strands.tips / 1000) @ turn[:3, :3].T + turn[:3, 3]
    assert np.linalg.norm(following.tips - 1000 * tips, axis=1).max() < FOLLOWS


def test_moving_the_head_object_moves_the_hair(dome):
    strands, *_ = strands_on(dome, 10)
    head, made = build(dome, strands)
    head.matrix_world = Matrix.Translation((0, 0, 1.6))
    bpy.context.view_layer.update()
    assert made.object.matrix_world.translation.z == pytest.approx(1.6)
    np.testing.assert_allclose(strands_of(made.object, evaluated=True).points, strands.points, atol=1e-3)


def test_hair_can_be_shown_wider_than_it_is(dome):
    strands, *_ = strands_on(dome, 100)
    _, made = build(dome, strands)
    true = read_attribute(made.object.data, "radius")
    assert full_width_factor(made.object) == 4.0
    set_width_factor(made.object, 2.5)
    bpy.context.view_layer.update()
    shown = strands_of(made.object, evaluated=True).point_attributes["radius"]
    np.testing.assert_allclose(shown, 2.5 * true, rtol=1e-5)
    np.testing.assert_array_equal(read_attribute(made.object.data, "radius"), true)


def test_hair_needs_a_scalp_texture(dome):
    strands, *_ = strands_on(dome, 5)
    with pytest.raises(HeadError, match="scalp_uv"), NewData() as new:
        head = new_head(new, "Head", dome)
        head.data.uv_layers.remove(head.data.uv_layers[0])
        new_hair(new, "Hair", strands, head)


def test_only_hair_curves_are_read():
    with pytest.raises(StrandFileError, match="not a hair curves object"):
        strands_of(bpy.data.objects.new("Empty", None))
