"""Makes .venv: Blender as a Python module, what the extension bundles, and the test tools, all from the lock, by hash.

The engine's packages come from the very wheels that the zip bundles. Run by `make setup`; with another Python and
`--folder`, the same for that Python's Blender. Says what of the system is missing, and installs it where it may.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
from pathlib import Path

from fetch import fetch
from lock import LOCK, PINS, ROOT, WHEELS, LockError, Target, locked, pip_requirements, this_target
from system_libraries import MissingFromSystem, ensure_libraries, ensure_venv

STAMP = "ct2hair.lock"  # in the environment's folder: what it was made from


def make(folder: Path, torch: str) -> None:
    """Make or bring up to date an environment for the Python that runs this; `torch` is "any", "cpu" or "none"."""
    stamp = folder / STAMP
    made_from = hashlib.sha256(LOCK.read_bytes() + PINS.read_bytes() + torch.encode()).hexdigest()
    if not (stamp.exists() and stamp.read_text(encoding="utf-8") == made_from):
        target = this_target()
        ensure_venv()
        stamp.unlink(missing_ok=True)
        print(f"making {folder.name} for {target}", flush=True)
        # links, not copies: Python finds its own library through them wherever it was installed
        subprocess.run([sys.executable, "-m", "venv", "--symlinks", str(folder)], check=True)
        python = str(folder / "bin" / "python")
        install_bundle(target, python, torch)
        pip_requirements("install", locked("blender", target), python=python)
        pip_requirements("install", locked("tools", target), python=python)
        stamp.write_text(made_from, encoding="utf-8")
    check_blender(folder)


def install_bundle(target: Target, python: str, torch: str) -> None:
    """Install the engine's packages from the wheels of the zip, torch from PyPI's CUDA build where there is no other."""
    bundle, leave_out = locked("bundle", target), frozenset({"torch"})
    fetch(target, leave_out, python)
    if torch != "none":
        try:
            fetch(target, frozenset(bundle) - leave_out, python)
            leave_out = frozenset()
        except LockError:
            if torch == "cpu" or not locked("cuda", target):
                raise
    wheels = {name: wheel for name, wheel in bundle.items() if name not in leave_out}
    pip_requirements("install", wheels, "--no-index", "--find-links", str(WHEELS), python=python)
    if leave_out and torch == "any":
        print(
            "The package index has no CPU build of torch for this Python, so its CUDA build is installed, with gigabytes of\n"
            "NVIDIA's packages. It runs on the CPU as well. To get the small one, name PyTorch's own package index for\n"
            "CPU builds in PIP_EXTRA_INDEX_URL, remove the environment and run this again.",
            flush=True,
        )
        pip_requirements("install", locked("cuda", target), python=python)


def check_blender(folder: Path) -> None:
    """See that Blender finds its system libraries and starts; MissingFromSystem or LockError where not."""
    (package,) = folder.glob("lib/python3.*/site-packages/bpy")
    ensure_libraries(package / "__init__.so", *package.glob("*/python/lib/python3.*/site-packages/openvdb*.so"))
    done = subprocess.run(
        [str(folder / "bin" / "python"), "-c", "import bpy; print(bpy.app.version_string)"],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    if done.returncode:
        raise LockError(f"Blender is installed in {folder.name} but doesn't start:\n{done.stderr.strip()}")
    print(f"{folder.name}: Blender {done.stdout.strip().splitlines()[-1]}, Python {sys.version.split()[0]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=ROOT / ".venv")
    parser.add_argument(
        "--torch",
        choices=("any", "cpu", "none"),
        default="any",
        help="any: the CPU build, or PyPI's CUDA build where that isn't served; cpu: or fail; none: leave it out",
    )
    options = parser.parse_args()
    make(options.folder.resolve(), options.torch)


if __name__ == "__main__":
    try:
        main()
    except (LockError, MissingFromSystem) as error:
        sys.exit(f"setup: {error}")
