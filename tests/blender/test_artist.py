"""What an artist does beside the reconstruction: look, edit, exchange, presets, preferences, the line of jobs, big hair."""

import json
import sys
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from ct2hair_addon import scene
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.scene.attributes import read_attribute
from ct2hair_addon.settings import ScanSettings, Settings
from ct2hair_addon.strand_files import read_strands
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import Inspection

from .conftest import block_counts, strands_on

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def result(job_folder):
    return scene.load_result(job_folder)


def attempt(name, **values):
    return getattr(bpy.ops.ct2hair, name)(**values)


# --- editing


def test_regions_part_the_scalp_and_know_left_from_right(result, dome):
    measured = scene.measure_regions(result)
    assert sum(measured[name].strands for name in scene.REGIONS) == measured["all"].strands == 200
    assert sum(measured[name].area for name in scene.REGIONS) == pytest.approx(measured["all"].area)
    assert measured["all"].density == pytest.approx(200 / measured["all"].area)
    backed = Strands.load(result.folder / "hair.npz").strand_attributes["support"]
    assert measured["all"].support == pytest.approx(backed.mean())
    from ct2hair_addon.scene.editing import region_of

    points = np.array([[0, -80, 40], [0, 0, 90], [80, 0, 40], [-80, 0, 40], [0, 80, 40]], float)
    assert [list(scene.REGIONS)[n] for n in region_of(points, dome)] == ["front", "crown", "left", "right", "back"]


def test_trimming_cuts_to_the_very_length_and_undo_brings_it_back(result):
    hair = result.hair.name
    before = scene.strands_of(result.hair).lengths()
    bpy.ops.ed.undo_push(message="before")
    assert attempt("trim", length=40.0) == {"FINISHED"}
    strands = scene.strands_of(result.hair)
    np.testing.assert_allclose(strands.lengths(), np.minimum(before, 40.0), atol=1e-3)
    assert strands.strand_attributes["support"].shape == (200,) and result.hair.data.surface == result.head
    assert attempt("trim", length=40.0) == {"FINISHED"}
    bpy.ops.ed.undo_push(message="trimmed")
    bpy.ops.ed.undo()
    np.testing.assert_allclose(scene.strands_of(bpy.data.objects[hair]).lengths(), before, atol=1e-4)
    with pytest.raises(CT2HairError, match="region 'ear'"):
        scene.trim(scene.active_result(), 10.0, "ear")


def test_trimming_a_region_leaves_the_others(result, dome):
    from ct2hair_addon.scene.editing import region_of

    before = scene.strands_of(result.hair)
    assert attempt("trim", region="left", length=20.0) == {"FINISHED"}
    left = region_of(before.roots, scene.head_mesh(result.head)) == list(scene.REGIONS).index("left")
    after = scene.strands_of(result.hair).lengths()
    np.testing.assert_allclose(after[left], 20.0, atol=1e-3)
    np.testing.assert_allclose(after[~left], before.lengths()[~left], atol=1e-4)


def test_a_region_grows_anew_from_the_guides(result):
    before = scene.strands_of(result.hair)
    assert attempt("regrow", region="crown", count=30, seed=4) == {"FINISHED"}
    after = scene.strands_of(result.hair)
    crown = list(scene.REGIONS).index("crown")
    from ct2hair_addon.scene.editing import region_of

    mesh = scene.head_mesh(result.head)
    assert np.count_nonzero(region_of(after.roots, mesh) == crown) == 30
    others = region_of(before.roots, mesh) != crown
    np.testing.assert_allclose(after.roots[: np.count_nonzero(others)], before.roots[others], atol=1e-4)
    grown = after.select(np.arange(len(after) - 30, len(after)))  # guides of the region, and what was made up from them
    support = grown.strand_attributes["support"]
    assert 0 < np.count_nonzero(support) < 10
    np.testing.assert_array_equal(grown.point_attributes["support"], np.repeat(support, grown.counts))
    bpy.data.objects.remove(result.guides)
    with pytest.raises(RuntimeError, match="no guides"):
        attempt("regrow", region="crown")


