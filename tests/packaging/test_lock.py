"""The lock, the pins, the manifest and what the sources import agree; a wheel that isn't the locked one is refused."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import sys
import tomllib

import extension
import fetch
import lock
import pytest
from packaging.requirements import Requirement

# Blender brings these itself: a second one would break other extensions, which share one folder of packages
BLENDERS_OWN = {"numpy", "requests", "urllib3", "certifi", "idna", "charset-normalizer", "zstandard", "cython"}
# torch asks for it, and only torch.compile and C++ extensions use it
NOT_NEEDED = {"setuptools"}


@pytest.mark.parametrize("target", lock.TARGETS, ids=str)
@pytest.mark.parametrize("group", ["bundle", "blender", "tools", "cuda"])
def test_every_pin_has_one_wheel_for_every_target(group: str, target: lock.Target):
    wheels = lock.locked(group, target)
    assert wheels.keys() == lock.pinned(group, target).keys()
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for _, digest in wheels.values())


def test_the_lock_holds_nothing_that_no_pin_asks_for():
    asked = {file for group in lock.read_lock() for target in lock.TARGETS for file, _ in lock.locked(group, target).values()}
    held = {file for packages in lock.read_lock().values() for files in packages.values() for file in files}
    assert held == asked


def test_the_manifest_names_the_locked_wheels():
    manifest = tomllib.loads(lock.MANIFEST.read_text(encoding="utf-8"))
    assert manifest["wheels"] == [f"./wheels/{file}" for file in lock.bundled_wheels(lock.TARGETS)]
    assert manifest["platforms"] == list(lock.PLATFORMS)


def test_manifest_engine_and_project_have_one_version():
    from ct2hair_addon import __version__

    manifest = tomllib.loads(lock.MANIFEST.read_text(encoding="utf-8"))
    project = tomllib.loads((lock.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert manifest["version"] == project["version"] == __version__


def test_blender_validates_the_manifest():
    extension.blender_extension("validate", str(lock.ROOT))


def test_blenders_own_packages_are_not_bundled():
    for target in lock.TARGETS:
        assert not lock.pinned("bundle", target).keys() & BLENDERS_OWN


def test_no_package_index_is_named():
    for path in (lock.LOCK, lock.PINS, lock.MANIFEST):
        assert "://" not in path.read_text(encoding="utf-8")


def test_what_a_bundled_package_needs_is_bundled_or_blenders_own():
    target = lock.this_target()
    bundle = lock.pinned("bundle", target)
    there = bundle | lock.pinned("blender", target)
    for name in bundle:
        for line in importlib.metadata.requires(name) or []:
            need = Requirement(line)
            package = re.sub(r"[-_.]+", "-", need.name).lower()
            if package in NOT_NEEDED or (need.marker and not need.marker.evaluate({"extra": ""})):
                continue
            if package not in there and package in lock.pinned("cuda", target):
                continue  # this environment has PyPI's torch for want of the locked CPU build, which asks for none of these
            assert package in there, f"{name} needs {line}"
            assert need.specifier.contains(there[package].split("+")[0]), f"{name} needs {line}, pinned is {there[package]}"


def test_every_import_of_the_extension_is_bundled_or_blenders_own():
    bundled = {
        file.parts[0].partition(".")[0]
        for name in lock.pinned("bundle", lock.this_target())
        for file in importlib.metadata.files(name)
    }
    there = bundled | set(sys.stdlib_module_names) | {"ct2hair_addon"}
    there |= {
        "bpy",
        "openvdb",
        "mathutils",
        "bmesh",
        "gpu",
        "gpu_extras",
        "bpy_extras",
        "blf",
        "addon_utils",
        "numpy",
        "bl_operators",
    }
    there |= {"structure_tensor"}  # the benchmark's peer, a test tool: who lacks it is told so
    missing = set()
    for path in [lock.ROOT / "__init__.py", *(p for room in extension.ROOMS for p in (lock.ROOT / room).rglob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and not node.level else []
            for name in {name.partition(".")[0] for name in names} - there:
                missing.add(f"{path.relative_to(lock.ROOT)} imports {name}")
    assert not missing, sorted(missing)


@pytest.mark.parametrize(
    ("wheel", "fitting"),
    [
        ("a-1-py3-none-any.whl", {"linux-x64 3.11", "linux-x64 3.13", "windows-x64 3.11", "windows-x64 3.13"}
         | {"macos-arm64 3.11", "macos-arm64 3.13"}),
        ("a-1-cp311-cp311-manylinux_2_17_x86_64.manylinux2014_x86_64.whl", {"linux-x64 3.11"}),
        ("a-1-cp311-cp311-manylinux_2_17_aarch64.whl", set()),
        ("a-1-cp311-cp311-manylinux_2_34_x86_64.whl", set()),
        ("a-1-cp310-abi3-win_amd64.whl", {"windows-x64 3.11", "windows-x64 3.13"}),
        ("a-1-cp312-abi3-macosx_11_0_universal2.whl", {"macos-arm64 3.13"}),
        ("a-1-cp313-cp313-macosx_11_0_x86_64.whl", set()),
        ("a-1-cp313-cp313t-win_amd64.whl", set()),
    ],
)  # fmt: skip
def test_a_wheels_name_says_where_it_fits(wheel: str, fitting: set[str]):
    assert {f"{t.platform} {t.python}" for t in lock.TARGETS if t.fits(wheel)} == fitting


def test_a_wheel_with_another_content_is_thrown_away(tmp_path, monkeypatch):
    monkeypatch.setattr(fetch, "WHEELS", tmp_path)
    (tmp_path / "a-1-py3-none-any.whl").write_bytes(b"tampered with")
    assert not fetch.is_there("a-1-py3-none-any.whl", "0" * 64)
    assert not list(tmp_path.iterdir())


def test_a_missing_wheel_is_named():
    with pytest.raises(lock.LockError, match=r"0 wheels of scipy for linux-x64, Python 3\.11"):
        lock.locked("bundle", lock.Target("linux-x64", "3.11"), {"bundle": {}})
