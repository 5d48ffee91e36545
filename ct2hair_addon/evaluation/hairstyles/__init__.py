"""Procedural hairstyles with known strands: the test hair of the project (issue "evaluation"), after the paper's ten wigs.

Short is `pixie` and `mop_top`, "ponytail" is itself, "complex" (Table 1, FINDINGS) is `wavy`, "curly" is `curly`.
"""

from __future__ import annotations

import numpy as np

from ...errors import SettingsError
from ...head import HeadMesh, template_head
from ...strands import Strands
from .loose import LOOSE
from .person import person
from .tied import TIED

_RECIPES = {**LOOSE, **TIED}

STYLES = tuple(_RECIPES)
"""The names that `hairstyle` takes."""


def hairstyle(name: str, head: HeadMesh | None = None, strands: int = 8000, seed: int = 0) -> Strands:
    """Strands of a hairstyle on a head (head frame, mm; None takes the built-in one), root first, roots on the scalp.

    The same name, head, count and seed give the same strands. Strand attribute `root_uv` (N, 2). No point lies inside the
    head. Raises SettingsError for an unknown name or count, HeadError for a head without a usable scalp.
    """
    if name not in _RECIPES:
        raise SettingsError(f"unknown hairstyle '{name}'; there are {', '.join(STYLES)}")
    if strands < 1:
        raise SettingsError(f"a hairstyle needs at least 1 strand, got {strands}")
    return _RECIPES[name](person(head or template_head(), strands, seed), seed)


def describe(name: str) -> str:
    """A line on what a hairstyle is."""
    return _RECIPES[name].__doc__


def curl_radius(strands: Strands, step: float = 1.5) -> np.ndarray:
    """(K,) mm: radius of the helix that a strand follows, at points `step` mm apart: curvature / (curvature^2 + torsion^2).

    Strand ends are left out. Straight hair has no radius to speak of.
    """
    even = strands.resampled_by_step(step)
    first = np.diff(even.points.astype(np.float64), axis=0)
    index = even.strand_index
    inside = index[:-3] == index[3:]
    a, b, c = (first[n : len(first) - 2 + n][inside] for n in range(3))
    spacing = np.linalg.norm(b, axis=1)
    one, two = np.cross(a, b), np.cross(b, c)
    lengths = [np.maximum(np.linalg.norm(v, axis=1), 1e-12) for v in (a, b, c, one, two)]
    bend = np.arcsin(np.clip(lengths[3] / (lengths[0] * lengths[1]), 0.0, 1.0)) / spacing
    turn = np.arccos(np.clip((one * two).sum(axis=1) / (lengths[3] * lengths[4]), -1.0, 1.0)) / spacing
    return bend / np.maximum(bend**2 + turn**2, 1e-12)


__all__ = ["STYLES", "curl_radius", "describe", "hairstyle"]