def test_confidence_is_shown_and_taken_back(result):
    own = result.hair.active_material
    assert attempt("show", what="confidence") == {"FINISHED"}
    nodes = result.hair.active_material.node_tree.nodes
    assert any(getattr(node, "attribute_name", "") == "support" for node in nodes)
    assert attempt("show", what="guides") == {"FINISHED"}
    assert result.hair.active_material == own and result.hair.hide_get() and not result.guides.hide_get()
    assert attempt("show", what="hair") == {"FINISHED"}
    assert not result.hair.hide_get() and result.guides.hide_get() and result.volume.hide_get()
    result.hair.data.attributes.remove(result.hair.data.attributes["support"])
    with pytest.raises(RuntimeError, match="attribute 'support'"):
        attempt("show", what="confidence")


def test_the_cloud_takes_colours_and_the_hair_width(result):
    bpy.context.scene.ct2hair.density = "x_ray"
    assert attempt("density_colours") == {"FINISHED"}
    colour = result.volume.active_material.node_tree.nodes["Colours"].color_ramp.elements[0].color
    np.testing.assert_allclose(colour[:3], scene.DENSITY_PRESETS["x_ray"][0][1], atol=1e-6)
    assert attempt("full_width") == {"FINISHED"} and attempt("full_width", on=False) == {"FINISHED"}


def test_buttons_without_a_result_say_why():
    for name in ("show", "measure", "trim", "regrow", "simulate", "clear_simulation", "turntable", "full_width"):
        with pytest.raises(RuntimeError, match="no result in the scene"):
            attempt(name)
    for name, why in (
        ("density_colours", "no scan in the scene"),
        ("look", "No scan is chosen"),
        ("thresholds", "look at the scan first"),
        ("place_head", "import it first"),
        ("use_place", "Place by Hand"),
        ("add_landmarks", "Place by Hand"),
        ("fit_landmarks", "Place by Hand"),
        ("forget_place", "automatically already"),
        ("scalp_from_selection", "active object"),
        ("paint_scalp", "active object"),
        ("unqueue", "waits in line"),
        ("resume", "no unfinished job"),
    ):
        with pytest.raises(RuntimeError, match=why):
            attempt(name)


def test_the_simulation_by_its_operator(result, job_folder):
    owner = bpy.context.scene
    owner.frame_start, owner.frame_end = 1, 3
    with pytest.raises(RuntimeError, match="not simulated"):
        attempt("clear_simulation")
    assert attempt("simulate") == {"FINISHED"}
    assert (job_folder / "simulation.pc2").is_file() and scene.simulated_frames(result) == (1, 3)
    assert attempt("clear_simulation") == {"FINISHED"}
    owner.frame_end = 1
    with pytest.raises(RuntimeError, match="two frames"):
        attempt("simulate")


def test_a_turntable_is_rendered(result, tmp_path):
    assert attempt("turntable", directory=str(tmp_path), frames=2, samples=1, size=16) == {"FINISHED"}
    assert sorted(p.name for p in tmp_path.glob("turn*.png")) == ["turntable_0000.png", "turntable_0001.png"]
    with pytest.raises(RuntimeError, match="Choose a folder"):
        attempt("turntable")


# --- head


def test_the_mannequin_is_added_and_its_scalp_changed():
    assert attempt("add_head") == {"FINISHED"}
    ob = bpy.context.active_object
    assert scene.head_mesh(ob).scalp.sum() > 1000
    with bpy.context.temp_override(active_object=ob, object=ob):
        for vertex in ob.data.vertices:
            vertex.select = False
        with pytest.raises(RuntimeError, match="no selected vertex"):
            attempt("scalp_from_selection")
        for polygon in list(ob.data.polygons)[:4]:
            for vertex in polygon.vertices:
                ob.data.vertices[vertex].select = True
        wanted = {v for polygon in list(ob.data.polygons)[:4] for v in polygon.vertices}
        assert attempt("scalp_from_selection") == {"FINISHED"}
    assert set(np.flatnonzero(scene.head_mesh(ob).scalp)) == wanted
    assert attempt("paint_scalp") == {"FINISHED"} and ob.mode == "WEIGHT_PAINT"
    bpy.ops.object.mode_set(mode="OBJECT")


