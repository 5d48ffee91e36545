"""Builds the extension's zip with Blender's own tool, and validates it: `python wheels/extension.py --help`.

The manifest of the repository names the wheels of every platform and Python. A zip is built from a copy of what users get,
whose manifest names those of the chosen platform and Pythons, for all of them together would be two gigabytes.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from fetch import fetch
from lock import (
    MANIFEST,
    PLATFORMS,
    PYTHONS,
    ROOT,
    WHEELS,
    LockError,
    Target,
    bundled_wheels,
    manifest_with_wheels,
    this_platform,
)

ROOMS = ("ct2hair_addon", "operators", "panels")
SHIPPED = ("__init__.py", "LICENSE", "README.md", *ROOMS)
DIST = ROOT / "dist"


def build(platform: str, pythons: tuple[str, ...], leave_out: frozenset[str] = frozenset(), dist: Path = DIST) -> Path:
    """The zip for a platform and some Pythons, its wheels fetched by hash; `leave_out` names packages not to bundle."""
    targets = tuple(Target(platform, python) for python in pythons)
    for target in targets:
        fetch(target, leave_out)
    version = tomllib.loads(MANIFEST.read_text(encoding="utf-8"))["version"]
    pythons_name = "" if pythons == PYTHONS[:1] else "-py" + "_".join(python.replace(".", "") for python in pythons)
    without = "".join(f"-no_{name}" for name in sorted(leave_out))
    name = f"ct2hair-{version}-{platform.replace('-', '_')}{pythons_name}{without}"
    stage, archive = dist / name, dist / f"{name}.zip"
    shutil.rmtree(stage, ignore_errors=True)
    try:
        stage_extension(stage, bundled_wheels(targets, leave_out), [platform])
        blender_extension("build", "--source-dir", str(stage), "--output-filepath", str(archive))
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    blender_extension("validate", str(archive))
    return archive


def stage_extension(folder: Path, wheels: list[str], platforms: list[str]) -> None:
    """Lay out what users get in a folder: the sources, these wheels, and a manifest that names them."""
    folder.mkdir(parents=True)
    for entry in SHIPPED:
        source = ROOT / entry
        if source.is_dir():
            shutil.copytree(source, folder / entry, ignore=shutil.ignore_patterns("__pycache__", ".*"))
        else:
            shutil.copy2(source, folder / entry)
    (folder / MANIFEST.name).write_text(
        manifest_with_wheels(MANIFEST.read_text(encoding="utf-8"), wheels, platforms), encoding="utf-8"
    )
    (folder / "wheels").mkdir()
    for file in wheels:
        try:
            os.link(WHEELS / file, folder / "wheels" / file)  # 200 MB of torch need not be copied
        except OSError:
            shutil.copy2(WHEELS / file, folder / "wheels" / file)


def blender_extension(*arguments: str) -> None:
    """Run Blender's extension tool, which needs no Blender but comes in bpy's wheel."""
    bpy = importlib.util.find_spec("bpy")
    tools = sorted(Path(bpy.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")) if bpy else []
    if not tools:
        raise LockError("Blender's extension tool comes with bpy, which this Python doesn't have; run `make setup`")
    done = subprocess.run(
        [sys.executable, str(tools[-1]), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
    )
    if done.returncode:
        raise LockError(f"Blender's extension tool refused to {arguments[0]}:\n{done.stdout}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--platform", action="append", choices=[*PLATFORMS, "all"], help="a zip each; this machine's by default"
    )
    parser.add_argument("--python", action="append", choices=PYTHONS, help=f"{PYTHONS[0]} by default; may be given twice")
    parser.add_argument("--leave-out", action="append", default=[], metavar="PACKAGE", help="don't bundle this one")
    parser.add_argument("--validate", action="store_true", help="only validate the repository's manifest")
    options = parser.parse_args()
    if options.validate:
        blender_extension("validate", str(ROOT))
        return
    platforms = options.platform or [this_platform()]
    pythons = tuple(sorted(options.python or PYTHONS[:1]))
    for platform in PLATFORMS if "all" in platforms else platforms:
        archive = build(platform, pythons, frozenset(options.leave_out))
        print(f"{archive.relative_to(ROOT)}: {archive.stat().st_size / 1e6:.0f} MB")


if __name__ == "__main__":
    try:
        main()
    except LockError as error:
        sys.exit(f"extension: {error}")
