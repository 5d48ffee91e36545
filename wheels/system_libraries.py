"""What Blender needs of a Debian or Ubuntu machine besides Python packages: found missing, installed, or asked for.

bpy's wheel brings its own libraries but for the ones of the window system, which a server doesn't have.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

# The library's name as the loader reports it -> the packages that bring it, the names of newer releases first:
# Debian 13 and Ubuntu 24.04 renamed some for 64-bit time ("t64").
PACKAGES = {
    "libX11.so.6": ("libx11-6",),
    "libX11-xcb.so.1": ("libx11-xcb1",),
    "libXau.so.6": ("libxau6",),
    "libXcursor.so.1": ("libxcursor1",),
    "libXdmcp.so.6": ("libxdmcp6",),
    "libXext.so.6": ("libxext6",),
    "libXfixes.so.3": ("libxfixes3",),
    "libXi.so.6": ("libxi6",),
    "libXinerama.so.1": ("libxinerama1",),
    "libXrandr.so.2": ("libxrandr2",),
    "libXrender.so.1": ("libxrender1",),
    "libXxf86vm.so.1": ("libxxf86vm1",),
    "libxcb.so.1": ("libxcb1",),
    "libxkbcommon.so.0": ("libxkbcommon0",),
    "libSM.so.6": ("libsm6",),
    "libICE.so.6": ("libice6",),
    "libGL.so.1": ("libgl1",),
    "libGLX.so.0": ("libglx0",),
    "libGLdispatch.so.0": ("libglvnd0",),
    "libOpenGL.so.0": ("libopengl0",),
    "libEGL.so.1": ("libegl1",),
    "libwayland-client.so.0": ("libwayland-client0",),
    "libwayland-cursor.so.0": ("libwayland-cursor0",),
    "libwayland-egl.so.1": ("libwayland-egl1",),
    "libasound.so.2": ("libasound2t64", "libasound2"),
    "libpulse.so.0": ("libpulse0",),
    "libglib-2.0.so.0": ("libglib2.0-0t64", "libglib2.0-0"),
    "libdbus-1.so.3": ("libdbus-1-3",),
    "libgomp.so.1": ("libgomp1",),
    "libstdc++.so.6": ("libstdc++6",),
    "libgcc_s.so.1": ("libgcc-s1",),
    "libatomic.so.1": ("libatomic1",),
    "libuuid.so.1": ("libuuid1",),
    "libz.so.1": ("zlib1g",),
    "libbsd.so.0": ("libbsd0",),
    "libmd.so.0": ("libmd0",),
}


class MissingFromSystem(Exception):
    """The machine lacks something that this could not install; the message has the one line that does."""


def missing_libraries(*objects: Path) -> set[str]:
    """The shared libraries that the loader can't find for these object files, what they need in turn included."""
    if not sys.platform.startswith("linux"):
        return set()
    done = subprocess.run(
        ["ldd", *map(str, objects)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, encoding="utf-8", check=False
    )
    return set(re.findall(r"^\s*(\S+) => not found", done.stdout, flags=re.MULTILINE))


def ensure_libraries(*objects: Path) -> None:
    """Install the system libraries that these object files lack, or raise MissingFromSystem with the line that does."""
    # Each round may show what the libraries of the last one need in turn; three are more than were ever seen.
    for _ in range(3):
        missing = missing_libraries(*objects)
        if not missing:
            return
        unknown = sorted(missing - PACKAGES.keys())
        if unknown:
            raise MissingFromSystem(
                f"Blender needs {', '.join(unknown)}, and this script doesn't know which package of this system brings that"
            )
        install([PACKAGES[library] for library in sorted(missing)], f"Blender needs {', '.join(sorted(missing))}")
    raise MissingFromSystem(f"still missing after installing their packages: {', '.join(sorted(missing_libraries(*objects)))}")


def ensure_venv() -> None:
    """Install the part of Python that makes environments, which Debian packs apart, or raise MissingFromSystem."""
    if subprocess.run([sys.executable, "-c", "import venv, ensurepip"], stderr=subprocess.DEVNULL, check=False).returncode:
        version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        install([(f"{version}-venv",)], f"{version} can't make environments (no ensurepip)")


def install(packages: list[tuple[str, ...]], why: str) -> None:
    """apt-get install the first known name of each, where allowed; else raise MissingFromSystem with the line to run."""
    if not shutil.which("apt-get"):
        names = " ".join(alternatives[0] for alternatives in packages)
        raise MissingFromSystem(
            f"{why}. Debian calls the packages: {names}. Install what your system calls them, and run this again."
        )
    may = hasattr(os, "geteuid") and os.geteuid() == 0
    if may:
        print(f"{why}: installing", flush=True)
        apt("update", "-qq")
    names = [known(alternatives) for alternatives in packages]
    line = f"apt-get update && {{sudo}}apt-get install -y --no-install-recommends {' '.join(names)}"
    if not may:
        raise MissingFromSystem(
            f"{why}. This line installs it:\n\n    sudo {line.format(sudo='sudo ')}\n\nThen run this again."
        )
    if apt("install", "-y", "-qq", "--no-install-recommends", *names):
        raise MissingFromSystem(
            f"{why}, and installing it failed. Mend what apt-get says above, or try:\n\n    {line.format(sudo='')}"
        )


def known(alternatives: tuple[str, ...]) -> str:
    """The first of some packages that apt knows; the last where it knows none (its lists may be empty)."""
    for name in alternatives:
        shown = subprocess.run(["apt-cache", "show", name], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
        if shown.returncode == 0:
            return name
    return alternatives[-1]


def apt(*arguments: str) -> int:
    """Run apt-get without questions; its exit status."""
    # dpkg prints several lines a package: of use only when something goes wrong, which goes to stderr
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    wait = ("-o", "DPkg::Lock::Timeout=600")  # a machine that has just started updates itself first
    return subprocess.run(["apt-get", *wait, *arguments], env=environment, stdout=subprocess.DEVNULL, check=False).returncode
