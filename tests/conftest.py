"""What all tests share: the engine on the path, OpenVDB from bpy, and where the reference data lies."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real reference data, outside the project; the test skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference data is not on this machine ({SHARED})")
    return SHARED
