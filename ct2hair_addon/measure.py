"""What a stage costs: seconds and peak memory, for the report and the benchmark."""

from __future__ import annotations

import sys
import time
from pathlib import Path

_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


class Meter:
    """Seconds since it was made and the process's peak memory since then (where the system can't say, since its start)."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        try:
            _CLEAR.write_text("5")  # Linux: forget the peak so far
        except OSError:
            pass

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._start

    @property
    def peak_memory(self) -> float:
        """GB (10^9 bytes) of resident memory at the peak."""
        try:
            line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM"))
            return int(line.split()[1]) * 1024 / 1e9
        except (OSError, StopIteration):
            return _peak_by_rusage()


def _peak_by_rusage() -> float:
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def machine_memory() -> float:
    """GB (10^9 bytes) of memory in the machine; infinity where the system can't say."""
    try:
        import os

        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, AttributeError, OSError):
        return float("inf")
