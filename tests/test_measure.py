"""What a stage costs, and giving memory back between stages."""

import sys
from pathlib import Path

import numpy as np
import pytest

from ct2hair_addon.measure import estimated_cost, needed_memory, release_memory


def resident() -> float:
    """MB that this process holds."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1e3


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's heap alone is trimmed")
def test_holes_in_the_heap_go_back_to_the_system():
    small = [np.ones(12_000) for _ in range(3000)]  # 96 kB each: too small for pages of their own
    last, full = small[-1], resident()
    del small
    release_memory()
    assert resident() < full - 200.0
    assert last.sum() == 12_000.0


def test_the_estimate_grows_with_hair_steps_and_threads():
    minutes, memory = estimated_cost(15e6, 60, 2)
    assert estimated_cost(30e6, 60, 2)[0] > 1.5 * minutes
    assert estimated_cost(15e6, 60, 4)[0] < 0.7 * minutes
    assert estimated_cost(15e6, 10, 2)[0] < minutes
    assert memory == estimated_cost(15e6, 60, 4)[1] < estimated_cost(30e6, 60, 2)[1]


def test_memory_follows_the_voxels_that_are_stored():
    assert needed_memory(1.27e9, 2) < 19.0
    assert needed_memory(1e8, 4) - needed_memory(1e8, 2) == pytest.approx(0.2)
