"""The built zip, and a fresh environment with nothing but Blender and its own numpy to try it in."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "wheels"))  # the scripts under test import each other by name, as when they are run

import extension  # noqa: E402
import lock  # noqa: E402

INSTALL = """
import sys

import bpy

done = bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
assert done == {"FINISHED"}, done
assert "bl_ext.user_default.ct2hair" in bpy.context.preferences.addons, "installed, but not enabled"
"""

# what each new bpy process begins with: Blender as a module starts with no add-on enabled
ENABLE = """
import bpy
import addon_utils  # found only once bpy is there

assert addon_utils.enable("bl_ext.user_default.ct2hair", default_set=True) is not None, "could not be enabled"
"""


@dataclass(frozen=True)
class FreshBlender:
    """A Python with bpy, what bpy's wheel asks for and nothing else, and a user folder of its own."""

    folder: Path
    target: lock.Target

    @property
    def python(self) -> Path:
        return self.folder / "env" / "bin" / "python"

    def run(self, script: str, *arguments: str, timeout: float = 600) -> str:
        """Run a script in a process of its own and give what it printed; the test fails with its output if it fails."""
        file = self.folder / "script.py"
        file.write_text(script)
        done = subprocess.run(
            [str(self.python), str(file), *arguments],
            cwd=self.folder,
            env={
                "PATH": os.environ["PATH"],
                "HOME": str(self.folder),
                "TMPDIR": str(self.folder),
                "LANG": "C.UTF-8",
                "BLENDER_USER_RESOURCES": str(self.folder / "blender"),
                "CT2HAIR_CACHE": str(self.folder / "cache"),
                "PYTHONNOUSERSITE": "1",
                "NUMBA_NUM_THREADS": os.environ.get("NUMBA_NUM_THREADS", str(os.cpu_count())),
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            timeout=timeout,
            check=False,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    def run_enabled(self, script: str, *arguments: str, timeout: float = 600) -> str:
        """As `run`, with the installed extension enabled first."""
        return self.run(ENABLE + script, *arguments, timeout=timeout)

    def install(self, archive: Path) -> None:
        """Install and enable a zip of the extension, through Blender's own operator."""
        self.run(INSTALL, str(archive))


def fresh_blender(folder: Path, python: Path) -> FreshBlender:
    """Lay out a FreshBlender in a folder from an environment that has bpy, whose files are linked, not downloaded again."""
    describe = "import json, sys; print(json.dumps([sys.version_info[:2], sys.prefix, sys._base_executable]))"
    done = subprocess.run([str(python), "-c", describe], stdout=subprocess.PIPE, check=True)
    numbers, prefix, base = json.loads(done.stdout)
    version = ".".join(map(str, numbers))
    target = lock.Target(lock.this_platform(), version)
    subprocess.run([base, "-m", "venv", "--without-pip", "--symlinks", str(folder / "env")], check=True)
    ours = folder / "env" / "lib" / f"python{version}" / "site-packages"
    theirs = Path(prefix) / "lib" / f"python{version}" / "site-packages"
    for name in lock.pinned("blender", target):
        (information,) = (
            path for path in theirs.glob("*.dist-info") if path.name.split("-")[0].lower().replace("_", "-") == name
        )
        for line in (information / "RECORD").read_text(encoding="utf-8").splitlines():
            file = Path(line.rsplit(",", 2)[0].strip('"'))
            if file.parts[0] != ".." and "__pycache__" not in file.parts:
                (ours / file).parent.mkdir(parents=True, exist_ok=True)
                link_or_copy(theirs / file, ours / file)
    (folder / "blender").mkdir()
    return FreshBlender(folder, target)


def link_or_copy(source: Path, destination: Path) -> None:
    try:
        os.link(source, destination)
    except OSError:
        shutil.copy2(source, destination)


def build_zip(target: lock.Target, folder: Path) -> Path:
    """The zip for a target. Without torch, saying so, where the package index has no CPU build of it for this Python."""
    try:
        return extension.build(target.platform, (target.python,), dist=folder)
    except lock.LockError as error:
        if "torch" not in str(error):
            raise
        warnings.warn(f"the zip for {target} is tried without torch, whose CPU build can't be had here", stacklevel=1)
        return extension.build(target.platform, (target.python,), frozenset({"torch"}), dist=folder)


def with_the_zip(folder: Path, python: Path) -> Iterator[FreshBlender]:
    """A FreshBlender with the built zip installed and enabled; its folder of two gigabytes is removed at the end."""
    fresh = fresh_blender(folder, python)
    fresh.install(build_zip(fresh.target, fresh.folder))
    yield fresh
    shutil.rmtree(folder)


@pytest.fixture(scope="session")
def blender45(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FreshBlender]:
    """bpy 4.5 with its own numpy and nothing else, and the zip."""
    yield from with_the_zip(tmp_path_factory.mktemp("blender45"), Path(sys.executable))


@pytest.fixture(scope="session")
def blender52(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FreshBlender]:
    """The same with bpy 5.2, from the environment of `make venv52` or the Python that CT2HAIR_BPY52_PYTHON names."""
    python = Path(os.environ.get("CT2HAIR_BPY52_PYTHON", ROOT / ".venv52" / "bin" / "python"))
    if not python.exists():
        pytest.skip("no Blender 5.2 here: `make venv52` makes one (Python 3.13), or CT2HAIR_BPY52_PYTHON names its Python")
    yield from with_the_zip(tmp_path_factory.mktemp("blender52"), python)
