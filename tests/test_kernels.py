"""Kernels compiled ahead: the list is what commands call, and the helper is no bother."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import types

from ct2hair_addon import kernels
from ct2hair_addon.cache import kernel_folder

sys.path.append(str(Path(__file__).parent))

from kernels_list import record

COMMANDS = ("synthesize", "reconstruct", "paper", "evaluate")


def test_every_line_names_a_kernel_and_as_many_arguments_as_it_takes():
    lines = kernels.listed(COMMANDS)
    assert len(lines) > 80 and len(set(lines)) == len(lines)
    for line in lines:
        kernel, kinds = kernels.understood(line)
        assert kinds and all(isinstance(kind, types.Type) for kind in kinds)
        inspect.signature(kernel.py_func).bind(*kinds)


def test_nothing_is_called_that_is_not_listed(tmp_path):
    """A scan is made and reconstructed as users do, each in a process of its own, and what they call is written down."""
    scan = str(tmp_path / "bob.nrrd")
    missing = "run `make kernels`: these are called and not in kernels.txt"
    synthesized = record(["synthesize", "bob", "--strands", "700", "--spacing", "1.2", "--seed", "8", "--out", scan])
    assert not set(synthesized) - set(kernels.listed(["synthesize"])), missing
    reconstructed = record(["reconstruct", scan, "--out", str(tmp_path / "out")])
    assert len(reconstructed) > 60
    assert not set(reconstructed) - set(kernels.listed(["reconstruct"])), missing


def test_what_is_written_down_can_be_compiled_again(monkeypatch):
    module = sys.modules[__name__]
    monkeypatch.setattr(kernels, "__package__", "tests_of")
    monkeypatch.setitem(sys.modules, f"{kernels.__package__}.made", module)

    @numba.njit
    def summed(values, weights, pair, scale=None):
        return values.sum() * weights[0, 0] + pair[0] + pair[1]

    summed.py_func.__module__ = f"{kernels.__package__}.made"
    with kernels.recorded() as lines:
        summed(np.ones(3, np.float32), np.ones((2, 2), order="F"), (1, 2.0))
    assert lines == ["made.summed(float32[::1], float64[::1, :], Tuple([int64, float64]), Omitted(None))"]
    again = numba.njit(summed.py_func)
    monkeypatch.setattr(module, "summed", again, raising=False)
    kernels.compile_kernel(lines[0])
    assert again.signatures == summed.signatures
    kernels.compile_kernel(lines[0])  # once more is nothing
    assert len(again.signatures) == 1


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    if numba.get_num_threads() < 2:
        pytest.skip("there is one core, and no helper")
    return tmp_path


def wait_for_the_helper(cache: Path) -> None:
    until = time.monotonic() + 60.0
    while not (cache / "ahead.txt").exists():
        assert time.monotonic() < until, "the helper did not begin"
        time.sleep(0.05)


def test_the_helper_goes_with_the_block_and_leaves_no_trace_of_being_at_work(own_cache):
    with kernels.compiled_ahead("synthesize"):
        wait_for_the_helper(own_cache)
        assert not kernels._wanted(["synthesize"]), "one helper is enough"
    assert not (own_cache / "ahead.txt").exists()
    assert not (own_cache / "ahead-synthesize.txt").exists(), "it was not done"
    assert kernels._wanted(["synthesize"])


def test_the_helper_ends_when_its_starter_is_gone(own_cache):
    helper = kernels._helper(["reconstruct"])
    wait_for_the_helper(own_cache)
    helper.stdin.close()  # as the system does when a process ends, however it does
    try:
        assert helper.wait(timeout=10.0) != 0
    finally:
        helper.kill()


def test_what_is_compiled_is_not_compiled_again_until_a_source_changes(own_cache, monkeypatch):
    (own_cache / "ahead-evaluate.txt").write_text(kernels.fingerprint())
    assert not kernels._wanted(["evaluate"])
    assert kernels._wanted(["evaluate", "synthesize"])
    monkeypatch.setattr(kernels, "fingerprint", lambda: "other sources")
    assert kernels._wanted(["evaluate"])


def test_a_helper_that_cannot_start_is_no_error(own_cache, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(own_cache / "no-such-python"))
    with kernels.compiled_ahead("evaluate"):
        pass
    monkeypatch.setattr(kernels, "__package__", "bl_ext.user_default.ct2hair.ct2hair_addon")
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("inside Blender kernels lie elsewhere"))
    with kernels.compiled_ahead("evaluate"):
        pass


def test_kernels_of_other_sources_lie_elsewhere_and_go_when_nobody_used_them_for_long(tmp_path, monkeypatch):
    monkeypatch.setenv("CT2HAIR_CACHE", str(tmp_path / "cache"))
    sources = tmp_path / "engine"
    (sources / "volume").mkdir(parents=True)
    (sources / "volume" / "grid.py").write_text("@numba.njit(cache=True)")
    (sources / "report.py").write_text("no kernels")
    first = kernel_folder("engine", sources)
    first.mkdir(parents=True)
    (sources / "report.py").write_text("none still")
    assert kernel_folder("engine", sources) == first
    (sources / "volume" / "grid.py").write_text("@numba.njit(cache=True, parallel=True)")
    second = kernel_folder("engine", sources)
    assert second != first and second.parent == first.parent == tmp_path / "cache" / "kernels" / "engine"
    assert first.is_dir(), "somebody may go back to it"
    second.mkdir()
    for folder in (first, second):
        os.utime(folder, (0, 0))
    assert kernel_folder("engine", sources) == second
    assert second.is_dir() and not first.exists()
