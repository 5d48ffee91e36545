"""Every operator that changes the file can be undone: what the file holds is then as it was before."""

from __future__ import annotations

import json

import bpy
import numpy as np
import pytest

from ct2hair_addon import scene

from .conftest import block_counts

pytestmark = pytest.mark.usefixtures("extension")


def snapshot() -> dict:
    """What operators change: data-blocks, hair, what is shown, materials, modifiers, groups and settings."""
    owner = bpy.context.scene.ct2hair
    seen = {"blocks": block_counts(), "objects": {}, "materials": {}, "settings": {}}
    for ob in sorted(bpy.data.objects, key=lambda ob: ob.name):
        known = [
            np.round(np.array(ob.matrix_world), 5).tolist(),
            ob.hide_get() if ob.name in bpy.context.view_layer.objects else None,
        ]
        known.append([(m.name, m.show_viewport) for m in ob.modifiers])
        known.append([slot.material.name for slot in ob.material_slots if slot.material])
        if ob.type == "CURVES":
            strands = scene.strands_of(ob, evaluated=False)
            shown = ob.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.attributes["radius"].data
            known += [len(strands), float(strands.points.sum(dtype=np.float64)), round(1e6 * shown[0].value, 3)]
        if ob.type == "MESH":
            known += [sum(bool(vertex.groups) for vertex in ob.data.vertices), ob.mode]
        seen["objects"][ob.name] = known
    for material in bpy.data.materials:
        inputs = [node.inputs for node in material.node_tree.nodes if node.name == "Hair"]
        ramp = [node.color_ramp.elements for node in material.node_tree.nodes if node.name == "Colours"]
        seen["materials"][material.name] = [
            [
                round(socket.default_value, 4)
                for sockets in inputs
                for socket in sockets
                if isinstance(socket.default_value, float)
            ],
            [[round(value, 4) for value in element.color] for elements in ramp for element in elements],
        ]
    for stage in owner.settings.bl_rna.properties:
        group = getattr(owner.settings, stage.identifier, None)
        if hasattr(group, "bl_rna") and stage.identifier != "rna_type":
            for name in group.__annotations__:
                seen["settings"][f"{stage.identifier}.{name}"] = getattr(group, name)
    seen["scan"] = owner.scan
    seen["regions"] = [json.dumps(c.get("ct2hair_regions").to_dict()) for c in bpy.data.collections if c.get("ct2hair_regions")]
    return seen


def with_result(folder, **_):
    scene.load_result(folder)


def with_scan(folder, **_):
    bpy.ops.ct2hair.import_scan(filepath=str(folder / "volume.vdb"))


def with_head(folder, **_):
    with_scan(folder)
    bpy.ops.ct2hair.place_head()


def with_landmarks(folder, **_):
    with_head(folder)
    bpy.ops.ct2hair.add_landmarks()
    for ob in scene.landmarks_of(next(ob for ob in bpy.data.objects if ob.type == "MESH")):
        ob.location.x += 0.02


def with_place(folder, **_):
    with_head(folder)
    bpy.ops.ct2hair.use_place()


def with_simulation(folder, **_):
    scene.simulate(scene.load_result(folder), frames=(1, 2))


def with_own_head(folder, **_):
    bpy.ops.ct2hair.add_head()
    mesh = bpy.context.active_object.data
    for vertex in mesh.vertices:
        vertex.select = vertex.index in mesh.polygons[5].vertices


def with_short_timeline(folder, **_):
    with_result(folder)
    bpy.context.scene.frame_end = 2


def with_look(folder, extension, inspection):
    with_scan(folder)
    pictures = extension.operators.look._pictures
    pictures.inspection, pictures.scan = inspection, bpy.context.scene.ct2hair.scan


def with_settings_file(folder, **_):
    (folder / "settings.json").write_text(json.dumps({"guides": {"step": 0.7}}))


def nothing(folder, **_):
    pass


CASES = {
    "import_scan": (nothing, lambda folder: {"filepath": str(folder / "volume.vdb")}),
    "load_result": (nothing, lambda folder: {"directory": str(folder)}),
    "import_hair": (nothing, lambda folder: {"filepath": str(folder / "hair.npz"), "unit": "mm", "on": "fit"}),
    "add_head": (nothing, None),
    "scalp_from_selection": (with_own_head, None),
    "paint_scalp": (with_own_head, None),
    "place_head": (with_scan, None),
    "add_landmarks": (with_head, None),
    "fit_landmarks": (with_landmarks, None),
    "use_place": (with_head, None),
    "forget_place": (with_place, None),
    "thresholds": (with_look, None),
    "settings_load": (with_settings_file, lambda folder: {"filepath": str(folder / "settings.json")}),
    "show": (with_result, lambda folder: {"what": "confidence"}),
    "measure": (with_result, None),
    "trim": (with_result, lambda folder: {"length": 30.0}),
    "regrow": (with_result, lambda folder: {"region": "crown", "seed": 5}),
    "full_width": (with_result, None),
    "density_colours": (with_result, None),
    "hair_colour": (with_result, None),
    "simulate": (with_short_timeline, None),
    "clear_simulation": (with_simulation, None),
}
APART = {"reconstruct", "resume"}
"""What they bring in is `load_result`'s; with their jobs they are tested in test_operators and test_artist."""


def undoable() -> set[str]:
    names = set()
    for name in dir(bpy.ops.ct2hair):
        rna = getattr(bpy.ops.ct2hair, name).get_rna_type()
        cls = bpy.types.Operator.bl_rna_get_subclass_py(f"CT2HAIR_OT_{name}") if rna else None
        if cls is not None and "UNDO" in getattr(cls, "bl_options", ()):
            names.add(name)
    return names


def test_no_operator_is_left_out():
    assert undoable() == set(CASES) | APART


@pytest.mark.parametrize("name", CASES)
def test_it_can_be_undone(name, job_folder, extension, inspection):
    prepare, arguments = CASES[name]
    prepare(job_folder, extension=extension, inspection=inspection)
    owner = bpy.context.scene.ct2hair
    owner.colour, owner.density = "blond", "x_ray"  # other than what is there
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="before")
    before = snapshot()
    assert getattr(bpy.ops.ct2hair, name)(**(arguments(job_folder) if arguments else {})) == {"FINISHED"}
    bpy.context.view_layer.update()
    assert snapshot() != before
    bpy.ops.ed.undo_push(message=name)  # as a window does after an operator
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    assert snapshot() == before
