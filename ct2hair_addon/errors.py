"""The errors that a user is meant to read: each says what is wrong and what to do about it."""

from __future__ import annotations

import sys


class CT2HairError(Exception):
    """A problem with the input or the settings. `str(error)` is one or two plain sentences: what is wrong (file, value,
    expected) and what to do. The faces (panel, command line, worker) show it without a traceback."""


class ScanError(CT2HairError):
    """The scan can't be read, or holds nothing that the stages can work with."""


class SettingsError(CT2HairError):
    """A setting is unknown, of the wrong type or outside its range."""


class StrandFileError(CT2HairError):
    """A strand file is damaged, truncated or of an unknown format."""


class HeadError(CT2HairError):
    """A head mesh can't be used: no scalp, not closed enough to tell inside from outside, of no area."""


class Cancelled(Exception):
    """The user stopped the work. Raised by a progress callback, passed through by every stage untouched."""


def explained(error: Exception) -> str | None:
    """What to tell the user of an error that stands for a state of the machine and not for a fault of the program, or None."""
    if isinstance(error, CT2HairError | OSError):
        return str(error)
    if isinstance(error, MemoryError):
        return "not enough memory: close other programs or choose a coarser scan"
    if isinstance(error, ModuleNotFoundError) and error.name and "ct2hair" not in error.name:
        package = error.name.partition(".")[0]
        return f"the package '{package}' is missing from {sys.executable}: install it there, or let another Python do the work"
    return None
