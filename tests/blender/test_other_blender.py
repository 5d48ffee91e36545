"""The tests of this folder in Blender 5.2 (Python 3.13), where the machine has it; CT2HAIR_BPY52_PYTHON names its Python."""

import os
import subprocess
from pathlib import Path

import bpy
import pytest

ROOT = Path(__file__).resolve().parents[2]
VARIABLE = "CT2HAIR_BPY52_PYTHON"


def other_python() -> Path | None:
    """The Python that has bpy 5.2: the one named by the environment, else the one that `make venv52` set up."""
    for path in (os.environ.get(VARIABLE), ROOT / ".venv52" / "bin" / "python"):
        if path and Path(path).is_file():
            return Path(path)
    return None


@pytest.mark.slow
@pytest.mark.skipif(bpy.app.version >= (5, 2, 0), reason="this is Blender 5.2 already")
def test_all_of_this_holds_in_blender_5_2():
    python = other_python()
    if python is None:
        pytest.skip(f"no Blender 5.2 on this machine: set {VARIABLE} to a Python that has bpy 5.2, or run `make venv52`")
    version = "import bpy; print('bpy', bpy.app.version_string)"
    told = subprocess.run([python, "-c", version], capture_output=True, encoding="utf-8", check=False, timeout=120)
    assert "bpy 5.2" in told.stdout, f"{python} has no bpy 5.2: {told.stdout[-500:]}{told.stderr[-500:]}"
    command = [python, "-m", "pytest", "-q", str(ROOT / "tests" / "blender"), "-p", "no:cacheprovider"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False, timeout=600)
    print(run.stdout[-3000:])
    assert run.returncode == 0, run.stdout[-6000:] + run.stderr[-2000:]
