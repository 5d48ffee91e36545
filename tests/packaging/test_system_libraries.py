"""What the machine lacks is found, and installed or asked for with a line that works there; stand-ins for ldd and apt."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import system_libraries
from system_libraries import MissingFromSystem, ensure_libraries, missing_libraries


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A machine whose programs are the given shell scripts, and what its apt-get was asked to do."""
    log = tmp_path / "log"

    def make(user: int, **programs: str) -> Path:
        for name, script in programs.items():
            path = tmp_path / name.replace("_", "-")
            path.write_text(f"#!/bin/sh\n{script}\n")
            path.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
        monkeypatch.setenv("LOG", str(log))
        monkeypatch.setattr(system_libraries.os, "geteuid", lambda: user)
        return log

    return make


LACKING = """
test -e "$LOG.done" && exit
printf '\\tlibX11.so.6 => not found\\n\\tlibc.so.6 => /lib/libc.so.6 (0x0)\\n\\tlibasound.so.2 => not found\\n'
"""
APT = 'echo "$@" >> "$LOG"; case "$*" in *install*) touch "$LOG.done";; esac'


def test_missing_libraries_are_what_the_loader_does_not_find(machine):
    machine(1000, ldd=LACKING)
    assert missing_libraries(Path("bpy.so")) == {"libX11.so.6", "libasound.so.2"}


def test_root_installs_the_names_of_this_release(machine):
    log = machine(0, ldd=LACKING, apt_get=APT, apt_cache='test "$2" != libasound2t64')
    ensure_libraries(Path("bpy.so"))
    update, install = log.read_text(encoding="utf-8").splitlines()
    assert "update" in update
    assert install.endswith("--no-install-recommends libx11-6 libasound2")


def test_names_of_a_release_with_64_bit_time(machine):
    log = machine(0, ldd=LACKING, apt_get=APT, apt_cache="exit 0")
    ensure_libraries(Path("bpy.so"))
    assert log.read_text(encoding="utf-8").splitlines()[1].endswith("libx11-6 libasound2t64")


def test_others_get_the_one_line(machine):
    log = machine(1000, ldd=LACKING, apt_get=APT, apt_cache="exit 0")
    line = "sudo apt-get update && sudo apt-get install -y --no-install-recommends libx11-6 libasound2t64\n"
    with pytest.raises(MissingFromSystem, match=r"Blender needs libX11\.so\.6, libasound\.so\.2") as raised:
        ensure_libraries(Path("bpy.so"))
    assert line in str(raised.value)
    assert not log.exists()


def test_a_failed_install_gives_the_line(machine):
    machine(0, ldd=LACKING, apt_get="exit 100", apt_cache="exit 0")
    with pytest.raises(MissingFromSystem, match=r"installing it failed(.|\n)*apt-get install .* libx11-6"):
        ensure_libraries(Path("bpy.so"))


def test_an_unknown_library_is_named(machine):
    machine(0, ldd="echo '  libnew.so.1 => not found'")
    with pytest.raises(MissingFromSystem, match=r"libnew\.so\.1"):
        ensure_libraries(Path("bpy.so"))


def test_this_machine_has_what_blender_needs():
    assert missing_libraries(Path(importlib.util.find_spec("bpy").origin)) == set()
