"""The check of who knows whom: green on the project, and really broken by each kind of forbidden import."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

spec = importlib.util.spec_from_file_location("layers", Path(__file__).with_name("layers.py"))
layers = importlib.util.module_from_spec(spec)
spec.loader.exec_module(layers)


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    return layers.lay_out(layers.ROOT, tmp_path)


def test_the_project_keeps_its_layers(sources: Path):
    done = layers.check(sources.parent)
    assert done.returncode == 0, done.stdout


# file -> a forbidden line in it, and what import-linter is to say of it
VIOLATIONS = {
    "panels are not known by operators": (
        "operators/wrong.py",
        "from .. import panels",
        "ct2hair.operators.wrong -> ct2hair.panels",
    ),
    "operators are not known by the scene": (
        "ct2hair_addon/scene/wrong.py",
        "def late():\n    from ... import operators",
        "ct2hair.ct2hair_addon.scene.wrong -> ct2hair.operators",
    ),
    "a stage knows no other stage": (
        "ct2hair_addon/guides/wrong.py",
        "from ..orientation import wrong",
        "ct2hair.ct2hair_addon.guides.wrong -> ct2hair.ct2hair_addon.orientation",
    ),
    "the ground knows no stage": (
        "ct2hair_addon/progress.py",
        "from . import pipeline",
        "ct2hair.ct2hair_addon.progress -> ct2hair.ct2hair_addon.pipeline",
    ),
    "a stage knows no Blender": (
        "ct2hair_addon/volume/grid.py",
        "import bpy",
        "ct2hair.ct2hair_addon.volume.grid -> bpy",
    ),
    "imports are relative": (
        "ct2hair_addon/orientation/wrong.py",
        "import ct2hair_addon.strands",
        "ct2hair.ct2hair_addon.orientation.wrong -> ct2hair_addon",
    ),
}


def test_each_forbidden_import_breaks_the_check(sources: Path):
    for file, line, _ in VIOLATIONS.values():
        path = sources / file
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "__init__.py").touch()
        with path.open("a") as stream:
            stream.write(f"\n{line}\n")
    (sources / "panels").mkdir(exist_ok=True)
    for package in ("panels", "ct2hair_addon/orientation"):
        (sources / package / "__init__.py").touch()
    done = layers.check(sources.parent)
    assert done.returncode != 0
    said = " ".join(done.stdout.split())
    for rule, (_, _, expected) in VIOLATIONS.items():
        assert expected in said, f"{rule}: not found in\n{done.stdout}"


def test_a_new_module_needs_a_place(sources: Path):
    (sources / "ct2hair_addon" / "unplaced.py").touch()
    done = layers.check(sources.parent)
    assert done.returncode != 0
    assert "unplaced" in done.stdout


def test_scene_may_import_blender(sources: Path):
    (sources / "ct2hair_addon" / "scene").mkdir(exist_ok=True)
    (sources / "ct2hair_addon" / "scene" / "__init__.py").touch()
    (sources / "ct2hair_addon" / "scene" / "allowed.py").write_text("import bpy\nimport mathutils\n")
    done = layers.check(sources.parent)
    assert done.returncode == 0, done.stdout
