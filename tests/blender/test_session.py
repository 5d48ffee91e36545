"""The scripting API: scans and results arrive whole, where they belong, or not at all."""

import json
import shutil

import bpy
import numpy as np
import pytest
from mathutils import Vector

from ct2hair_addon import scene
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.scene.frames import rigid
from ct2hair_addon.strands import Strands

from .conftest import block_counts, head_to_scan


def test_a_result_arrives_upright_in_metres(job_folder, dome):
    result = scene.load_result(job_folder)
    assert result.collection.name == "CT2Hair wig"
    assert result.collection.name in bpy.context.scene.collection.children
    assert result.head.parent == result.root and result.hair.parent == result.head and result.guides.parent == result.head
    assert result.volume.parent == result.scan and result.scan.parent == result.root
    bpy.context.view_layer.update()
    for ob in (result.root, result.head, result.hair, result.guides):
        assert ob.matrix_world.is_identity
    assert result.head.dimensions.z == pytest.approx(0.18, abs=1e-5)
    hair = Strands.load(job_folder / "hair.npz")
    np.testing.assert_allclose(scene.strands_of(result.hair).transformed(rigid(head_to_scan())).points, hair.points, atol=2e-3)
    assert result.guides.hide_render and result.volume.hide_render
    assert result.guides.hide_get() and not result.hair.hide_get()


def test_the_scan_stands_where_the_hair_does(job_folder):
    """The two voxels of an asymmetric phantom, through Blender's own transform of the grid."""
    result = scene.load_result(job_folder)
    bpy.context.view_layer.update()
    grid = result.volume.data.grids["density"]
    to_world = result.volume.matrix_world @ grid.matrix_object
    place = np.linalg.inv(rigid(head_to_scan()))
    for index in ((3, 5, 7), (30, 20, 10)):
        scan = np.array([10, 20, 30]) + 0.5 * np.array(index)
        head = place[:3, :3] @ scan + place[:3, 3]
        np.testing.assert_allclose(to_world @ Vector(index), head / 1000, atol=1e-6)


def test_a_result_says_how_it_was_made(job_folder):
    result = scene.load_result(job_folder)
    assert result.folder == job_folder.resolve()
    assert result.report["scan"]["file"] == "wig.nii.gz"
    assert result.settings.run.seed == 3
    assert result.collection["ct2hair_version"] == "0.1.0"
    again = scene.result_of(result.collection)
    assert again == result and scene.active_result() == result
    second = scene.load_result(job_folder, name="other")
    assert scene.active_result() == second and len(scene.results()) == 2
    bpy.context.view_layer.objects.active = result.hair
    assert scene.active_result() == result


def test_guides_and_volume_may_be_missing(job_folder):
    (job_folder / "guides.npz").unlink()
    (job_folder / "volume.vdb").unlink()
    result = scene.load_result(job_folder)
    assert result.guides is None and result.volume is None and result.scan is None


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "report.json").unlink(), "no report.json"),
        (lambda folder: (folder / "report.json").write_text("{"), "not a report"),
        (lambda folder: (folder / "report.json").write_text('{"head": {"head_to_scan": [[1]]}}'), "not a report"),
        (lambda folder: (folder / "hair.npz").write_bytes(b"PK"), "not a strand file"),
        (lambda folder: (folder / "hair.npz").unlink(), "no such file"),
        (lambda folder: (folder / "head.obj").write_text("v 0 0 0\n"), "head.obj"),
        (lambda folder: (folder / "volume.vdb").write_bytes(b"x" * 100), "not a readable OpenVDB file"),
        (lambda folder: Strands.from_polylines([np.zeros((1, 3))]).save(folder / "guides.npz"), "no strand"),
    ],
)
def test_a_damaged_result_leaves_the_scene_as_it_was(job_folder, damage, message):
    before = block_counts()
    damage(job_folder)
    with pytest.raises(CT2HairError, match=message):
        scene.load_result(job_folder)
    assert block_counts() == before


def test_a_mirrored_placement_is_refused(job_folder):
    report = json.loads((job_folder / "report.json").read_text(encoding="utf-8"))
    report["head"]["head_to_scan"] = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
    (job_folder / "report.json").write_text(json.dumps(report))
    with pytest.raises(CT2HairError, match="rotation"):
        scene.load_result(job_folder)


def test_a_result_can_be_removed_whole(job_folder):
    before = block_counts()
    scene.remove_collection(scene.load_result(job_folder).collection)
    after = block_counts()
    after["node_groups"] = before["node_groups"]  # the shared node group stays
    assert after == before


def test_a_vdb_scan_is_shown_as_it_is(job_folder):
    shown = scene.import_scan(job_folder / "volume.vdb")
    assert shown.collection.name == "CT2Hair volume import"
    bpy.context.view_layer.update()
    matrix = shown.volume.matrix_world @ shown.volume.data.grids["density"].matrix_object
    low, high = matrix @ Vector((3, 5, 7)), matrix @ Vector((30, 20, 10))
    assert low.z == pytest.approx(0, abs=1e-7)  # on the ground, its middle over the origin
    np.testing.assert_allclose((low + high).xy, (0, 0), atol=1e-7)
    np.testing.assert_allclose(high - low, np.array([27, 15, 3]) * 0.0005, atol=1e-7)


def test_a_result_is_named_after_its_scan_though_that_was_imported_before(job_folder, tmp_path):
    scan = shutil.copy(job_folder / "volume.vdb", tmp_path / "wig.vdb")
    imported = scene.import_scan(scan)
    result = scene.load_result(job_folder)
    assert (imported.collection.name, result.collection.name) == ("CT2Hair wig import", "CT2Hair wig")
    assert (imported.volume.name, result.volume.name) == ("wig import Volume", "wig Volume")


def test_an_unreadable_scan_leaves_the_scene_as_it_was(tmp_path):
    before = block_counts()
    for name in ("none.tif", "none.vdb", "scan.xyz"):
        with pytest.raises(CT2HairError, match=name):
            scene.import_scan(tmp_path / name, folder=tmp_path)
    assert block_counts() == before


@pytest.mark.parametrize(
    ("path", "name"), [("a/wig.tif", "wig"), ("wig.nii.gz", "wig"), ("b/series", "series"), ("wig.2.vdb", "wig.2")]
)
def test_scans_are_named_after_their_file(path, name):
    assert scene.scan_name(path) == name
