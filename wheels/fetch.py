"""Fetches the wheels that the extension bundles, by hash, for any platform and Python: `python wheels/fetch.py --help`.

They land in wheels/, where the manifest names them; git ignores them. What is there already is checked, not fetched again.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path

from lock import PLATFORMS, PYTHONS, WHEELS, LockError, Target, locked, pip_requirements, this_platform


def fetch(target: Target, leave_out: frozenset[str] = frozenset(), python: str = sys.executable) -> list[Path]:
    """The target's wheels in wheels/, fetched where they aren't there yet. LockError names one that can't be had."""
    wheels = {name: wheel for name, wheel in locked("bundle", target).items() if name not in leave_out}
    missing = {name: wheel for name, wheel in wheels.items() if not is_there(*wheel)}
    if missing:
        print(f"fetching {len(missing)} wheels for {target}", flush=True)
    # torch by itself: it alone may not be served (see pins.toml), and the message should say so
    for part in (missing.keys() - {"torch"}, missing.keys() & {"torch"}):
        if part:
            pip_requirements(
                "download",
                {name: missing[name] for name in sorted(part)},
                *target.pip_options(),
                "-d",
                str(WHEELS),
                python=python,
            )
    for name, wheel in missing.items():
        if not is_there(*wheel):
            raise LockError(f"the package index gave another file for {name} than the locked {wheel[0]}")
    return [WHEELS / file for file, _ in wheels.values()]


def is_there(file: str, digest: str) -> bool:
    """Whether wheels/ has this very file; one with another content is removed."""
    path = WHEELS / file
    if not path.exists():
        return False
    with path.open("rb") as stream:
        if hashlib.file_digest(stream, "sha256").hexdigest() == digest:
            return True
    path.unlink()
    return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--platform", action="append", choices=[*PLATFORMS, "all"], help="this machine's by default")
    parser.add_argument("--python", action="append", choices=PYTHONS, help=f"{PYTHONS[0]} by default; may be given twice")
    parser.add_argument("--leave-out", action="append", default=[], metavar="PACKAGE", help="don't fetch this one")
    options = parser.parse_args()
    platforms = options.platform or [this_platform()]
    for name in PLATFORMS if "all" in platforms else platforms:
        for python in options.python or PYTHONS[:1]:
            fetch(Target(name, python), frozenset(options.leave_out))


if __name__ == "__main__":
    try:
        main()
    except LockError as error:
        sys.exit(f"fetch: {error}")