def test_a_head_placed_by_hand_becomes_the_setting(job_folder):
    from ct2hair_addon.head.registration import placed_by_hand

    bpy.ops.ct2hair.import_scan(filepath=str(job_folder / "volume.vdb"))
    assert attempt("place_head") == {"FINISHED"}
    ob = bpy.context.active_object
    ob.scale = 1.1, 1.1, 1.1
    ob.rotation_euler = 0.2, 0.1, 0.5
    bpy.context.view_layer.update()
    assert attempt("use_place") == {"FINISHED"}
    matrix = placed_by_hand(bpy.context.scene.ct2hair.settings.head.place)
    empty = bpy.data.objects["volume import Scan"]
    point = np.array([12.0, -30.0, 90.0, 1.0])  # mm in the head
    world = np.array(ob.matrix_world) @ [*(point[:3] / 1000), 1.0]
    np.testing.assert_allclose((np.array(empty.matrix_world) @ matrix @ point)[:3], world[:3], atol=1e-6)
    assert attempt("forget_place") == {"FINISHED"} and not bpy.context.scene.ct2hair.settings.head.place
    ob.scale.x = 2.0
    with pytest.raises(RuntimeError, match="unevenly"):
        attempt("use_place")


def test_landmarks_that_are_dragged_move_the_head(job_folder):
    bpy.ops.ct2hair.import_scan(filepath=str(job_folder / "volume.vdb"))
    assert attempt("place_head") == {"FINISHED"}
    head = bpy.context.active_object
    with pytest.raises(RuntimeError, match="no landmarks"):
        attempt("fit_landmarks")
    assert attempt("add_landmarks") == {"FINISHED"}
    empties = scene.landmarks_of(head)
    assert len(empties) == 5 and bpy.context.active_object in empties
    wanted = Matrix.Translation((0.02, -0.01, 0.03)) @ Matrix.Rotation(0.4, 4, "Z") @ Matrix.Scale(1.05, 4)
    for ob in empties:
        ob.location = wanted @ ob.location
    bpy.data.objects.remove(empties[0])  # one that can't be seen
    before = head.matrix_world.copy()
    assert attempt("fit_landmarks") == {"FINISHED"} and bpy.context.active_object == head
    bpy.context.view_layer.update()
    np.testing.assert_allclose(np.array(head.matrix_world), np.array(wanted @ before), atol=1e-5)
    assert attempt("use_place") == {"FINISHED"} and bpy.context.scene.ct2hair.settings.head.place
    assert all(ob.hide_get() for ob in (head, *scene.landmarks_of(head)))
    for ob in scene.landmarks_of(head)[1:]:
        bpy.data.objects.remove(ob)
    with pytest.raises(RuntimeError, match="at least 3"):
        attempt("fit_landmarks")


# --- looking


def test_a_look_comes_back_from_its_file(inspection, tmp_path):
    inspection.save(tmp_path / "look.npz")
    back = Inspection.load(tmp_path / "look.npz")
    assert back.thresholds == inspection.thresholds and back.shape == (60, 80, 100)
    np.testing.assert_array_equal(back.look, inspection.look)
    (tmp_path / "bad.npz").write_bytes(b"PK")
    with pytest.raises(CT2HairError, match="not a look at a scan"):
        Inspection.load(tmp_path / "bad.npz")


def test_the_histogram_shows_thresholds_found_and_chosen(inspection):
    from ct2hair_addon.scene.looks import THRESHOLD_COLOURS, value_range

    picture = scene.histogram_picture(inspection, ScanSettings(knots=1500.0))
    values = scene.threshold_values(inspection, ScanSettings(knots=1500.0))
    assert values == {"air": 1000.0, "hair": 1200.0, "knots": 1500.0}
    low, high = value_range(inspection, values)
    for name, value in values.items():
        column = picture[:, int((value - low) / (high - low) * 511), :3]
        share = np.isclose(column, THRESHOLD_COLOURS[name]).all(axis=1).mean()
        assert share == (1.0 if name == "knots" else pytest.approx(0.625, abs=0.01)), name
    assert picture[0, :, 0].max() > 0.5 and picture.shape == (512, 512, 4)


def test_a_slice_shows_the_lump_where_it_is(inspection):
    picture = scene.slice_picture(inspection, 2, 42 / 49, ScanSettings(), size=160)  # across z: x to the right, y up
    tinted = np.argwhere(picture[..., 0] - picture[..., 2] > 0.3)
    row, column = tinted.mean(axis=0)
    assert row == pytest.approx(32 / 40 * 160, abs=3) and column == pytest.approx(20 + 7 / 30 * 120, abs=3)
    away = scene.slice_picture(inspection, 2, 0.0, ScanSettings(), size=160)
    assert not (away[..., 0] - away[..., 2] > 0.3).any()


