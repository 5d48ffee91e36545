"""Finds OpenVDB's Python module, which comes with Blender, without importing bpy: the engine runs in any Python."""

from __future__ import annotations

import functools
import importlib
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType

from ..errors import ScanError


@functools.cache
def openvdb() -> ModuleType:
    """OpenVDB's Python module.

    Looked for as a plain import (Blender's scene side has exposed it, PYTHONPATH names its folder, or Debian's
    python3-openvdb is installed), then in the folder that the `bpy` wheel bundles. Raises ScanError where it is nowhere.
    """
    try:
        return importlib.import_module("openvdb")
    except ImportError:
        pass
    for folder in _bundled_folders():
        sys.path.append(str(folder))
        try:
            return importlib.import_module("openvdb")
        except ImportError:
            pass
        finally:
            sys.path.remove(str(folder))
    raise ScanError(
        "OpenVDB's Python module was not found, so .vdb files can't be read or written; run inside Blender 4.5 or newer, "
        "install the 'bpy' wheel into this Python, or name the folder that holds openvdb in PYTHONPATH"
    )


def _bundled_folders() -> list[Path]:
    """Where a `bpy` wheel in this Python keeps its bundled modules: `bpy/<version>/python/lib/python3.x/site-packages`.

    All of the path is looked through: once bpy was imported, its scripts, a `bpy` of Python alone among them, come first.
    """
    found = (PathFinder.find_spec("bpy", [entry]) for entry in sys.path)
    roots = [root for spec in found if spec for root in spec.submodule_search_locations or [Path(spec.origin or "").parent]]
    return sorted(folder for root in roots for folder in Path(root).glob("*/python/lib/python3.*/site-packages"))
