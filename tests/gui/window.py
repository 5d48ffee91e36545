"""A real Blender with a window nobody sees: Debian sid's, in a folder of its own, under Xvfb; driven by mouse and keys.

`DebianBlender.prepared` makes the folder with debootstrap (root, network, 3 GB; some minutes the first time); it lies where
CT2HAIR_GUI_ROOT says, or in out/gui/debian. Raises Unavailable with the reason where it can't be made.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    "blender xvfb xdotool imagemagick libgl1-mesa-dri fonts-dejavu-core xauth python3-cattr python3-requests python3-numba "
    "python3-scipy python3-skimage python3-openvdb python3-torch python3-tifffile python3-safetensors"
).split()
MIRROR = "http://deb.debian.org/debian"
WIDTH, HEIGHT = 1600, 1000
HOME = "/ct2hair"
"""Folder of the test inside Debian."""


class Unavailable(Exception):
    """There is no window here, and why."""


class DebianBlender:
    """One run of Blender in the folder: start it, ask it things, click, type, take pictures."""

    def __init__(self, folder: Path, display: str = ":87") -> None:
        self.folder, self.display = folder, display
        self.home = folder / HOME.strip("/")
        self.requests = self.home / "requests"
        self._processes: list[subprocess.Popen] = []
        self._number = 0

    @classmethod
    def prepared(cls) -> DebianBlender:
        """Debian's folder, made where it is not there yet. Raises Unavailable."""
        folder = Path(os.environ.get("CT2HAIR_GUI_ROOT", ROOT / "out" / "gui" / "debian"))
        if not (folder / "usr/bin/blender").exists() or not (folder / "usr/bin/Xvfb").exists():
            cls._make(folder)
        if not (folder / "proc/self").exists():
            run = subprocess.run(
                ["mount", "-t", "proc", "proc", str(folder / "proc")], capture_output=True, encoding="utf-8", check=False
            )
            if run.returncode:
                raise Unavailable(f"/proc can't be mounted in {folder}: {run.stderr.strip()}")
        mtab = folder / "etc/mtab"
        if not mtab.is_symlink():
            mtab.unlink(missing_ok=True)
            mtab.symlink_to("/proc/mounts")
        return cls(folder)

    @staticmethod
    def _make(folder: Path) -> None:
        if os.geteuid() != 0 or shutil.which("debootstrap") is None:
            raise Unavailable("making Debian's folder needs root and the program debootstrap")
        folder.mkdir(parents=True, exist_ok=True)
        for command in (
            ["debootstrap", "--variant=minbase", "--include=ca-certificates", "sid", str(folder), MIRROR],
            ["chroot", str(folder), "apt-get", "-o", "Acquire::Check-Valid-Until=false", "update", "-qq"],
            ["chroot", str(folder), "apt-get", "install", "-y", "-qq", "--no-install-recommends", *PACKAGES],
        ):
            environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
            run = subprocess.run(command, capture_output=True, encoding="utf-8", check=False, env=environment)
            if run.returncode:
                raise Unavailable(f"{' '.join(command[:4])} ... failed: {(run.stderr or run.stdout).strip()[-300:]}")

    def run(self, *command: str, timeout: float = 120, **variables: str) -> str:
        """Run a command inside; its output."""
        done = subprocess.run(
            ["chroot", str(self.folder), *command],
            capture_output=True,
            encoding="utf-8",
            timeout=timeout,
            check=False,
            env=self._environment(variables),
        )
        if done.returncode:
            raise AssertionError(f"{command}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
        return done.stdout

    def _environment(self, more) -> dict[str, str]:
        return {
            "PATH": "/usr/bin:/bin:/usr/sbin:/sbin",
            "HOME": HOME,
            "DISPLAY": self.display,
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "LANG": "C.UTF-8",
            "CT2HAIR_GUI": f"{HOME}/requests",
            "BLENDER_USER_RESOURCES": f"{HOME}/blender",
            "OMP_NUM_THREADS": "2",
            **more,
        }

    def start(self) -> None:
        """Start the display and Blender, and wait until it answers."""
        self.requests.mkdir(parents=True, exist_ok=True)
        for old in self.requests.iterdir():
            old.unlink()
        shutil.copy2(Path(__file__).with_name("inside.py"), self.home / "inside.py")
        screen = f"{WIDTH}x{HEIGHT}x24"
        self._spawn("Xvfb", self.display, "-screen", "0", screen, "+extension", "GLX", "-nolisten", "tcp")
        time.sleep(1.5)
        geometry = ["--window-geometry", "0", "0", str(WIDTH), str(HEIGHT)]
        self._spawn("blender", "--gpu-backend", "opengl", *geometry, "--python", f"{HOME}/inside.py")
        self.ask("answer = bpy.app.version_string", timeout=120)

    def _spawn(self, *command: str) -> None:
        with (self.home / f"{Path(command[0]).name}.log").open("w") as log:
            self._processes.append(
                subprocess.Popen(
                    ["chroot", str(self.folder), *command], stdout=log, stderr=subprocess.STDOUT, env=self._environment({})
                )
            )

    def stop(self) -> None:
        """End Blender and the display."""
        for process in reversed(self._processes):
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()

    def ask(self, code: str, timeout: float = 30.0):
        """Run Python in Blender's main loop; its `answer`. Raises AssertionError with Blender's own traceback."""
        self._number += 1
        request = self.requests / f"{self._number:05d}.py"
        beside = request.with_suffix(".part")
        beside.write_text(code)
        beside.replace(request)
        end, done = time.monotonic() + timeout, request.with_suffix(".json")
        while not done.is_file():
            if any(process.poll() is not None for process in self._processes):
                raise AssertionError(
                    "Blender or its display ended: " + (self.home / "blender.log").read_text(encoding="utf-8")[-2000:]
                )
            if time.monotonic() > end:
                raise AssertionError(f"no answer within {timeout:g} s to: {code}")
            time.sleep(0.02)
        said = json.loads(done.read_text(encoding="utf-8"))
        done.unlink()
        if "error" in said:
            raise AssertionError(said["error"])
        return said["answer"]

    def until(self, code: str, timeout: float = 60.0, every: float = 0.2):
        """Ask again and again until the answer is true; the answer."""
        end = time.monotonic() + timeout
        while not (answer := self.ask(code, timeout)):
            assert time.monotonic() < end, f"waited {timeout:g} s in vain for: {code}"
            time.sleep(every)
        return answer

    def click(self, x: float, y: float) -> None:
        """Move the mouse to x, y of the screen, y down, and click."""
        self.run("xdotool", "mousemove", str(int(x)), str(int(y)))
        time.sleep(0.3)
        self.run("xdotool", "mousedown", "1")
        time.sleep(0.15)
        self.run("xdotool", "mouseup", "1")
        time.sleep(0.3)

    def move(self, x: float, y: float) -> None:
        self.run("xdotool", "mousemove", str(int(x)), str(int(y)))
        time.sleep(0.2)

    def key(self, *keys: str) -> None:
        for key in keys:
            self.run("xdotool", "key", key)
            time.sleep(0.2)

    def type(self, text: str) -> None:
        self.run("xdotool", "type", "--delay", "30", text)
        time.sleep(0.3)

    def picture(self, path: Path, crop: str | None = None) -> Path:
        """The screen as a PNG of at most 256 colours; crop: WIDTHxHEIGHT+X+Y."""
        path.parent.mkdir(parents=True, exist_ok=True)
        inside = f"{HOME}/shot.png"
        self.run("import", "-window", "root", inside)
        cut = ["-crop", crop, "+repage"] if crop else []
        self.run("convert", inside, *cut, "-colors", "256", f"{HOME}/small.png")
        shutil.copy2(self.home / "small.png", path)
        return path
