"""The jobs of this Blender: the one that runs, those that wait, and how the last one ended; what the panel shows of them."""

from __future__ import annotations

import atexit
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..ct2hair_addon.jobs import Job
from ..ct2hair_addon.settings import Settings


@dataclass(frozen=True)
class Request:
    """A job that is to be done: all that the scene said when it was asked for, so that later changes don't matter.

    until: the stage to stop after, or None. scene: name of the scene that the result goes to. options: of `start_job`.
    """

    scan: Path
    folder: Path
    settings: Settings
    colour: str = "brown"
    until: str | None = None
    scene: str = ""
    options: dict = field(default_factory=dict)


@dataclass
class Running:
    """The job, those that wait, and how the last one ended."""

    job: Job | None = None
    folder: Path | None = None
    request: Request | None = None
    waiting: list[Request] = field(default_factory=list)
    ended: str = ""
    """How the last job ended, in words; empty before the first."""
    failed: bool = False
    log: Path | None = None
    warnings: list[str] = field(default_factory=list)
    stages: dict[str, str] = field(default_factory=dict)
    """Stage -> "running", "done" or "stopped", of the job that runs or ran last."""

    def begin(self, job: Job, folder: Path, request: Request | None = None) -> None:
        self.job, self.folder, self.log, self.request = job, folder, job.log_path, request
        self.ended, self.failed, self.warnings, self.stages = "", False, [], {}

    def heard(self) -> None:
        """Note from the job's words how far its stages are."""
        stage = getattr(self.job, "stage", "start")
        if stage == "start":
            return
        for other, state in self.stages.items():
            if state == "running" and other != stage:
                self.stages[other] = "done"
        self.stages.setdefault(stage, "running")

    def end(self, text: str, failed: bool) -> None:
        """Note how the job ended; its worker is gone after this, whatever it was doing."""
        if self.job is not None:
            self.heard()
            self.warnings = list(self.job.warnings)
            last = "done" if getattr(self.job, "result", None) is not None else "stopped"
            self.stages = {stage: last if state == "running" else state for stage, state in self.stages.items()}
            self.job.close()
        self.job, self.request, self.ended, self.failed = None, None, text, failed

    def end_all(self, text: str) -> None:
        """End the job and forget those that wait."""
        self.waiting.clear()
        self.end(text, failed=False)


current = Running()
"""One job at a time; others wait in line."""


@dataclass
class Looking:
    """The look at a scan that is under way, and where the last one lies."""

    process: subprocess.Popen | None = None
    folder: Path | None = None

    def end(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.process = None


looking = Looking()


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
    looking.end()
    if current.job is not None:
        current.job.close()


atexit.register(_end_at_exit)
