"""The lock: which wheel files, by hash, the extension's zip and the environments are made of, and how it is written.

`python wheels/lock.py` (make lock) asks the package index for the wheels of every version in pins.toml, writes lock.toml
and the wheels of the extension's manifest. Everything else only reads lock.toml. Standard library only: this runs before
any package is there.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WHEELS = ROOT / "wheels"
PINS = WHEELS / "pins.toml"
LOCK = WHEELS / "lock.toml"
MANIFEST = ROOT / "blender_manifest.toml"

# Blender's names of the platforms, and the tags of the wheels that install on them: newest first, as pip prefers them.
# manylinux_2_28 is what Blender itself asks of a Linux machine; torch has no wheel for a macOS before 14.
PLATFORMS = {
    "linux-x64": [
        *(f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)),
        *(f"manylinux{year}_x86_64" for year in (2014, 2010, 1)),
    ],
    "windows-x64": ["win_amd64"],
    "macos-arm64": ["macosx_14_0_arm64"],
}
PYTHONS = ("3.11", "3.13")  # of Blender 4.5 to 5.0, and of 5.1 and later

BEGIN, END = "# The wheels of lock.toml; `make lock` writes this list.\n", "# End of the wheels.\n"


class LockError(Exception):
    """The lock doesn't have what was asked of it, or the index doesn't have what the lock asks."""


@dataclass(frozen=True)
class Target:
    """One platform and Python that wheels are chosen for."""

    platform: str
    python: str

    def __str__(self) -> str:
        return f"{self.platform}, Python {self.python}"

    def fits(self, wheel: str) -> bool:
        """Whether a wheel file installs here, by the tags in its name (Blender's rule for the wheels of an extension)."""
        python, abi, tag = wheel.removesuffix(".whl").split("-")[-3:]
        if tag != "any":
            if self.platform == "macos-arm64":
                ours = tag.startswith("macosx_") and tag.endswith(("_arm64", "_universal2"))
            else:
                ours = any(part in PLATFORMS[self.platform] for part in tag.split("."))
            if not ours:
                return False
        major, minor = self.python.split(".")
        for part in python.split("."):
            if part in (f"py{major}", f"cp{major}{minor}") and abi in ("none", "abi3", f"cp{major}{minor}"):
                return True
            if abi == "abi3" and (older := re.fullmatch(rf"cp{major}(\d+)", part)) and int(older[1]) <= int(minor):
                return True
        return False

    def pip_options(self) -> list[str]:
        """What makes pip choose wheels for this target, whichever Python runs pip."""
        tags = [option for tag in PLATFORMS[self.platform] for option in ("--platform", tag)]
        return [*tags, "--python-version", self.python, "--implementation", "cp", "--only-binary=:all:", "--no-deps"]


TARGETS = tuple(Target(name, python) for python in PYTHONS for name in PLATFORMS)


def this_platform() -> str:
    """Blender's name of the platform that this runs on. LockError where the lock has no wheels for it."""
    names = {("linux", "x86_64"): "linux-x64", ("windows", "amd64"): "windows-x64", ("darwin", "arm64"): "macos-arm64"}
    here = (platform.system().lower(), platform.machine().lower())
    if here not in names:
        raise LockError(f"the lock has no wheels for {here[0]} on {here[1]}, only for {', '.join(PLATFORMS)}")
    return names[here]


def this_target() -> Target:
    """The platform and Python that this runs on. LockError where the lock has no wheels for them."""
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if python not in PYTHONS:
        raise LockError(f"the lock has wheels for Python {' and '.join(PYTHONS)}, and this is Python {python}")
    return Target(this_platform(), python)


def locked(group: str, target: Target, lock: dict | None = None) -> dict[str, tuple[str, str]]:
    """The wheels of a group for a target: name -> (file, sha256). LockError where the lock lacks one."""
    lock = read_lock() if lock is None else lock
    found = {}
    for name in pinned(group, target):
        files = [(file, digest) for file, digest in lock[group].get(name, {}).items() if target.fits(file)]
        files = [(file, digest) for file, digest in files if version_of(file) == pinned(group, target)[name]]
        if len(files) != 1:
            raise LockError(f"lock.toml has {len(files)} wheels of {name} for {target}, not one; run `make lock`")
        found[name] = files[0]
    return found


def pinned(group: str, target: Target) -> dict[str, str]:
    """The versions that pins.toml asks of a group for a target: name -> version."""
    pins = tomllib.loads(PINS.read_text(encoding="utf-8"))[group]
    pins = pins[target.python] if group == "blender" else pins
    versions = {name: pin if isinstance(pin, str) else pin.get(target.platform) for name, pin in pins.items()}
    return {name: version for name, version in versions.items() if version}


def read_lock() -> dict:
    """lock.toml as it stands: group -> name -> file -> sha256."""
    return tomllib.loads(LOCK.read_text(encoding="utf-8")) if LOCK.exists() else {}


def version_of(wheel: str) -> str:
    """The version in a wheel's file name."""
    return wheel.split("-")[1]


def requirements(wheels: dict[str, tuple[str, str]]) -> str:
    """A pip requirements file of exactly these wheels, each with its one hash.

    `===`, for `==2.13.0` would take a local 2.13.0+cpu as well.
    """
    return "".join(f"{name}==={version_of(file)} --hash=sha256:{digest}\n" for name, (file, digest) in wheels.items())


def pip(*arguments: str, python: str = sys.executable, quiet: bool = False) -> None:
    """Run pip. LockError with the last lines of what it said where it fails."""
    done = subprocess.run(
        [python, "-m", "pip", *arguments],
        env={**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_ROOT_USER_ACTION": "ignore"},
        stdout=subprocess.DEVNULL if quiet else None,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
    )
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if not line.startswith("WARNING")]
        raise LockError("pip failed:\n" + "\n".join(errors[-6:]))


def pip_requirements(command: str, wheels: dict[str, tuple[str, str]], *options: str, python: str = sys.executable) -> None:
    """Run `pip install` or `pip download` for exactly these wheels, by hash."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "requirements.txt"
        file.write_text(requirements(wheels), encoding="utf-8")
        pip(command, "-q", "--require-hashes", "--no-deps", "--only-binary=:all:", *options, "-r", str(file), python=python)


def find_wheels(names: dict[str, str], target: Target, python: str) -> dict[str, tuple[str, str]]:
    """Ask the index for the wheels of these versions for a target: name -> (file, sha256). Downloads only what is local."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        options = ["--dry-run", "--ignore-installed", "-q", "--target", folder, "--report", str(report), *target.pip_options()]
        pip("install", *options, *(f"{name}==={version}" for name, version in names.items()), python=python)
        found = {}
        for item in json.loads(report.read_text(encoding="utf-8"))["install"]:
            name = re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower()
            file = item["download_info"]["url"].rsplit("/", 1)[1].replace("%2B", "+")
            found[name] = (file, item["download_info"]["archive_info"]["hashes"]["sha256"])
        return found


def update(python: str) -> None:
    """Write lock.toml anew from pins.toml and the index, keeping what the index at hand doesn't serve, and the manifest."""
    old, new = read_lock(), {}
    for group in tomllib.loads(PINS.read_text(encoding="utf-8")):
        for target in TARGETS:
            names = pinned(group, target)
            if not names:
                continue
            print(f"{group}: {target}", flush=True)
            try:
                found = find_wheels(names, target, python)
            except LockError:  # one that isn't served spoils the batch: one by one
                found = {}
                for name, version in names.items():
                    try:
                        found |= find_wheels({name: version}, target, python)
                    except LockError as error:
                        kept = {n: w for n, w in locked_or_none(group, target, old).items() if n == name}
                        if not kept:
                            raise LockError(f"no wheel of {name} {version} for {target}: {error}") from None
                        print(f"  kept as it was, for this index doesn't serve it: {kept[name][0]}")
                        found |= kept
            for name, (file, digest) in found.items():
                new.setdefault(group, {}).setdefault(name, {})[file] = digest
    lines = ["# The wheels of the versions in pins.toml, by sha256, for every platform and Python. Made by `make lock`.\n"]
    for group, packages in new.items():
        for name in sorted(packages):
            lines += [f"\n[{group}.{name}]\n", *(f'"{file}" = "{packages[name][file]}"\n' for file in sorted(packages[name]))]
    LOCK.write_text("".join(lines), encoding="utf-8")
    MANIFEST.write_text(manifest_with_wheels(MANIFEST.read_text(encoding="utf-8"), bundled_wheels(TARGETS)), encoding="utf-8")


def locked_or_none(group: str, target: Target, lock: dict) -> dict[str, tuple[str, str]]:
    """As `locked`, of whatever of the group is there."""
    names = pinned(group, target)
    files = ((name, file, digest) for name in names for file, digest in lock.get(group, {}).get(name, {}).items())
    return {name: (file, digest) for name, file, digest in files if target.fits(file) and version_of(file) == names[name]}


def bundled_wheels(targets: tuple[Target, ...], leave_out: frozenset[str] = frozenset()) -> list[str]:
    """The files that the extension bundles for some targets, sorted."""
    return sorted({file for t in targets for name, (file, _) in locked("bundle", t).items() if name not in leave_out})


def manifest_with_wheels(manifest: str, files: list[str], platforms: list[str] | None = None) -> str:
    """The manifest's text with another list of wheels and, if given, of platforms."""
    head, rest = manifest.split(BEGIN)
    tail = rest.split(END)[1]
    wheels = "".join(f'  "./wheels/{file}",\n' for file in files)
    if platforms is not None:
        head = re.sub(r"(?m)^platforms = .*$", f"platforms = {json.dumps(platforms)}", head)
    return f"{head}{BEGIN}wheels = [\n{wheels}]\n{END}{tail}"


def main() -> None:
    # --report and --dry-run want a newer pip than the one that an environment may begin with
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = str(Path(folder) / "bin" / "python")
        pip("install", "-q", "--upgrade", "pip", python=python)
        update(python)


if __name__ == "__main__":
    try:
        main()
    except LockError as error:
        sys.exit(f"lock: {error}")
