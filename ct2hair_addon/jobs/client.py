"""The other end of the worker: start a job in the background, ask how it goes, cancel it."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..cache import cache_folder
from ..settings import Settings
from .folder import JobFolder
from .messages import ERROR, PROGRESS, RESULT, STATUS, WARNING, Message
from .worker import PARENT

GRACE = 1.5
"""Seconds between the request to stop and the kill: a cancelled job is gone within two seconds."""
ROOT = Path(__file__).resolve().parents[2]
"""The folder that holds `ct2hair_addon`: the extension's root."""


@dataclass
class Job:
    """A running or finished worker. `poll` never blocks; the other fields say what it told so far."""

    folder: JobFolder
    process: subprocess.Popen
    stage: str = "start"
    text: str = ""
    fraction: float = 0.0
    remaining: float | None = None
    warnings: list[str] = field(default_factory=list)
    error: str | None = None
    cancelled: bool = False
    result: Message | None = None
    _messages: queue.SimpleQueue = field(default_factory=queue.SimpleQueue, repr=False)
    _reader: threading.Thread | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def log_path(self) -> Path:
        return self.folder.log

    @property
    def exit_code(self) -> int | None:
        """The worker's exit code, None while it runs."""
        return self.process.poll()

    @property
    def running(self) -> bool:
        """Whether there is more to hear: the process lives or its last words are not read yet."""
        return self._reader.is_alive() or not self._messages.empty() or self.process.poll() is None

    def poll(self) -> list[Message]:
        """The messages since the last call; updates stage, fraction, remaining (s), warnings, error and result."""
        heard = []
        while not self._messages.empty():
            message = self._messages.get()
            heard.append(message)
            self._note(message)
        if not heard and not self.running and self.result is None and self.error is None:
            code = self.exit_code
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            text = f"the worker ended without a word ({how}); its log is {self.log_path}"
            heard.append(Message(ERROR, {"text": text, "log": str(self.log_path), "cancelled": self.cancelled}))
            self._note(heard[-1])
        return heard

    def cancel(self) -> None:
        """Ask the worker to stop, and kill it if it has not within `GRACE` seconds. Returns at once."""
        if self.process.poll() is not None:
            return
        self.cancelled = True
        try:
            self.process.stdin.write("cancel\n")
            self.process.stdin.flush()
        except OSError:
            pass
        threading.Thread(target=self._end, daemon=True).start()

    def close(self) -> None:
        """End the worker now, for when Blender or the file closes. Finished stages stay."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def wait(self, timeout: float | None = None) -> Message | None:
        """Block until the job has ended; the result message, or None after an error."""
        self.process.wait(timeout)
        self._reader.join(timeout)
        while self.poll():
            pass
        return self.result

    def _end(self) -> None:
        try:
            self.process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self.process.kill()

    def _read(self) -> None:
        for line in self.process.stdout:
            try:
                self._messages.put(Message.from_line(line))
            except ValueError:
                self._messages.put(Message(WARNING, {"text": f"unreadable line from the worker: {line.strip()[:200]}"}))

    def _note(self, message: Message) -> None:
        data = message.data
        if message.kind == STATUS:
            self.stage, self.text = data["stage"], data["text"]
        elif message.kind == PROGRESS:
            self.stage, self.fraction, self.remaining = data["stage"], data["total"], data["remaining"]
        elif message.kind == WARNING:
            self.warnings.append(data["text"])
        elif message.kind == ERROR:
            self.error, self.cancelled = data["text"], data["cancelled"] or self.cancelled
        elif message.kind == RESULT:
            self.result, self.fraction, self.remaining = message, 1.0, 0.0


def start(
    scan: str | os.PathLike,
    out: str | os.PathLike,
    settings: Settings,
    *,
    raw_shape: Iterable[int] | None = None,
    raw_type: str | None = None,
    python: str | None = None,
    paths: Iterable[str] = (),
    environment: Mapping[str, str] | None = None,
    until: str | None = None,
) -> Job:
    """Start the reconstruction of `scan` into `out` in a background process.

    python: the interpreter of the worker, this one by default. paths: folders that it needs on `sys.path` beside the
    extension's root and this interpreter's own site-packages (where the wheels of Blender's extensions lie, say).
    environment: variables for it (see `worker.LOG_LEVEL`, `cache.cache_folder`). until: the stage to stop after, or None.
    """
    folder = JobFolder.create(Path(scan), Path(out), settings, raw_shape, raw_type, until)
    with folder.log.open("a", encoding="utf-8") as log:
        process = subprocess.Popen(
            [python or sys.executable, "-m", "ct2hair_addon.jobs.worker", str(folder.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            encoding="utf-8",
            env=_environment(paths, own=python is None, more=environment),
            cwd=ROOT,
        )
    return Job(folder, process)


def start_command(
    arguments: Iterable[str], log: Path, *, python: str | None = None, environment: Mapping[str, str] | None = None
) -> subprocess.Popen:
    """Start a command of the command line (`["inspect", SCAN, ...]`) in the background; what it prints goes to `log`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w", encoding="utf-8") as file:
        return subprocess.Popen(
            [python or sys.executable, "-m", "ct2hair_addon", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=_environment((), own=python is None, more=environment),
            cwd=ROOT,
        )


@dataclass(frozen=True)
class PythonFound:
    """What `check_python` found: version, device ("cpu" or a card's name), and the modules that are missing."""

    version: str = ""
    device: str = ""
    missing: tuple[str, ...] = ()
    problem: str = ""

    @property
    def usable(self) -> bool:
        return not self.problem and not self.missing


NEEDED = ("numpy", "scipy", "numba", "skimage", "torch", "openvdb")


def check_python(python: str | None = None, timeout: float = 120.0) -> PythonFound:
    """Ask a Python whether it can run the worker: its version, what the engine needs of it, its CUDA card. Takes seconds."""
    script = (
        "import importlib, json, platform\n"
        "missing = []\n"
        f"for name in {NEEDED!r}:\n"
        "    try: importlib.import_module(name)\n"
        "    except Exception: missing.append(name)\n"
        "device = 'cpu'\n"
        "if 'torch' not in missing:\n"
        "    import torch\n"
        "    device = torch.cuda.get_device_name(0) if torch.cuda.is_available() else 'cpu'\n"
        "print(json.dumps([platform.python_version(), device, missing]))\n"
    )
    command = [python or sys.executable, "-c", script]
    try:
        run = subprocess.run(
            command,
            capture_output=True,
            encoding="utf-8",
            timeout=timeout,
            check=False,
            env=_environment((), own=python is None),
        )
        version, device, missing = json.loads(run.stdout.strip().splitlines()[-1])
    except FileNotFoundError:
        return PythonFound(problem=f"{python}: there is no such program")
    except (OSError, subprocess.TimeoutExpired) as error:
        return PythonFound(problem=f"{command[0]}: can't be run ({error})")
    except (IndexError, ValueError):
        return PythonFound(problem=f"{command[0]}: does not answer as a Python does: {run.stderr.strip()[-200:]}")
    return PythonFound(version, device, tuple(missing))


def _environment(paths: Iterable[str], own: bool, more: Mapping[str, str] | None = None) -> dict[str, str]:
    """The worker's environment. Another Python gets the engine alone: our site-packages would be of the wrong version."""
    inherited = [entry for entry in sys.path if entry.rstrip("/\\").endswith("site-packages")] if own else []
    folders = dict.fromkeys([str(ROOT), *map(str, paths), *inherited])
    ours = {"PYTHONPATH": os.pathsep.join(folders), "PYTHONUTF8": "1", PARENT: str(os.getpid())}  # its log is UTF-8 anywhere
    environment = {**os.environ, **ours, **(more or {})}
    environment.pop("PYTHONHOME", None)
    kernels = environment.get("NUMBA_CACHE_DIR", "")
    if kernels.startswith(str(cache_folder() / "kernels")):
        del environment["NUMBA_CACHE_DIR"]  # ours, for the name that we are loaded by; the worker is loaded by another
    return environment
