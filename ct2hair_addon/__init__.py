"""CT2Hair's engine: from a CT scan of a wig to hair strands on a head, without bpy (only `scene/` knows Blender)."""

import os
from pathlib import Path

from .cache import kernel_folder

__version__ = "0.1.0"

# numba reads this when it first compiles: compiled kernels go to the user's cache, not into the installed extension.
# a folder for each name that the package is loaded by: a kernel that Blender compiled as bl_ext... can't be read by the worker
if "NUMBA_CACHE_DIR" not in os.environ:
    os.environ["NUMBA_CACHE_DIR"] = str(kernel_folder(__name__, Path(__file__).parent))
