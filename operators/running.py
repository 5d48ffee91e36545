"""The job that runs for this Blender: what the operators start and end, and what the panel shows of it."""

from __future__ import annotations

import atexit
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..ct2hair_addon.jobs import Job


@dataclass
class Running:
    """The job, and how the last one ended."""

    job: Job | None = None
    folder: Path | None = None
    ended: str = ""
    """How the last job ended, in words; empty before the first."""
    failed: bool = False
    log: Path | None = None
    warnings: list[str] = field(default_factory=list)

    def begin(self, job: Job, folder: Path) -> None:
        self.job, self.folder, self.log = job, folder, job.log_path
        self.ended, self.failed, self.warnings = "", False, []

    def end(self, text: str, failed: bool) -> None:
        """Note how the job ended; its worker is gone after this, whatever it was doing."""
        if self.job is not None:
            self.warnings = list(self.job.warnings)
            self.job.close()
        self.job, self.ended, self.failed = None, text, failed


current = Running()
"""One job at a time."""


def time_left(seconds: float | None) -> str:
    """Remaining time in words: "", "40 s left", "3 min left"."""
    if seconds is None:
        return ""
    return f"{seconds:.0f} s left" if seconds < 90 else f"{seconds / 60:.0f} min left"


def headless() -> bool:
    """Whether there is no window whose timer could carry a job: the operator then waits for it."""
    return bpy.app.background


def redraw() -> None:
    """Have the sidebars drawn again, where progress shows."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()


def _end_at_exit() -> None:
    if current.job is not None:
        current.job.close()


atexit.register(_end_at_exit)
