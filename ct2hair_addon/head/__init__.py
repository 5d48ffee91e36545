"""Stage 2, the head: mesh and scalp, the built-in mannequin, queries, registration, hairnet."""

from .flatten import Distortion, distortion, unwrap
from .form import HeadForm, template_head
from .hairnet import remove_hairnet
from .landmarks import fit_landmarks, scalp_landmarks
from .marking import mark_scalp
from .mesh import HeadMesh
from .obj import load_obj
from .registration import Registration, axis_rotation, fit_to_roots, orientations, register_head
from .scalp_surface import ScalpSurface, scalp_surface
from .surface import Head, ScalpPoints

__all__ = [
    "Distortion",
    "Head",
    "HeadForm",
    "HeadMesh",
    "Registration",
    "ScalpPoints",
    "ScalpSurface",
    "axis_rotation",
    "distortion",
    "fit_landmarks",
    "fit_to_roots",
    "load_obj",
    "mark_scalp",
    "orientations",
    "register_head",
    "remove_hairnet",
    "scalp_landmarks",
    "scalp_surface",
    "template_head",
    "unwrap",
]
