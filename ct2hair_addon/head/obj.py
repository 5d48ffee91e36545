"""Reading a head from an OBJ file: its scalp, its units and axes, cropped to head and neck, without rigging helpers."""

from __future__ import annotations

import gzip
import json
import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import HeadError
from .flatten import unwrap
from .mesh import OWN_FILE, SCALP, HeadMesh, checked, face_areas, face_normals, through_skin

HELPERS = ("helper-", "joint-")
"""Groups of MakeHuman's base mesh that are no skin: they steer clothes and bones."""
UNITS = ((1.0, "millimetres"), (10.0, "centimetres"), (25.4, "inches"), (100.0, "decimetres"), (1000.0, "metres"))
SCALP_EDGE = (150.0, 330.0)
"""Square root of a scalp's area, mm: adults have 210 to 270."""
HEAD_AND_NECK = 330.0
"""A body is cut this far below the crown, mm: head, neck and the tops of the shoulders."""
BODY = 450.0
"""A mesh that reaches farther below the crown than this, mm, is a body."""
TILT = 0.04
"""Least horizontal part of the scalp's mean normal that tells the back of the head; it is 0.2 to 0.4 on heads."""
AXIS = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
"""Axis name -> direction."""


def load_obj(
    path: str | os.PathLike,
    scalp_faces: Iterable[int] | str | os.PathLike | None = None,
    *,
    align: bool = True,
    need_scalp: bool = True,
) -> HeadMesh:
    """A head from an OBJ file, its scalp unwrapped.

    scalp_faces: where the scalp isn't a group, object or material named 'scalp': indices of its polygons in the order of the
        file (from 0), or a JSON file (.json, .json.gz) with a list of them or an object whose keys they are. By default
        `NAME.scalp.json` or the only `scalp*.json` beside the file is taken (with or without .gz).
    align: bring it into the head frame in mm (units and axes are guessed from the scalp, what was assumed is in `.warnings`;
        a body is cropped to head and neck). Files that CT2Hair wrote, and any with `align=False`, keep their coordinates.
    need_scalp: False also takes a mesh without a scalp, as a plain solid, coordinates kept.

    Raises HeadError where the file can't be read, holds no faces or no scalp, or is not of a head's size.
    """
    path = Path(path)
    vertices, corners, offsets, names, own = _parsed(path)
    skin = np.array([not any(name.startswith(HELPERS) for name in group) for group in names], bool)
    marked = np.array([any(_is_scalp(name) for name in group) for group in names], bool)
    if not marked.any():
        listed = _listed(path, scalp_faces, len(names))
        marked[listed] = True
    elif scalp_faces is not None:
        marked[:] = False
        marked[_listed(path, scalp_faces, len(names))] = True
    if not skin[marked].any() and need_scalp:
        raise HeadError(
            f"{path}: the mesh has no scalp. Put the faces where hair grows into a group ('g scalp'), an object or a material "
            f"named 'scalp' (in Blender: a vertex group 'scalp'), or list their numbers in {path.stem}.scalp.json beside it"
        )
    mesh = _mesh(path, vertices, corners, offsets, np.flatnonzero(skin), marked)
    if not need_scalp and not len(mesh.scalp_faces):
        return mesh
    checked(mesh)
    if align and not own:
        mesh = _in_head_frame(mesh)
    known = own and np.isfinite(mesh.uv[mesh.scalp]).all()
    return mesh if known else unwrap(mesh)


def _is_scalp(name: str) -> bool:
    return SCALP in re.split(r"[^a-z]+", name.lower())