def test_thresholds_by_hand_and_back_with_pictures_and_cost(extension, inspection):
    look, owner = extension.operators.look, bpy.context.scene.ct2hair
    owner.scan = "/tmp/wig.nrrd"
    look._pictures.clear()
    look._pictures.inspection = extension.ct2hair_addon.volume.Inspection(**inspection.__dict__)
    look._pictures.scan = owner.scan
    try:
        assert attempt("thresholds") == {"FINISHED"} and owner.settings.scan.hair == 1200.0
        for icon in (look.histogram_icon, look.slice_icon):
            assert isinstance(icon(bpy.context), int)  # 0 without a window
        first = dict(look._pictures.shown)
        look.slice_icon(bpy.context)
        assert look._pictures.shown == first  # drawn once
        owner.slice_at = 0.9
        look.histogram_icon(bpy.context), look.slice_icon(bpy.context)
        again = look._pictures.shown
        assert again["slice"] != first["slice"] and again["histogram"] == first["histogram"]
        assert set(look._pictures.previews) == {title for _, title in again.values()}
        assert attempt("thresholds", automatic=True) == {"FINISHED"} and owner.settings.scan.hair == 0.0
        minutes, memory = look.cost(bpy.context)
        assert 0.3 < minutes < 5 and 1 < memory < 2
    finally:
        look._pictures.clear()


def test_a_look_that_fails_says_why(job_folder, tmp_path):
    owner = bpy.context.scene.ct2hair
    owner.folder = str(tmp_path)
    owner.scan = str(tmp_path / "none.tif")
    with pytest.raises(RuntimeError, match="no such file"):
        attempt("look")
    owner.scan = str(tmp_path / "bad.npy")
    (tmp_path / "bad.npy").write_bytes(b"not numbers at all")
    with pytest.raises(RuntimeError, match=r"bad\.npy"):
        attempt("look")


# --- exchange


@pytest.mark.parametrize(
    ("ending", "unit", "up"), [("bin", "mm", "z"), ("data", "m", "y"), ("hair", "cm", "y"), ("npz", "m", "z")]
)
def test_strand_files_go_out_and_come_back_on_a_head(result, dome, tmp_path, ending, unit, up):
    only = dict.fromkeys(("blend", "alembic", "usd"), False) | {ending: True}
    assert attempt("export", directory=str(tmp_path), strand_unit=unit, strand_up=up, **only) == {"FINISHED"}
    path = tmp_path / f"hair.{ending}"
    raw = read_strands(path).points * {"mm": 1.0, "cm": 10.0, "m": 1000.0}[unit]
    mine = scene.strands_of(result.hair).points
    np.testing.assert_allclose(raw, mine if up == "z" else np.stack([mine[:, 0], mine[:, 2], -mine[:, 1]], axis=1), atol=1e-3)
    back = scene.import_strands(path, up=up, head=result.head)
    np.testing.assert_allclose(scene.strands_of(back.hair).points, mine, atol=1e-3)
    assert back.hair.data.surface == back.head and back.collection["ct2hair_source"].endswith(path.name)


def test_hair_that_does_not_fit_is_refused(result, tmp_path):
    path = tmp_path / "far.data"
    from ct2hair_addon.strand_files import write_strands

    strands = scene.strands_of(result.hair)
    write_strands(strands.with_points(strands.points + np.float32(500)), path)
    before = block_counts()
    with pytest.raises(CT2HairError, match="mm from the head"):
        scene.import_strands(path, head=result.head)
    with pytest.raises(RuntimeError, match="no head"):
        attempt("import_hair", filepath=str(path), on="scene")
    with pytest.raises(RuntimeError, match="no such file"):
        attempt("import_hair", filepath=str(tmp_path / "none.hair"))
    write_strands(strands.with_points(strands.points * np.float32(0.01)), path)
    with pytest.raises(CT2HairError, match="choose the unit"):
        scene.import_strands(path, head=result.head)
    assert block_counts() == before


# --- presets, preferences


