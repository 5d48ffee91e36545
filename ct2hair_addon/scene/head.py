"""The head in the scene: a mesh with its scalp marked, from a HeadMesh and back (frames: see `frames`)."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ..errors import HeadError
from ..head import HeadMesh, unwrap
from .attributes import read_attribute
from .frames import MM
from .materials import skin_material
from .staging import NewData

SCALP_GROUP = "scalp"
"""Vertex group of the vertices where hair grows, weight over `SCALP_WEIGHT`; of the user's own heads as well."""
SCALP_UV = "scalp_uv"
"""UV layer of the scalp: one island without overlap; `surface_uv_coordinate` of the hair points into it."""
SCALP_WEIGHT = 0.5
OFF_SCALP_UV = (-1.0, -1.0)
"""Texture coordinate of every corner off the scalp: of no area, so that no root is ever looked up there."""


def new_head(new: NewData, name: str, head: HeadMesh) -> bpy.types.Object:
    """A mesh object of `head` (mm, head frame), in metres, not linked yet.

    It has the vertex group 'scalp', the UV layer 'scalp_uv', smooth shading, a skin material, and the rest position that
    hair attached to it needs.
    """
    offsets, corners = _polygons(head)
    mesh = new.add(bpy.data.meshes.new(name))
    mesh.vertices.add(len(head.vertices))
    mesh.vertices.foreach_set("co", (head.vertices * np.float32(MM)).ravel())
    mesh.loops.add(len(corners))
    mesh.loops.foreach_set("vertex_index", corners)
    mesh.polygons.add(len(offsets) - 1)
    mesh.polygons.foreach_set("loop_start", offsets[:-1])
    mesh.update(calc_edges=True)
    mesh.shade_smooth()

    layer = mesh.uv_layers.new(name=SCALP_UV, do_init=False)
    layer.uv.foreach_set("vector", _corner_uvs(head, offsets, corners).ravel())

    material = skin_material(new, f"{name} Skin")
    mesh.materials.append(material)

    ob = new.add(bpy.data.objects.new(name, mesh))
    group = ob.vertex_groups.new(name=SCALP_GROUP)
    group.add(np.flatnonzero(head.scalp).tolist(), 1.0, "REPLACE")
    ob.add_rest_position_attribute = True
    return ob


def head_mesh(ob: bpy.types.Object, evaluated: bool = False) -> HeadMesh:
    """The HeadMesh (mm, in the object's own frame: head frame where it came from `new_head`) of a mesh object.

    The scalp is the vertex group 'scalp'. The UV layer is 'scalp_uv', or the active one; without any, uv is NaN.
    evaluated: with modifiers and shape keys applied, as the scene shows it. Raises HeadError where there is no such mesh.
    """
    if ob is None or ob.type != "MESH":
        raise HeadError(f"'{ob.name if ob else None}' is not a mesh; choose the head's mesh object")
    group = next((group for group in ob.vertex_groups if group.name.lower() == SCALP_GROUP), None)
    if group is None:
        raise HeadError(
            f"'{ob.name}' has no vertex group '{SCALP_GROUP}'; select the vertices where hair grows and assign them to one"
        )
    source = ob.evaluated_get(bpy.context.evaluated_depsgraph_get()) if evaluated else ob
    mesh = source.to_mesh() if evaluated else ob.data
    try:
        return _head_mesh(ob.name, mesh, group.index)
    finally:
        if evaluated:
            source.to_mesh_clear()


def save_head(ob: bpy.types.Object, path: str | Path, local: bool = False) -> Path:
    """Write the user's head object, as the scene shows it, to an OBJ that the engine takes as its template (`head.mesh`).

    The head must stand as the head frame wants it: real size, upright, face to -y; with `local` as it is before the object
    was moved, for a head that `placement` says the place of. Raises HeadError as `head_mesh` does.
    """
    world = np.eye(4) if local else np.array(ob.matrix_world)
    shown = np.diag([1 / MM, 1 / MM, 1 / MM, 1.0]) @ world @ np.diag([MM, MM, MM, 1.0])
    mesh = head_mesh(ob, evaluated=True).transformed(shown)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.save(path)
    return path


