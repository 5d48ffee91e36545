"""The worker process: `python -m ct2hair_addon.jobs.worker JOB` runs the job of a folder and says how it goes.

It speaks JSON lines on standard output; whatever else prints goes to the job's log. It is cancelled by SIGTERM, SIGINT or
the line "cancel" on its standard input, and ends when the process that started it goes away.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from ..errors import Cancelled, explained
from .folder import JobFolder
from .messages import ERROR, KINDS, PROGRESS, RESULT, STATUS, WARNING, Message

PARENT = "CT2HAIR_PARENT"
"""Environment variable with the process id of the starter: where it is set, the worker ends when its standard input does."""
LOG_LEVEL = "CT2HAIR_LOG_LEVEL"
"""Environment variable: `quiet` logs warnings and errors alone, `verbose` every progress message as well."""
DONE, FAILED, CRASHED, STOPPED = 0, 1, 3, 130
"""Exit codes: done, refused with a clear error, an unforeseen error, cancelled."""


def main(job: str) -> int:
    """Run the job in folder `job`; returns the exit code."""
    folder = JobFolder(Path(job))
    say = _protect_stdout(folder)
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    if PARENT in os.environ:
        threading.Thread(target=_listen, args=(stopped,), daemon=True).start()
    try:
        say(Message(STATUS, {"stage": "start", "text": "starting the engine"}))
        from .. import pipeline  # late: importing the engine takes seconds, and the starter should hear something first

        if stopped.is_set():
            raise Cancelled
        scan, out, settings, raw_shape, raw_type, until = folder.read()
        observer = _Speaker(say, stopped)
        result = pipeline.reconstruct(
            scan, out, settings, raw_shape=raw_shape, raw_type=raw_type, observer=observer, until=until
        )
        told = {"strands": 0, "seconds": 0.0} if result is None else {"strands": len(result.hair), "seconds": result.seconds}
        say(Message(RESULT, {"out": str(out), "until": until, **told}))
        return DONE
    except Cancelled:
        say(Message(ERROR, {"text": "cancelled; the finished stages are kept", "log": str(folder.log), "cancelled": True}))
        return STOPPED
    except Exception as error:
        traceback.print_exc()
        text = explained(error)
        known = text is not None
        text = text if known else f"unforeseen {type(error).__name__}: {error}"
        say(Message(ERROR, {"text": text, "log": str(folder.log), "cancelled": False}))
        return FAILED if known else CRASHED


def _protect_stdout(folder: JobFolder) -> Callable[[Message], None]:
    """Keep the real standard output for messages; send everything else that prints, native code too, to the log."""
    folder.path.mkdir(parents=True, exist_ok=True)
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    log = folder.log.open("a", encoding="utf-8", buffering=1)
    os.dup2(log.fileno(), 1)
    os.dup2(log.fileno(), 2)
    sys.stdout = sys.stderr = log
    print(time.strftime("--- %Y-%m-%d %H:%M:%S"), " ".join(sys.argv), "process", os.getpid())
    lock = threading.Lock()
    level = os.environ.get(LOG_LEVEL, "normal")
    logged = {"quiet": (WARNING, ERROR), "verbose": KINDS}.get(level, (STATUS, WARNING, ERROR, RESULT))

    def say(message: Message) -> None:
        if message.kind in logged:
            print(message.to_line(), end="")
        with lock:
            try:
                channel.write(message.to_line())
            except (BrokenPipeError, ValueError):
                os._exit(STOPPED)

    return say


def _listen(stopped: threading.Event) -> None:
    """Obey the starter's words; leave at once when it is gone (a stage's file is renamed when whole, so nothing breaks)."""
    for line in sys.stdin:
        if line.strip() == "cancel":
            stopped.set()
    os._exit(STOPPED)


class _Speaker:
    """The pipeline's observer that speaks to the starter, a few times a second at most."""

    INTERVAL = 0.1

    def __init__(self, say: Callable[[Message], None], stopped: threading.Event) -> None:
        self._say, self._stopped, self._last = say, stopped, 0.0

    def started(self, stage: str, text: str) -> None:
        self._say(Message(STATUS, {"stage": stage, "text": text}))

    def warned(self, text: str) -> None:
        self._say(Message(WARNING, {"text": text}))

    def progressed(self, stage: str, fraction: float, total: float, remaining: float | None) -> None:
        if self._stopped.is_set():
            raise Cancelled
        now = time.monotonic()
        if now - self._last >= self.INTERVAL or fraction >= 1.0:
            self._last = now
            values = {"stage": stage, "fraction": fraction, "total": total, "remaining": remaining}
            self._say(Message(PROGRESS, values))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
