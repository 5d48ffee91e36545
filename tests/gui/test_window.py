"""The extension in a real window: installed from its zip, used by mouse and keys, photographed for the manual.

Run by `make test-gui` alone. The pictures land in out/gui. The scan is a bob of 1,500 strands at 0.9 mm; one made before is
used again. CT2HAIR_GUI_JOB may name the folder of a finished job of it, which is loaded in place of waiting for the whole job.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from .window import HOME, ROOT, DebianBlender, Unavailable

OUT = ROOT / "out" / "gui"
HELD = 0.1
"""Seconds that a running job may hold the window up."""

pytestmark = [pytest.mark.gui, pytest.mark.skipif("CT2HAIR_GUI" not in os.environ, reason="a real window: run `make test-gui`")]


@pytest.fixture(scope="module")
def scan() -> Path:
    path = OUT / "bob.tif"
    if not path.is_file():
        OUT.mkdir(parents=True, exist_ok=True)
        command = ["synthesize", "bob", "--strands", "1500", "--seed", "5", "--spacing", "0.9", "--out", str(path)]
        subprocess.run([sys.executable, "-m", "ct2hair_addon", *command], cwd=ROOT, check=True)
    return path


@pytest.fixture(scope="module")
def blender(scan):
    """Blender with an empty scene, the zip and the scan in its home."""
    try:
        blender = DebianBlender.prepared()
    except Unavailable as why:
        pytest.skip(f"no window on this machine: {why}")
    shutil.rmtree(blender.home, ignore_errors=True)
    blender.home.mkdir()
    build_zip(blender.home / "ct2hair.zip")
    shutil.copy2(scan, blender.home / scan.name)
    if job := os.environ.get("CT2HAIR_GUI_JOB"):
        shutil.copytree(job, blender.home / "finished")
    blender.start()
    yield blender
    blender.stop()


def build_zip(path: Path) -> None:
    """The extension's zip without wheels: Debian's Python has what they hold."""
    sys.path.insert(0, str(ROOT / "wheels"))
    from extension import blender_extension, stage_extension
    from lock import this_platform

    stage = path.parent / "stage"
    stage_extension(stage, [], [this_platform()])
    blender_extension("build", "--source-dir", str(stage), "--output-filepath", str(path))


def picture(blender, name: str) -> None:
    blender.move(500, 700)
    time.sleep(0.5)
    blender.picture(OUT / f"{name}.png")


def sidebar(blender) -> tuple[int, int, int, int]:
    """Left, top, width, height of the sidebar on the screen, once it shows our tab."""
    x, y, width, height = blender.until(
        "_, area, region = sidebar()\n"
        "area.spaces[0].show_region_ui = True\n"
        "try:\n"
        "    region.active_panel_category = 'CT2Hair'\n"
        "    answer = [region.x, region.y, region.width, region.height] if region.width > 100 else None\n"
        "except (AttributeError, TypeError): answer = None"
    )
    return x, 1000 - y - height, width, height


def scroll(blender, notches: int) -> None:
    """The sidebar, so many notches of the mouse wheel down from its top."""
    left, top, width, height = sidebar(blender)
    blender.move(left + width / 2, top + height / 2)
    blender.run("xdotool", "click", "--repeat", "80", "--delay", "4", "4")
    blender.run("xdotool", "click", "--repeat", str(notches), "--delay", "12", "5")


def watch(blender, module: str, cls: str) -> None:
    """Count the operator's calls and note the longest; what drawing takes, in software here, is not in it."""
    blender.ask(
        "import sys, time\n"
        f"cls = sys.modules['bl_ext.user_default.ct2hair.operators.{module}'].{cls}\n"
        "modal = cls.modal\n"
        "def timed(self, context, event):\n"
        "    begun = time.perf_counter()\n"
        "    outcome = modal(self, context, event)\n"
        "    state['longest'] = max(state['longest'], time.perf_counter() - begun)\n"
        "    state['calls'] = state['calls'] + 1\n"
        "    return outcome\n"
        "cls.modal = timed\n"
        "state['longest'], state['calls'] = 0.0, 0"
    )


def test_the_zip_installs_and_the_tab_opens(blender):
    install = "bpy.ops.extensions.package_install_files"
    assert blender.ask(
        f"answer = list({install}(filepath='{HOME}/ct2hair.zip', repo='user_default', enable_on_install=True))", timeout=120
    ) == ["FINISHED"]
    blender.ask("for ob in list(bpy.data.objects): bpy.data.objects.remove(ob)")
    sidebar(blender)
    blender.ask("sidebar()[1].tag_redraw()")
    time.sleep(1)
    picture(blender, "1_sidebar")


def test_a_scan_is_imported_by_clicking(blender, scan):
    left, top, width, _ = sidebar(blender)
    blender.click(left + width / 2, top + 47)
    blender.until("answer = any(a.type == 'FILE_BROWSER' for w in bpy.context.window_manager.windows for a in w.screen.areas)")
    blender.ask(
        "for w in bpy.context.window_manager.windows:\n"
        "    for a in w.screen.areas:\n"
        "        if a.type == 'FILE_BROWSER':\n"
        f"            a.spaces[0].params.directory = b'{HOME}/'\n"
        f"            a.spaces[0].params.filename = '{scan.name}'\n"
        "            a.tag_redraw()"
    )
    time.sleep(1.5)
    picture(blender, "2_import")
    blender.key("Return")
    blender.until(f"answer = bpy.context.scene.ct2hair.scan == '{HOME}/{scan.name}'", timeout=60, every=1)
    # read by the worker: the window answers meanwhile
    blender.until("answer = [ob.type for ob in bpy.data.objects].count('VOLUME') == 1", timeout=400, every=2)
    blender.ask(
        "window, area, _ = sidebar()\n"
        "region = next(r for r in area.regions if r.type == 'WINDOW')\n"
        "area.spaces[0].shading.type = 'RENDERED'\n"
        "with bpy.context.temp_override(window=window, area=area, region=region): bpy.ops.view3d.view_all()"
    )


