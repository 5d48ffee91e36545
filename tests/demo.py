"""The demonstration, `make demo`: a hairstyle becomes a CT scan, and the scan becomes hair again, all through the extension.

It installs the extension from these sources into a Blender of its own (settings in OUT/blender), imports the scan, reconstructs
it in a background process, exports and renders by the operators that the buttons call, and leaves in OUT: hair.blend, hair.abc,
hair.usda, render.png, report.html, and the job's own files in OUT/job.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STYLE, STRANDS, SPACING, SEED = "bob", 4000, 0.56, 5
MODULE = "bl_ext.user_default.ct2hair"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", default=ROOT / "out" / "demo")
    parser.add_argument("--style", default=STYLE, help="hairstyle (default: %(default)s)")
    parser.add_argument("--strands", type=int, default=STRANDS, help="strands of the hairstyle (default: %(default)s)")
    parser.add_argument("--spacing", type=float, default=SPACING, metavar="MM", help="voxel size (default: %(default)s)")
    parser.add_argument("--preset", default="draft", help="of the reconstruction (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=32, help="of the picture (default: %(default)s)")
    parser.add_argument("--truth", action="store_true", help="also render the hairstyle itself, as truth.png, to compare")
    options = parser.parse_args()
    begun = time.monotonic()
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)

    scan = out / "scan.nrrd"
    if not scan.is_file():
        step("making a CT scan of the hairstyle", options.style)
        command = ["synthesize", options.style, "--strands", str(options.strands), "--seed", str(SEED)]
        command += ["--spacing", str(options.spacing), "--out", str(scan)]
        subprocess.run([sys.executable, "-m", "ct2hair_addon", *command], cwd=ROOT, check=True)

    step("installing the extension into a Blender of its own")
    import_blender(out / "blender")
    import bpy

    install(bpy, out)
    scene = importlib.import_module(f"{MODULE}.ct2hair_addon.scene")
    properties = bpy.context.scene.ct2hair
    properties.preset = options.preset
    properties.colour = "brown"
    properties.settings.head.face, properties.settings.head.up = "-y", "+z"
    properties.settings.run.seed = SEED

    step("importing the scan")
    finished(bpy.ops.ct2hair.import_scan(filepath=str(scan)))
    step("reconstructing in the background")
    finished(bpy.ops.ct2hair.reconstruct(folder=str(out / "job")))
    step("exporting .blend, .abc, .usda and the report")
    finished(bpy.ops.ct2hair.export(directory=str(out)))
    step("rendering")
    with scene.quiet():
        outcome = bpy.ops.ct2hair.render(filepath=str(out / "render.png"), samples=options.samples)
    finished(outcome)
    if options.truth:
        step("rendering the hairstyle itself")
        with scene.quiet():
            render_truth(scene, options, out)

    names = ["hair.blend", "hair.abc", "hair.usda", "render.png", "report.html"]
    missing = [name for name in names if not (out / name).is_file()]
    for name in names:
        print(f"  {out / name}")
    print(f"demo: {'MISSING ' + ', '.join(missing) if missing else 'done'} in {time.monotonic() - begun:.0f} s")
    return 1 if missing else 0


def step(*words: str) -> None:
    print("demo:", *words, flush=True)


def finished(outcome: set[str]) -> None:
    if outcome != {"FINISHED"}:
        raise SystemExit(f"demo: an operator ended with {outcome}; what it reported stands above")


def import_blender(resources: Path) -> None:
    """Have bpy keep its preferences and extensions in a folder of the demo, never in the user's."""
    for kind in ("config", "scripts", "extensions", "datafiles"):
        (resources / kind).mkdir(parents=True, exist_ok=True)
    os.environ["BLENDER_USER_RESOURCES"] = str(resources)


def install(bpy, out: Path) -> None:
    """Build the extension's zip without its wheels, which this Python has, install it and switch it on."""
    sys.path.insert(0, str(ROOT / "wheels"))
    from extension import blender_extension, stage_extension
    from lock import this_platform

    archive = out / "ct2hair.zip"
    stage = out / "blender" / "stage"
    shutil.rmtree(stage, ignore_errors=True)
    stage_extension(stage, [], [this_platform()])
    blender_extension("build", "--source-dir", str(stage), "--output-filepath", str(archive))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)
    if not hasattr(bpy.ops.ct2hair, "import_scan") or MODULE not in bpy.context.preferences.addons:
        raise SystemExit("demo: the extension is installed but not enabled; see the messages above")


def render_truth(scene, options, out: Path) -> None:
    """The picture of the hairstyle that the scan was made of, in the same studio."""
    evaluation = importlib.import_module(f"{MODULE}.ct2hair_addon.evaluation")
    head_data = importlib.import_module(f"{MODULE}.ct2hair_addon.head").template_head()
    strands = evaluation.hairstyle(options.style, head_data, options.strands, SEED)
    result = scene.show_strands(strands, head_data, "truth")
    scene.render_picture(result, out / "truth.png", samples=options.samples)
    scene.remove_collection(result.collection)


if __name__ == "__main__":
    sys.exit(main())
