"""A head put into a scan by hand: by moving it, or by landmarks dragged to where they are in the wig."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..errors import CT2HairError, HeadError
from ..head import fit_landmarks, scalp_landmarks
from .frames import MM, rigid
from .head import head_mesh

LANDMARK = "ct2hair_landmark"
"""Custom property of a landmark's empty: which of the head's landmarks it is."""
LANDMARK_OF = "ct2hair_landmark_of"
"""Custom property of a landmark's empty: the head, a pointer."""
LANDMARK_SIZE = 0.008
"""Radius of a landmark's sphere, m."""


def placement(scan: bpy.types.Object, head: bpy.types.Object) -> str:
    """The setting `head.place` for a head that the user has put where it stands in a scan: 16 numbers, head to scan, mm.

    scan: the empty of an imported scan (role `scan`). head: the template as it is, moved, turned and scaled evenly.
    Raises CT2HairError where it is scaled unevenly or mirrored.
    """
    matrix = np.linalg.inv(np.array(scan.matrix_world, np.float64)) @ np.array(head.matrix_world, np.float64)
    matrix = matrix @ np.diag([MM, MM, MM, 1.0])
    try:
        rigid(matrix)
    except ValueError:
        raise CT2HairError(f"'{head.name}' is scaled unevenly or mirrored: give it one scale for all axes") from None
    return " ".join(f"{value:.9g}" for value in matrix.ravel())


def landmarks_of(head: bpy.types.Object) -> list[bpy.types.Object]:
    """The landmarks of a head that are in its scene's data, in the order of their names."""
    return sorted((ob for ob in bpy.data.objects if ob.get(LANDMARK_OF) == head), key=lambda ob: ob.name)


def add_landmarks(head: bpy.types.Object, context: bpy.types.Context | None = None) -> list[bpy.types.Object]:
    """Add an empty at each landmark of the head's scalp where it stands now, to be dragged to its place in the wig.

    Landmarks that the head had are removed first. Raises HeadError for a mesh without a scalp that is a cap.
    """
    context = context or bpy.context
    places = scalp_landmarks(head_mesh(head, evaluated=True))
    bpy.data.batch_remove(landmarks_of(head))
    made = []
    for name, place in places.items():
        ob = bpy.data.objects.new(f"Landmark {name}", None)
        ob.empty_display_type, ob.empty_display_size = "SPHERE", LANDMARK_SIZE
        ob.show_name = ob.show_in_front = True
        ob.location = head.matrix_world @ Vector(MM * place)
        ob[LANDMARK], ob[LANDMARK_OF] = name, head
        (context.collection or context.scene.collection).objects.link(ob)
        made.append(ob)
    context.view_layer.update()
    return made


def fit_to_landmarks(head: bpy.types.Object) -> float:
    """Move, turn and evenly scale the head so that its landmarks come to where their empties are; the rest in mm (rms).

    Landmarks that can't be seen in a wig may be deleted, down to three. Raises HeadError for fewer, or on one line.
    """
    empties = landmarks_of(head)
    if not empties:
        raise HeadError(f"'{head.name}' has no landmarks; add them first")
    places = scalp_landmarks(head_mesh(head, evaluated=True))
    own = MM * np.array([places[ob[LANDMARK]] for ob in empties])
    wanted = np.array([ob.matrix_world.translation for ob in empties])
    matrix, left = fit_landmarks(own, wanted)
    head.matrix_world = Matrix(matrix.tolist())
    return left / MM
