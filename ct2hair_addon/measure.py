"""What a stage costs: seconds and peak memory, for the report and the benchmark."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from pathlib import Path

_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


class Meter:
    """Seconds since it was made and the process's peak memory since then (where the system can't say, since its start)."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        try:
            _CLEAR.write_text("5", encoding="utf-8")  # Linux: forget the peak so far
        except OSError:
            pass

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._start

    @property
    def peak_memory(self) -> float:
        """GB (10^9 bytes) of resident memory at the peak."""
        try:
            line = next(line for line in _STATUS.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM"))
            return int(line.split()[1]) * 1024 / 1e9
        except (OSError, StopIteration):
            return _peak_by_rusage()


def release_memory() -> None:
    """Give memory that is free, but held for later by the C library's heap, back to the system (glibc; nothing elsewhere).

    Arrays of a few megabytes that come and go leave holes; after a stage on a large scan those are gigabytes.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def _peak_by_rusage() -> float:
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


VOXEL_SECONDS, FIT_SECONDS, START_SECONDS = 6.0e-6, 5.5e-6, 25.0
"""Seconds a hair voxel on two threads for all but the fit, and for a fit of 60 steps, and to start: bob, 0.4 mm, 241 s."""
STORED_SHARE = 5.5
"""Voxels in bricks a hair voxel, on the same scan."""
STAGE_BYTES = 9.0
"""Peak memory of the stages for each stored voxel, beside the density: a residual and its potential."""
ENGINE_MEMORY = 1.0
"""GB of the interpreter with numba and torch before any volume."""


def needed_memory(stored_voxels: float, voxel_bytes: float) -> float:
    """GB at the stages' peak, from the voxels in the density's bricks and the bytes of each."""
    return ENGINE_MEMORY + (voxel_bytes + STAGE_BYTES) * stored_voxels / 1e9


def estimated_cost(hair_voxels: float, iterations: int, threads: int) -> tuple[float, float]:
    """(minutes, GB) that a reconstruction takes, from hair voxels and the fit's steps: right within a factor of two."""
    each = (VOXEL_SECONDS + FIT_SECONDS * iterations / 60.0) * 2.0 / max(threads, 1)
    return (START_SECONDS + hair_voxels * each) / 60.0, needed_memory(STORED_SHARE * hair_voxels, 2.0)


def allowed_memory(chosen: float = 0.0) -> float:
    """GB that work may take: what was chosen, or (0) three quarters of the machine's."""
    return chosen or 0.75 * machine_memory()


def machine_memory() -> float:
    """GB (10^9 bytes) of memory in the machine; infinity where the system can't say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, AttributeError, OSError):
        return float("inf")
