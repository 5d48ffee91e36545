"""CT2Hair's engine: from a CT scan of a wig to hair strands on a head, without bpy (only `scene/` knows Blender)."""

import os

from .cache import cache_folder

__version__ = "0.1.0"

# numba reads this when it first compiles: compiled kernels go to the user's cache, not into the installed extension.
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder() / "kernels"))