def add_scalp_uv(ob: bpy.types.Object) -> None:
    """Flatten the scalp of the user's head object into a new UV layer 'scalp_uv', which hair is attached by.

    A layer of that name is kept. Raises HeadError where there is no scalp or it can't be flattened; the mesh is then untouched.
    """
    if ob.data.uv_layers.get(SCALP_UV) is not None:
        return
    head = unwrap(head_mesh(ob))
    offsets, corners = (np.asarray(array, np.int64) for array in head.polygons)
    layer = ob.data.uv_layers.new(name=SCALP_UV, do_init=False)
    layer.uv.foreach_set("vector", _corner_uvs(head, offsets, corners).ravel())


def attach(ob: bpy.types.Object, head: bpy.types.Object) -> None:
    """Hang `ob`, whose data is in the head's frame, under `head` without moving it in that frame."""
    ob.parent = head
    ob.matrix_parent_inverse.identity()


def _head_mesh(name: str, mesh: bpy.types.Mesh, group: int) -> HeadMesh:
    vertices = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", vertices)
    offsets = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", offsets)
    offsets = np.append(offsets, np.int32(len(mesh.loops)))
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    mesh.calc_loop_triangles()
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    scalp = np.zeros(len(mesh.vertices), bool)
    for vertex in mesh.vertices:  # weights have no bulk access; a head has some ten thousand vertices
        scalp[vertex.index] = any(entry.group == group and entry.weight > SCALP_WEIGHT for entry in vertex.groups)
    if not scalp[faces.reshape(-1, 3)].all(axis=1).any():
        raise HeadError(f"the vertex group '{SCALP_GROUP}' of '{name}' covers no face; assign all vertices where hair grows")
    uv = np.full((len(vertices) // 3, 2), np.nan, np.float32)
    layer = mesh.uv_layers.get(SCALP_UV) or mesh.uv_layers.active
    corner_uv = read_attribute(mesh, layer.name) if layer else None
    if corner_uv is not None:
        on_scalp = np.repeat(np.logical_and.reduceat(scalp[corners], offsets[:-1]), np.diff(offsets))
        uv[corners[on_scalp]] = corner_uv[on_scalp]
    return HeadMesh(vertices.reshape(-1, 3) / np.float32(MM), faces.reshape(-1, 3), scalp, uv, offsets, corners, name=name)


def _polygons(head: HeadMesh) -> tuple[np.ndarray, np.ndarray]:
    """The head's polygons (offsets, corners) such that Blender's triangles on the scalp are the head's own.

    Roots lie on the head's triangles. Blender splits a quad from its first corner, so quads start where theirs were split;
    larger polygons of the scalp, and polygons that only some scalp triangles belong to, come as triangles.
    """
    offsets, corners = (np.array(array, np.int64) for array in head.polygons)
    sizes = np.diff(offsets)
    triangles = sizes - 2
    if triangles.sum() != len(head.faces):  # the triangles are not the polygons' in order: they are all there is to go by
        return np.arange(len(head.faces) + 1, dtype=np.int32) * 3, head.faces.ravel()
    first = np.cumsum(triangles) - triangles
    quads = sizes == 4
    one, two = head.faces[first[quads]], head.faces[first[quads] + 1]
    start = corners[offsets[:-1][quads]][:, None]
    turned = quads.copy()
    turned[quads] = ~((one == start).any(axis=1) & (two == start).any(axis=1))
    rows = offsets[:-1][turned][:, None] + np.arange(4)
    corners[rows] = corners[np.roll(rows, -1, axis=1)]

    wholly = np.logical_and.reduceat(head.scalp[corners], offsets[:-1])
    on_scalp = head.scalp[head.faces].all(axis=1)
    split = np.where(wholly, sizes > 4, np.logical_or.reduceat(on_scalp, first))
    pieces = head.faces[np.repeat(split, triangles)]
    counts = np.concatenate([sizes[~split], np.full(len(pieces), 3)])
    return (
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        np.concatenate([corners[np.repeat(~split, sizes)], pieces.ravel()]).astype(np.int32),
    )


def _corner_uvs(head: HeadMesh, offsets: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(L, 2) float32: uv of each polygon corner; `OFF_SCALP_UV` for polygons that are not wholly on the scalp."""
    usable = head.scalp & np.isfinite(head.uv).all(axis=1)
    on_scalp = np.repeat(np.logical_and.reduceat(usable[corners], offsets[:-1]), np.diff(offsets))
    return np.where(on_scalp[:, None], head.uv[corners], np.float32(OFF_SCALP_UV)).astype(np.float32)