def _parsed(path):
    """(V, 3) vertices (+ uv in columns 3, 4), polygons as corners and offsets, each polygon's names, and whether it's ours."""
    vertices, texture, corners, texture_corners, offsets, names = [], [], [], [], [0], []
    groups, thing, material, own = ("",), "", "", False
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, start=1):
                fields = line.split()
                if not fields:
                    continue
                if fields[0] == "v":
                    vertices.append([float(value) for value in fields[1:4]])
                elif fields[0] == "vt":
                    texture.append([float(value) for value in fields[1:3]])
                elif fields[0] == "f":
                    polygon = [corner.split("/") for corner in fields[1:]]
                    if len(polygon) < 3:
                        raise ValueError("a face with fewer than three corners")
                    for corner in polygon:
                        corners.append(_index(corner[0], len(vertices)))
                        has_texture = len(corner) > 1 and corner[1]
                        texture_corners.append(_index(corner[1], len(texture)) if has_texture else -1)
                    offsets.append(len(corners))
                    names.append((*groups, thing, material))
                elif fields[0] == "g":
                    groups = tuple(fields[1:]) or ("",)
                elif fields[0] == "o":
                    thing = " ".join(fields[1:])
                elif fields[0] == "usemtl":
                    material = " ".join(fields[1:])
                elif number == 1 and line.startswith(OWN_FILE):
                    own = True
    except FileNotFoundError:
        raise HeadError(f"{path}: there is no such file; give an OBJ file of a head") from None
    except (OSError, ValueError, IndexError) as error:
        raise HeadError(f"{path}: not a readable OBJ file (line {number if 'number' in locals() else 1}: {error})") from error
    if not names:
        raise HeadError(f"{path}: the file holds no faces; give an OBJ file of a head mesh")
    positions = np.array(vertices, np.float64).reshape(-1, 3)
    uv = np.full((len(positions), 2), np.nan)
    corners, texture_corners = np.array(corners), np.array(texture_corners)
    has = texture_corners >= 0
    if has.any():
        uv[corners[has]] = np.array(texture)[texture_corners[has]]
    return np.concatenate([positions, uv], axis=1), corners, np.array(offsets), names, own


def _index(text, count):
    value = int(text)
    value = value - 1 if value > 0 else count + value
    if not 0 <= value < count:
        raise ValueError(f"a face names vertex {text}, there are {count}")
    return value


def _listed(path, scalp_faces, count):
    """(S,) polygons of the scalp by a list, a JSON file, or a JSON file found beside the mesh; empty where there is none."""
    if scalp_faces is None:
        own = [path.with_name(f"{path.stem}.scalp.json{end}") for end in ("", ".gz")]
        beside = [file for file in own if file.is_file()]
        if not beside:
            beside = sorted([*path.parent.glob("scalp*.json"), *path.parent.glob("scalp*.json.gz")])
        if len(beside) != 1:
            return np.zeros(0, np.int64)
        scalp_faces = beside[0]
    if isinstance(scalp_faces, str | os.PathLike):
        source = Path(scalp_faces)
        try:
            opened = gzip.open if source.suffix == ".gz" else open
            with opened(source, "rt", encoding="utf-8") as file:
                scalp_faces = json.load(file)
            scalp_faces = [int(face) for face in scalp_faces]
        except (OSError, ValueError, TypeError) as error:
            raise HeadError(f"{source}: expected JSON with the numbers of the scalp's faces ({error})") from error
    listed = np.array(list(scalp_faces), np.int64)
    if len(listed) and (listed.min() < 0 or listed.max() >= count):
        raise HeadError(f"{path}: the scalp's list names face {listed.max()}, the mesh has faces 0 to {count - 1}")
    return listed


def _mesh(path, table, corners, offsets, kept, marked):
    """The HeadMesh of the polygons `kept`, fanned into triangles, its unused vertices dropped."""
    sizes = np.diff(offsets)
    chosen = np.isin(np.repeat(np.arange(len(sizes)), sizes), kept)
    used, local = np.unique(corners[chosen], return_inverse=True)
    local = local.ravel().astype(np.int32)
    local_offsets = np.concatenate([[0], np.cumsum(sizes[kept])]).astype(np.int32)
    size = np.diff(local_offsets)
    polygon = np.repeat(np.arange(len(size)), np.maximum(size - 2, 0))
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(size - 2) - (size - 2), size - 2)
    first = local_offsets[:-1][polygon]
    faces = np.stack([local[first], local[first + step + 1], local[first + step + 2]], axis=1)
    scalp = np.zeros(len(used), bool)
    scalp[local[np.repeat(marked[kept], size)]] = True
    quads = None if (size == 3).all() else local_offsets
    uv = np.where(scalp[:, None], table[used, 3:], np.nan)
    mesh = HeadMesh(table[used, :3], faces, scalp, uv, quads, None if quads is None else local, name=path.name)
    return through_skin(mesh)