def test_parameters_go_to_json_and_back(tmp_path):
    owner = bpy.context.scene.ct2hair
    owner.settings.guides.step = 0.5
    assert attempt("settings_save", filepath=str(tmp_path / "mine.json")) == {"FINISHED"}
    assert Settings.from_json((tmp_path / "mine.json").read_text(encoding="utf-8")).guides.step == 0.5
    owner.settings.guides.step = 1.0
    assert attempt("settings_load", filepath=str(tmp_path / "mine.json")) == {"FINISHED"}
    assert owner.settings.guides.step == 0.5
    (tmp_path / "bad.json").write_text('{"guides": {"step": -1}}')
    with pytest.raises(RuntimeError, match="expected"):
        attempt("settings_load", filepath=str(tmp_path / "bad.json"))


def test_a_preset_is_kept_in_a_file_and_played(tmp_path, monkeypatch):
    def user_resource(kind, path="", create=False):
        (tmp_path / path).mkdir(parents=True, exist_ok=True)
        return str(tmp_path / path)

    monkeypatch.setattr(bpy.utils, "user_resource", user_resource)
    owner = bpy.context.scene.ct2hair
    owner.settings.guides.step, owner.settings.scan.spacing = 0.25, 0.7
    assert bpy.ops.ct2hair.preset_add(name="fine") == {"FINISHED"}
    (file,) = tmp_path.rglob("fine.py")
    owner.settings.guides.step, owner.settings.scan.spacing = 1.0, 0.3
    exec(compile(file.read_text(encoding="utf-8"), str(file), "exec"), {})
    assert owner.settings.guides.step == 0.25 and owner.settings.scan.spacing == pytest.approx(0.3)


def test_another_python_is_checked():
    with pytest.raises(RuntimeError, match=r"lacks .*openvdb"):  # which comes with Blender, not with its Python
        attempt("check_python", python=sys.executable)
    with pytest.raises(RuntimeError, match="no such program"):
        attempt("check_python", python="/no/such/python")
    with pytest.raises(RuntimeError, match="does not answer"):
        attempt("check_python", python="/bin/true")


def test_the_preferences_reach_the_worker(extension, tmp_path):
    module = extension.operators.preferences
    known = SimpleNamespace(
        cache=str(tmp_path), threads=3, memory=2.5, device="cpu", python="/opt/python", log_level="verbose", beside_blend=True
    )
    options = module.worker_options(known)
    assert options["python"] == "/opt/python"
    assert options["environment"] == {
        "CT2HAIR_LOG_LEVEL": "verbose",
        "CT2HAIR_CACHE": str(tmp_path),
    }
    settings = module.with_machine(extension.ct2hair_addon.settings.Settings(), known)
    assert settings.run.threads == 3 and settings.run.memory == 2.5 and settings.run.device == "cpu"
    own = module.with_machine(settings.changed({"run.threads": 1, "run.device": "cuda"}), known).run
    assert own.threads == 1 and own.device == "cuda"


def test_only_our_own_is_cleared_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CT2HAIR_CACHE", str(tmp_path))
    for name in ("jobs/wig/hair.npz", "kernels/a.nbi", "letters/mine.txt"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("x")
    assert attempt("clear_cache") == {"FINISHED"}
    assert [p.name for p in tmp_path.iterdir()] == ["letters"]


# --- jobs


def test_a_stopped_job_shows_its_stage(job_folder):
    report = json.loads((job_folder / "report.json").read_text(encoding="utf-8"))
    state = {"program": {"version": "0.1.0"}, "settings": {}, **{key: report[key] for key in ("scan", "head")}}
    along_x = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]], np.float32)
    lines = Strands(np.concatenate([along_x, along_x + 1]), np.array([0, 2, 4]), {"confidence": np.ones(2, np.float32)})
    lines.transformed(np.array(report["head"]["head_to_scan"])).save(job_folder / "orientation.npz")
    kinds_of = {"scan": {"VOLUME"}, "head": {"VOLUME", "MESH"}, "orientation": {"VOLUME", "MESH", "CURVES"}}
    kinds_of["guides"] = kinds_of["orientation"]
    for until, kinds in kinds_of.items():
        head = {} if until == "scan" else state["head"]
        (job_folder / "stage.json").write_text(json.dumps({**state, "until": until, "head": head}))
        collection = scene.load_stage(job_folder)
        assert {ob.type for ob in collection.all_objects} - {"EMPTY"} == kinds, until
        assert collection["ct2hair_folder"] == str(job_folder.resolve())
        if until == "orientation":
            shown = next(ob for ob in collection.all_objects if ob.type == "CURVES")
            direction = read_attribute(shown.data, "direction")
            np.testing.assert_allclose(np.abs(direction), [[1, 0, 0]] * 2, atol=1e-4)  # along x of the head again
            assert len(read_attribute(shown.data, "confidence")) == 2
        scene.remove_collection(collection)
    (job_folder / "stage.json").write_text("{}")
    with pytest.raises(CT2HairError, match="not the state of a job"):
        scene.load_stage(job_folder)


