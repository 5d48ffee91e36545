"""Procedural hairstyles with known strands: the test hair of the project (issue "evaluation"), after the paper's ten wigs.

Short is `pixie` and `mop_top`, "ponytail" is itself, "complex" (Table 1, FINDINGS) is `wavy`, "curly" is `curly`.
"""

from __future__ import annotations

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


__all__ = ["STYLES", "hairstyle"]
