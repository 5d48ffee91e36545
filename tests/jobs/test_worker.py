"""The worker and its client: messages, cancelling in under two seconds, crashes, an orphan's end.

The engine is replaced by a short script, put in the worker's way through `sitecustomize`, so that each behaviour can be had
at will; the real pipeline in a worker is tested with the whole job.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.jobs import Job, JobFolder, Message, client, start
from ct2hair_addon.settings import Settings

PIPELINE = '''
"""A pipeline that behaves as the scan's name says."""
import os, sys, time, types
from pathlib import Path

pipeline = types.ModuleType("ct2hair_addon.pipeline")


def reconstruct(scan, out, settings, *, raw_shape, raw_type, observer, until):
    from ct2hair_addon.errors import ScanError

    observer.started("scan", "reading the scan")
    Path(out, "pid").write_text(str(os.getpid()))
    behaviour = Path(scan).stem
    if behaviour == "fine":
        print("noise that must not reach the protocol")
        os.system("echo native noise")
        observer.warned("assumed a spacing")
        observer.progressed("scan", 1.0, 0.5, 12.0)
        return types.SimpleNamespace(hair=[1, 2, 3], seconds=settings.guides.step)
    if behaviour == "refused":
        raise ScanError(f"{scan}: holds no hair")
    if behaviour == "bug":
        raise ZeroDivisionError("oh")
    if behaviour == "crash":
        os._exit(77)
    while True:
        if behaviour == "polite":
            observer.progressed("scan", 0.1, 0.1, None)
        time.sleep(0.02)


pipeline.reconstruct = reconstruct
sys.modules["ct2hair_addon.pipeline"] = pipeline
'''


@pytest.fixture
def begin(tmp_path):
    """Start a job on a scan of a name that says how the pipeline behaves."""
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(PIPELINE)
    jobs: list[Job] = []

    def begin(behaviour: str, settings: Settings | None = None) -> Job:
        jobs.append(start(tmp_path / f"{behaviour}.vdb", tmp_path / "out", settings or Settings(), paths=[str(folder)]))
        return jobs[-1]

    yield begin
    for job in jobs:
        job.close()


def wait_for(condition, seconds: float = 30.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.01)
    raise AssertionError("waited in vain")


def reached(job: Job, stage: str) -> bool:
    job.poll()
    return job.stage == stage


def alive(pid: int) -> bool:
    """Whether the process runs (a zombie doesn't)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_job_tells_its_stages_progress_warnings_and_result(begin):
    job = begin("fine", Settings().changed({"guides.step": 0.5}))
    result = job.wait(30)
    assert result.data["strands"] == 3 and result.data["seconds"] == 0.5
    assert job.warnings == ["assumed a spacing"] and job.error is None and job.exit_code == 0
    assert job.fraction == 1.0 and not job.running
    log = job.log_path.read_text(encoding="utf-8")
    assert "noise that must not reach the protocol" in log and "native noise" in log


def test_a_refusal_is_told_in_its_own_words_with_the_log(begin):
    job = begin("refused")
    assert job.wait(30) is None
    assert "holds no hair" in job.error and job.exit_code == 1
    assert "ScanError" in job.log_path.read_text(encoding="utf-8")


def test_a_bug_and_a_crash_name_the_log(begin):
    job = begin("bug")
    job.wait(30)
    assert "unforeseen ZeroDivisionError" in job.error and job.exit_code == 3
    job = begin("crash")
    job.wait(30)
    assert "exit code 77" in job.error and str(job.log_path) in job.error


@pytest.mark.parametrize("behaviour", ["polite", "stubborn"])
def test_cancel_returns_at_once_and_ends_the_process(begin, behaviour):
    job = begin(behaviour)
    wait_for(lambda: reached(job, "scan"))
    job.cancel()
    assert behaviour == "polite" or job.exit_code is None, "cancel must not block the window until the worker is gone"
    assert client.GRACE < 2.0  # the stubborn one would go on for ever
    wait_for(lambda: job.exit_code is not None)
    job.wait(5)
    assert job.cancelled and job.result is None


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_terminated_worker_says_that_it_was_cancelled(begin):
    job = begin("polite")
    wait_for(lambda: reached(job, "scan"))
    job.process.send_signal(signal.SIGTERM)
    job.wait(5)
    assert job.cancelled and "cancelled" in job.error and job.exit_code == 130


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_worker_ends_when_its_starter_is_killed(tmp_path):
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(PIPELINE)
    starter = (
        "import time\n"
        "from ct2hair_addon.jobs import start\n"
        "from ct2hair_addon.settings import Settings\n"
        f"job = start({str(tmp_path / 'stubborn.vdb')!r}, {str(tmp_path / 'out')!r}, Settings(), paths=[{str(folder)!r}])\n"
        "time.sleep(60)\n"
    )
    root = Path(__file__).resolve().parents[2]
    process = subprocess.Popen([sys.executable, "-c", starter], cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    try:
        pid = int(
            wait_for(lambda: (tmp_path / "out" / "pid").exists() and (tmp_path / "out" / "pid").read_text(encoding="utf-8"))
        )
        assert alive(pid)
        process.kill()
        process.wait()
        wait_for(lambda: not alive(pid))
    finally:
        process.kill()


def test_a_damaged_job_description_is_refused(tmp_path):
    folder = JobFolder.create(tmp_path / "a.vdb", tmp_path / "out", Settings(), (1, 2, 3), "<u2")
    assert folder.read() == (tmp_path / "a.vdb", tmp_path / "out", Settings(), (1, 2, 3), "<u2", None)
    folder.description.write_text('{"scan": 3')
    with pytest.raises(CT2HairError, match=r"job\.json: not a job description"):
        folder.read()


def test_messages_come_back_and_other_lines_are_refused():
    message = Message("progress", {"stage": "scan", "fraction": 0.5, "total": 0.1, "remaining": None})
    assert Message.from_line(message.to_line()) == message
    for line in ("hello", "[]", '{"kind": "gossip"}'):
        with pytest.raises(ValueError):
            Message.from_line(line)


def test_the_worker_keeps_its_kernels_apart_from_blender_s(monkeypatch):
    """Loaded as bl_ext..., the package compiles kernels that the worker, loaded by its own name, could not read."""
    from ct2hair_addon.cache import cache_folder
    from ct2hair_addon.jobs import client

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache_folder() / "kernels" / "bl_ext.user_default.ct2hair.ct2hair_addon"))
    assert "NUMBA_CACHE_DIR" not in client._environment((), own=True)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere/else")
    assert client._environment((), own=True)["NUMBA_CACHE_DIR"] == "/somewhere/else"
