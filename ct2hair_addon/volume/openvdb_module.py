"""Finds OpenVDB's Python module, which comes with Blender, without importing bpy: the engine runs in any Python."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
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
    """Where a `bpy` wheel in this Python keeps its bundled modules: `bpy/<version>/python/lib/python3.x/site-packages`."""
    try:
        wheel = importlib.util.find_spec("bpy")
    except (ImportError, ValueError):
        return []
    if wheel is None:
        return []
    roots = list(wheel.submodule_search_locations or []) or [Path(wheel.origin or "").parent]
    return sorted(folder for root in roots for folder in Path(root).glob("*/python/lib/python3.*/site-packages"))