def test_the_look_shows_histogram_and_slices(blender):
    left, top, width, _ = sidebar(blender)
    blender.click(left + width / 2, top + 116)
    module = "bl_ext.user_default.ct2hair.operators.look"
    blender.until(f"import sys; answer = sys.modules['{module}'].inspection_of(bpy.context) is not None", timeout=300, every=2)
    time.sleep(4)  # panels unfold in steps
    picture(blender, "3_thresholds")


def test_a_job_runs_beside_the_window_and_is_cancelled(blender):
    blender.ask("bpy.context.scene.ct2hair.preset = 'draft'; bpy.context.scene.ct2hair.folder = '" + HOME + "/job/'")
    start = (
        "window, area, _ = sidebar()\n"
        "region = next(r for r in area.regions if r.type == 'WINDOW')\n"
        "with bpy.context.temp_override(window=window, area=area, region=region):\n"
        "    answer = list(bpy.ops.ct2hair.reconstruct('INVOKE_DEFAULT'))"
    )
    running = "import sys; current = sys.modules['bl_ext.user_default.ct2hair.operators.running'].current\n"
    watch(blender, "reconstruct", "CT2HAIR_OT_reconstruct")
    assert blender.ask(start) == ["RUNNING_MODAL"]
    time.sleep(3)
    seen, calls = set(), 0
    end = time.monotonic() + 300
    while (len(seen) < 4 or calls <= 20) and time.monotonic() < end:
        seen.add(blender.ask(running + "answer = current.job.fraction if current.job else -1"))
        # another operator, while the job runs
        blender.ask("bpy.ops.object.empty_add(); bpy.data.objects.remove(bpy.context.active_object)")
        time.sleep(0.5)
        held, calls = blender.ask("answer = [state['longest'], state['calls']]")
    assert len(seen) >= 4 and -1 not in seen, seen
    print(f"the running job held the window {1000 * held:.1f} ms at most in {calls} events")
    assert calls > 20 and held < HELD
    scroll(blender, 20)
    time.sleep(4)
    picture(blender, "4_progress")
    process = blender.ask(running + "answer = current.job.process.pid")
    blender.move(500, 500)
    blender.key("Escape")
    blender.until(running + "answer = current.job is None", timeout=30)
    assert not Path(f"/proc/{process}").exists()
    assert "cancelled" in blender.ask(running + "answer = current.ended")
    picture(blender, "5_cancelled")


def test_the_job_goes_on_to_hair(blender):
    if (blender.home / "finished").is_dir():
        blender.ask(f"bpy.ops.ct2hair.load_result(directory='{HOME}/finished/')", timeout=60)
    else:
        blender.ask(
            "window, area, _ = sidebar()\n"
            "with bpy.context.temp_override(window=window, area=area):\n"
            "    bpy.ops.ct2hair.reconstruct('INVOKE_DEFAULT')"
        )
    blender.until("answer = any(ob.type == 'CURVES' for ob in bpy.data.objects)", timeout=1800, every=3)
    blender.ask(
        "window, area, ui = sidebar()\n"
        "region = next(r for r in area.regions if r.type == 'WINDOW')\n"
        "area.spaces[0].shading.type = 'MATERIAL'\n"
        "for c in bpy.data.collections:\n"
        "    if c.get('ct2hair_kind') == 'scan':\n"
        "        for ob in c.all_objects: ob.hide_set(True)\n"
        "hair = next(ob for ob in bpy.data.objects if ob.type == 'CURVES' and ob.visible_get())\n"
        "bpy.context.view_layer.objects.active = hair\n"
        "bpy.ops.ct2hair.measure()\n"
        "with bpy.context.temp_override(window=window, area=area, region=region):\n"
        "    bpy.ops.view3d.view_axis(type='FRONT')\n"
        "    bpy.ops.view3d.view_all()\n"
        "    bpy.ops.view3d.view_orbit(angle=0.6, type='ORBITLEFT')"
    )
    time.sleep(6)
    picture(blender, "6_hair")
    for name, notches in (("7_result", 28), ("8_export", 80)):
        scroll(blender, notches)
        picture(blender, name)


def test_the_simulation_runs_beside_the_window_and_is_cancelled(blender):
    start = (
        "window, area, _ = sidebar()\n"
        "region = next(r for r in area.regions if r.type == 'WINDOW')\n"
        "bpy.context.scene.frame_end = 200\n"
        "with bpy.context.temp_override(window=window, area=area, region=region):\n"
        "    answer = list(bpy.ops.ct2hair.simulate('INVOKE_DEFAULT'))"
    )
    watch(blender, "simulation", "CT2HAIR_OT_simulate")
    assert blender.ask(start, timeout=60) == ["RUNNING_MODAL"]
    blender.until("answer = bpy.context.scene.frame_current > 12", timeout=180)
    blender.move(500, 500)
    picture(blender, "9_simulation")
    blender.key("Escape")
    cancelled = time.monotonic()
    blender.until("answer = bpy.context.scene.frame_current == 1 and 'CT2Hair Rest' not in bpy.data.objects", timeout=10)
    assert time.monotonic() - cancelled < 3.0  # two seconds, and a moment to ask
    held, calls = blender.ask("answer = [state['longest'], state['calls']]")
    print(f"the running simulation held the window {1000 * held:.1f} ms at most in {calls} events")
    assert calls > 20 and held < HELD
