"""Where files go that can be made again: the user's cache folder, by the habits of each system."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path

UNUSED = 30 * 86400.0
"""Seconds after which kernels of other sources, that nobody used, are deleted."""


def cache_folder() -> Path:
    """The folder for compiled kernels and the built template head; `CT2HAIR_CACHE` overrules the system's habit."""
    if chosen := os.environ.get("CT2HAIR_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "ct2hair"


def kernel_folder(package: str, sources: Path) -> Path:
    """The folder for what numba compiles of a package, loaded by this name, from these sources.

    numba looks for changes in a kernel's own file alone, while a kernel holds those of other files that it calls, too: so
    there is a folder for each state of all files with kernels. Those that were not used for a month are deleted.
    """
    digest = hashlib.sha256()
    for path in sorted(sources.rglob("*.py")):
        text = path.read_bytes()
        if b"njit" in text:
            digest.update(path.relative_to(sources).as_posix().encode() + b"\0" + text)
    own = cache_folder() / "kernels" / package / digest.hexdigest()[:12]
    with suppress(OSError):
        os.utime(own)
    with suppress(OSError):
        for other in own.parent.iterdir():
            if other != own and time.time() - other.stat().st_mtime > UNUSED:
                shutil.rmtree(other, ignore_errors=True)
    return own