def test_a_file_saved_in_the_middle_offers_to_resume(extension, job_folder, tmp_path, capsys):
    jobs = extension.ct2hair_addon.jobs
    settings = extension.ct2hair_addon.settings.Settings().changed({"guides.step": 0.5})
    jobs.JobFolder.create(job_folder / "volume.vdb", job_folder, settings)
    bpy.context.scene.ct2hair.unfinished = str(job_folder)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "half.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "half.blend"))
    assert "unfinished job" in capsys.readouterr().out
    owner = bpy.context.scene.ct2hair
    assert owner.unfinished == str(job_folder)
    assert attempt("resume", discard=True) == {"FINISHED"} and not owner.unfinished
    owner.unfinished = str(tmp_path)
    with pytest.raises(RuntimeError, match="not a job description"):
        attempt("resume")


def stand_in_job(folder, **values):
    known = {"text": "", "stage": "start", "fraction": 0.1, "remaining": None, "warnings": [], "close": lambda: None}
    return SimpleNamespace(**{**known, "log_path": folder / "log", **values})


def test_jobs_wait_in_line_and_can_leave_it(extension, job_folder, tmp_path):
    running = extension.operators.running
    job = stand_in_job(tmp_path, stage="head", result=None)
    running.current.begin(job, job_folder)
    try:
        scan = str(job_folder / "volume.vdb")
        with pytest.raises(RuntimeError, match="choose another folder"):
            bpy.ops.ct2hair.reconstruct(scan=scan, folder=str(job_folder))
        for name in ("one", "two"):
            assert bpy.ops.ct2hair.reconstruct(scan=scan, folder=str(tmp_path / name)) == {"FINISHED"}
        assert [request.folder.name for request in running.current.waiting] == ["one", "two"]
        with pytest.raises(RuntimeError, match="is running"):
            bpy.context.scene.ct2hair.unfinished = "x"
            bpy.ops.ct2hair.resume()
        assert attempt("unqueue", index=0) == {"FINISHED"}
        with pytest.raises(RuntimeError, match="Only 1 jobs wait"):
            attempt("unqueue", index=4)
        assert [request.folder.name for request in running.current.waiting] == ["two"]
    finally:
        running.current.end_all("")
    assert running.current.stages == {"head": "stopped"} and not running.current.waiting


def test_another_file_ends_the_worker(extension, tmp_path):
    ended = []
    job = stand_in_job(tmp_path, close=lambda: ended.append(1))
    extension.operators.running.current.begin(job, tmp_path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert ended and extension.operators.running.current.job is None


def test_a_hundred_thousand_strands_arrive_in_three_seconds(dome, tmp_path):
    strands = strands_on(dome, 100_000, 64)[0]
    strands_on(dome, 10)  # numba is warm
    begun = time.perf_counter()
    result = scene.show_strands(strands, dome, "many")
    seconds = time.perf_counter() - begun
    assert len(result.hair.data.curves) == 100_000 and len(result.hair.data.points) == 6_400_000
    print(f"100,000 x 64 points in {seconds:.2f} s")
    assert seconds < 3.0, f"{seconds:.2f} s"


def test_strands_are_cut_exactly():
    from ct2hair_addon.scene.editing import cut_to

    line = Strands.from_polylines([np.array([[0, 0, 0], [0, 0, 10.0], [0, 0, 20.0]]), np.array([[1.0, 0, 0], [1.0, 0, 4.0]])])
    cut = cut_to(line, 12.5)
    assert cut.counts.tolist() == [3, 2]
    np.testing.assert_allclose(cut.points[2], [0, 0, 12.5])
    np.testing.assert_allclose(cut_to(line, np.array([10.0, 1.0])).lengths(), [10.0, 1.0])
