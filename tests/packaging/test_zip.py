"""The built zip alone, in a Blender that has nothing else: it installs, enables, works, and leaves without a trace."""

from __future__ import annotations

import zipfile
from pathlib import Path

import extension
import lock
import pytest

from ct2hair_addon.interpolation import prior

pytestmark = pytest.mark.slow

# every package that the engine may import, and that none of it comes from anywhere but the zip's wheels
IMPORTS = """
import importlib
import sys
from pathlib import Path

import numpy

where = Path(bpy.utils.user_resource("EXTENSIONS")).resolve() / ".local"
for name in sys.argv[1:]:
    module = importlib.import_module(name)
    assert where in Path(module.__file__).resolve().parents, f"{name} comes from {module.__file__}"
assert where not in Path(numpy.__file__).resolve().parents, "the zip brought a numpy of its own"
print("numpy", numpy.__version__)
"""

ENGINE = """
import numpy
from bl_ext.user_default.ct2hair.ct2hair_addon.strands import Strands

points = numpy.linspace((0.0, 0.0, 0.0), (0.0, 0.0, 10.0), 5, dtype=numpy.float32)
strands = Strands(points, numpy.array([0, 5]))
assert numpy.allclose(strands.lengths(), 10.0), strands.lengths()
"""

# a scan made by the command line in one process, and brought into the scene by the operator
IMPORT_A_SCAN = """
import sys

from bl_ext.user_default.ct2hair.ct2hair_addon import cli

assert cli.main(["synthesize", "bob", "--spacing", "0.8", "--strands", "2000", "--out", sys.argv[1]]) == 0
assert bpy.ops.ct2hair.import_scan(filepath=sys.argv[1]) == {"FINISHED"}
volumes = [ob for ob in bpy.context.scene.objects if ob.type == "VOLUME"]
assert len(volumes) == 1, volumes
assert volumes[0].data.grids.load(), volumes[0].data.filepath
assert volumes[0].data.grids
"""

# the whole job in a background process of the extension, and its result in the scene
RECONSTRUCT = """
import sys
from pathlib import Path

properties = bpy.context.scene.ct2hair
properties.preset = "draft"
properties.settings.head.face, properties.settings.head.up = "-y", "+z"
assert bpy.ops.ct2hair.reconstruct(scan=sys.argv[1], folder=sys.argv[2]) == {"FINISHED"}
assert (Path(sys.argv[2]) / "hair.npz").is_file()
strands = [len(ob.data.curves) for ob in bpy.context.scene.objects if ob.type == "CURVES"]
assert strands and max(strands) > 1000, strands
"""

GROOM = """
import sys
from pathlib import Path
from bl_ext.user_default.ct2hair.operators import command

folder = Path(sys.argv[1])
assert command.run(["groom", str(folder), "--out", str(folder / "groom"), "--trim", "80", "--formats", "npz", "usd"]) == 0
assert {"hair.npz", "hair.usda"} < {path.name for path in (folder / "groom").iterdir()}
assert command.run(["groom", str(folder)]) == 2
"""

DISABLE = """
assert dir(bpy.ops.ct2hair), "no operator of the extension is registered"
addon_utils.disable("bl_ext.user_default.ct2hair", default_set=True)
assert "bl_ext.user_default.ct2hair" not in bpy.context.preferences.addons
left = [name for name in dir(bpy.types) if name.startswith(("CT2HAIR_", "Ct2hair"))]
assert not left, f"still registered: {left}"
assert not dir(bpy.ops.ct2hair), dir(bpy.ops.ct2hair)
"""

PACKAGES = ["scipy", "numba", "skimage.measure", "SimpleITK", "tifffile", "alembic3d", "safetensors.numpy"]


@pytest.mark.parametrize("blender", ["blender45", "blender52"])
class TestInstalled:
    def test_every_bundled_package_imports(self, blender: str, request: pytest.FixtureRequest):
        fresh = request.getfixturevalue(blender)
        torch = ["torch"] if not list(fresh.folder.glob("*-no_torch.zip")) else []
        assert "numpy" in fresh.run_enabled(IMPORTS, *PACKAGES, *torch)

    def test_the_engine_runs(self, blender: str, request: pytest.FixtureRequest):
        request.getfixturevalue(blender).run_enabled(ENGINE)

    def test_an_operator_runs(self, blender: str, request: pytest.FixtureRequest):
        fresh = request.getfixturevalue(blender)
        fresh.run_enabled(IMPORT_A_SCAN, str(fresh.folder / "bob.vdb"))

    def test_it_is_disabled_without_a_trace(self, blender: str, request: pytest.FixtureRequest):
        request.getfixturevalue(blender).run_enabled(DISABLE)


def test_the_zip_alone_reconstructs_a_scan(blender45):
    scan = blender45.folder / "pixie.nrrd"
    if list(blender45.folder.glob("*-no_torch.zip")):
        pytest.skip("the package index has no CPU build of torch for this Python, so the zip has none, and refinement needs it")
    command = ["synthesize", "pixie", "--spacing", "0.8", "--strands", "2000", "--seed", "1", "--out", str(scan)]
    blender45.run_enabled(f"from bl_ext.user_default.ct2hair.ct2hair_addon import cli\nassert cli.main({command!r}) == 0\n")
    blender45.run_enabled(RECONSTRUCT, str(scan), str(blender45.folder / "result"))
    blender45.run_enabled(GROOM, str(blender45.folder / "result"))


def test_the_strand_prior_s_weights_are_among_what_users_get(tmp_path):
    extension.stage_extension(tmp_path / "staged", [], [])
    shipped = Path(prior.WEIGHTS).relative_to(extension.ROOT)
    assert (tmp_path / "staged" / shipped).read_bytes() == prior.WEIGHTS.read_bytes()


def test_the_zip_holds_what_users_need_and_no_more(blender45):
    (archive,) = blender45.folder.glob("ct2hair-*.zip")
    with zipfile.ZipFile(archive) as file:
        names = [Path(name) for name in file.namelist()]
    assert Path(prior.WEIGHTS).relative_to(extension.ROOT) in names
    top = {name.parts[0] for name in names}
    assert top == {*extension.SHIPPED, "blender_manifest.toml", "wheels"}
    assert not [name for name in names if "__pycache__" in name.parts or name.name.startswith(".")]
    bundled = {name.name for name in names if name.parts[0] == "wheels"}
    assert bundled == set(lock.bundled_wheels((blender45.target,)))
    assert not [wheel for wheel in bundled if wheel.startswith("numpy-")]
