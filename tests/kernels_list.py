"""Writes ct2hair_addon/kernels.txt anew: what each command compiles, in its order. `make kernels`; minutes."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

SCAN = ("bob", "--strands", "800", "--spacing", "1.2", "--seed", "5")
HEAD = "# What each command compiles, in the order of its need; kernels.py reads it, `make kernels` writes it.\n"


def record(command: list[str]) -> list[str]:
    """The lines of one command, in a process of its own, so that nothing was called before."""
    done = subprocess.run(
        [sys.executable, __file__, "--", *command], stdout=subprocess.PIPE, encoding="utf-8", check=True, cwd=ROOT
    )
    return done.stdout.splitlines()


def recorded_command(command: list[str]) -> None:
    """Run one command here and print its lines."""
    import contextlib

    from ct2hair_addon import kernels
    from ct2hair_addon.cli import main

    with kernels.recorded() as lines, contextlib.redirect_stdout(sys.stderr):
        if code := main(command):
            sys.exit(code)
    print("\n".join(dict.fromkeys(lines)))


def write(target: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        scan, out, paper = f"{folder}/bob.nrrd", f"{folder}/out", f"{folder}/paper"
        commands = {
            "synthesize": ["synthesize", *SCAN, "--out", scan],
            "reconstruct": ["reconstruct", scan, "--out", out],
            "paper": ["reconstruct", scan, "--out", paper, "--preset", "paper", "--strands", "800"],
            "evaluate": ["evaluate", f"{folder}/bob.strands.npz", f"{out}/hair.npz", "--head", f"{out}/head.obj"],
        }
        parts = [f"[{name}]\n" + "".join(f"{line}\n" for line in record(command)) for name, command in commands.items()]
    target.write_text(HEAD + "\n" + "\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", nargs="*", help="record this command alone, to standard output")
    chosen = parser.parse_args()
    if chosen.command:
        recorded_command(chosen.command)
    else:
        write(ROOT / "ct2hair_addon" / "kernels.txt")
