"""Kernels compiled ahead: while a command reads its scan, a second process compiles what it will need later.

numba compiles a kernel when it is first called, on one core, and keeps it on disk: a first reconstruction spends minutes
there. kernels.txt lists what each command calls, in its order; the helper works from the list's end towards its start, so
that the two meet in the middle. Nothing depends on it: what it didn't come to, numba compiles when it is called.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
LIST = FOLDER / "kernels.txt"
OWN_NAME = "ct2hair_addon"
"""Loaded by another name, inside Blender, kernels lie elsewhere than those that the helper would compile."""
SILENCE = 90.0
"""A helper that hasn't begun a kernel for so long, seconds, is gone."""


@contextmanager
def compiled_ahead(*commands: str) -> Iterator[None]:
    """Within it, another process compiles the kernels of `commands`, of those in kernels.txt, unless that is done or being
    done. It ends with the block, and with this process."""
    helper = _helper(commands) if _wanted(commands) else None
    try:
        yield
    finally:
        if helper is not None:
            helper.kill()
            helper.wait()
            with suppress(OSError):
                _beat().unlink()


def listed(commands: Iterable[str]) -> list[str]:
    """The lines of kernels.txt of these commands, in its order, each once."""
    lines: dict[str, list[str]] = {}
    for line in LIST.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            current = lines.setdefault(line.strip("[]"), [])
        elif line and not line.startswith("#"):
            current.append(line)
    return list(dict.fromkeys(line for command in commands for line in lines[command]))


def understood(line: str) -> tuple[Any, tuple[Any, ...]]:
    """The kernel and the numba types of a line like `volume.grid.gather(int32[:, ::1], float64)`."""
    from numba import types

    path, _, kinds = line.removesuffix(")").partition("(")
    module, _, name = path.rpartition(".")
    kernel = getattr(importlib.import_module(f"{__package__}.{module}"), name)
    return kernel, tuple(eval(f"[{kinds}]", {kind: getattr(types, kind) for kind in dir(types)}))


def compile_kernel(line: str) -> None:
    """Compile what a line says, or load it where it is compiled already."""
    kernel, kinds = understood(line)
    kernel.compile(kinds)


@contextmanager
def recorded() -> Iterator[list[str]]:
    """Gives a list that fills with the lines of the kernels of this package which are called first within the block."""
    from numba.core.dispatcher import Dispatcher

    lines: list[str] = []
    compile_, within = Dispatcher.compile, []

    def noted(kernel, kinds):
        module = kernel.py_func.__module__
        if not within and module.startswith(__package__):  # not those that other kernels call
            lines.append(f"{module[len(__package__) + 1 :]}.{kernel.py_func.__name__}({', '.join(map(_written, kinds))})")
        within.append(kernel)
        try:
            return compile_(kernel, kinds)
        finally:
            within.pop()

    Dispatcher.compile = noted
    try:
        yield lines
    finally:
        Dispatcher.compile = compile_


def _written(kind: Any) -> str:
    """A numba type as Python that makes it from the names in `numba.types`."""
    from numba import types

    if isinstance(kind, types.Array) and kind.mutable and kind.aligned:
        axes = [":"] * kind.ndim
        if kind.layout != "A":
            axes[-1 if kind.layout == "C" else 0] = "::1"
        return f"{_written(kind.dtype)}[{', '.join(axes)}]"
    if isinstance(kind, types.BaseTuple):
        return f"Tuple([{', '.join(map(_written, kind))}])"
    if isinstance(kind, types.Omitted):
        return f"Omitted({kind.value!r})"
    return {"bool": "boolean"}.get(str(kind), str(kind))


def _wanted(commands: Sequence[str]) -> bool:
    """Whether a helper would be of use: kernels lie where the helper puts them, a core is free for it, not all is done."""
    import numba

    if __package__ != OWN_NAME or "NUMBA_CACHE_DIR" not in os.environ:
        return False
    if numba.config.DISABLE_JIT or numba.get_num_threads() < 2:
        return False
    with suppress(OSError):
        now = fingerprint()
        if all(_stamp(command).read_text(encoding="utf-8") == now for command in commands):
            return False
    with suppress(OSError):
        return time.time() - _beat().stat().st_mtime > SILENCE
    return True


def fingerprint() -> str:
    """What compiled kernels hold for: these sources, this numba, this Python, this machine."""
    files = sorted(FOLDER.rglob("*.py"))
    known = [(str(path), path.stat().st_mtime_ns, path.stat().st_size) for path in (LIST, *files)]
    return hashlib.sha256(repr((known, version("numba"), sys.version, platform.node())).encode()).hexdigest()


def _stamp(command: str) -> Path:
    return Path(os.environ["NUMBA_CACHE_DIR"]) / f"ahead-{command}.txt"


def _beat() -> Path:
    return Path(os.environ["NUMBA_CACHE_DIR"]) / "ahead.txt"


def _helper(commands: Sequence[str]) -> subprocess.Popen[bytes] | None:
    paths = [str(FOLDER.parent), os.environ.get("PYTHONPATH", "")]
    try:
        return subprocess.Popen(
            [sys.executable, "-m", __name__, *commands],
            stdin=subprocess.PIPE,  # closed by our end, whatever that is: see `_main`
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError:
        return None


def _main(commands: Sequence[str]) -> None:
    """The helper: compiles, says that it lives, and leaves when its starter is gone."""

    def listen() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    with suppress(AttributeError, OSError):
        os.nice(10)  # it takes the core that the command leaves free
    before, beat = fingerprint(), _beat()
    beat.parent.mkdir(parents=True, exist_ok=True)
    for line in reversed(listed(commands)):
        beat.touch()
        with suppress(Exception):  # what doesn't compile will say so where it is called
            compile_kernel(line)
    for command in commands:
        _stamp(command).write_text(before, encoding="utf-8")
    beat.unlink(missing_ok=True)


if __name__ == "__main__":
    _main(sys.argv[1:])