def _in_head_frame(mesh):
    """The mesh in the head frame in mm: units by the scalp's area, axes by the scalp's mean normal; a body is cropped."""
    warnings = list(mesh.warnings)
    patch = mesh.faces[mesh.scalp_faces]
    areas = face_areas(mesh.vertices, patch)
    edge = np.sqrt(areas.sum())
    fits = [(abs(np.log(edge * unit / np.sqrt(np.prod(SCALP_EDGE)))), unit, name) for unit, name in UNITS]
    _, unit, name = min(fits)
    if not SCALP_EDGE[0] <= edge * unit <= SCALP_EDGE[1]:
        raise HeadError(
            f"{mesh.name}: the scalp's area is {edge**2:.4g} square units, which is no head's in millimetres, centimetres, "
            f"inches, decimetres or metres (expected {SCALP_EDGE[0] ** 2 / 100:.0f} to {SCALP_EDGE[1] ** 2 / 100:.0f} cm^2); "
            "scale the mesh to millimetres, or mark only the scalp as 'scalp'"
        )
    if unit != 1.0:
        warnings.append(f"{mesh.name}: units taken for {name}, by the size of the scalp")
    normal = (face_normals(mesh.vertices, patch) * areas[:, None]).sum(axis=0)
    normal /= max(np.linalg.norm(normal), 1e-12)
    up = max(AXIS, key=lambda axis: np.dot(AXIS[axis], normal))
    level = [axis for axis in AXIS if axis[1] != up[1]]
    face = min(level, key=lambda axis: np.dot(AXIS[axis], normal))
    if -np.dot(AXIS[face], normal) < TILT:
        face = "-y" if up == "+z" else "+z" if up == "+y" else face
        warnings.append(f"{mesh.name}: the scalp doesn't tell front from back; the face is taken to look along {face}")
    if (up, face) != ("+z", "-y"):
        warnings.append(f"{mesh.name}: {up} taken for up and {face} for the face, by the scalp's shape")
    back, top = -np.array(AXIS[face]), np.array(AXIS[up])
    turn = np.stack([np.cross(back, top), back, top])
    mesh = replace(mesh, vertices=mesh.vertices @ turn.T * unit)
    crown = mesh.vertices[mesh.scalp, 2].max()
    if crown - mesh.vertices[:, 2].min() > BODY:
        mesh = _cropped(mesh, crown - HEAD_AND_NECK)
        warnings.append(f"{mesh.name}: a body; cut {HEAD_AND_NECK:.0f} mm below the crown")
    return replace(mesh, warnings=tuple(warnings))


def _cropped(mesh, height):
    """The mesh without the polygons that reach below `height`."""
    offsets, corners = mesh.polygons
    above = np.minimum.reduceat(mesh.vertices[corners, 2], offsets[:-1]) >= height
    size = np.diff(offsets)
    faces = mesh.faces[np.repeat(above, size - 2)]
    kept = corners[np.repeat(above, size)]
    used, local = np.unique(kept, return_inverse=True)
    place = np.full(len(mesh.vertices), -1, np.int32)
    place[used] = np.arange(len(used))
    has_polygons = mesh.polygon_offsets is not None
    return HeadMesh(
        mesh.vertices[used],
        place[faces],
        mesh.scalp[used],
        mesh.uv[used],
        np.concatenate([[0], np.cumsum(size[above])]).astype(np.int32) if has_polygons else None,
        local.ravel().astype(np.int32) if has_polygons else None,
        mesh.name,
        mesh.warnings,
    )
