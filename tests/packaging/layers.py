"""Checks with import-linter who knows whom in the house; the contracts stand in pyproject.toml.

Blender loads the repository as one package (`bl_ext.<repository>.ct2hair`) whose packages import each other relatively, but a
clone has any name and holds much else. So the check lays the sources out as a package `ct2hair` in a temporary folder.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def lay_out(root: Path, folder: Path) -> Path:
    """Copy the Python sources of the extension at `root` to `folder`/ct2hair."""
    package = folder / "ct2hair"
    package.mkdir()
    shutil.copy2(root / "__init__.py", package)
    for name in ("ct2hair_addon", "operators", "panels"):
        if (root / name).is_dir():
            shutil.copytree(root / name, package / name, ignore=lambda _, names: [n for n in names if n == "__pycache__"])
    return package


def check(folder: Path, config: Path = ROOT / "pyproject.toml") -> subprocess.CompletedProcess:
    """Run import-linter on the package `ct2hair` in a folder."""
    command = Path(sys.executable).with_name("lint-imports")
    return subprocess.run(
        [str(command), "--config", str(config), "--no-cache"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        check=False,
    )


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        lay_out(ROOT, Path(folder))
        done = check(Path(folder))
        print(done.stdout.strip())
        return done.returncode


if __name__ == "__main__":
    sys.exit(main())
