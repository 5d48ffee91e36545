"""The operators: properties made from settings, results, reports, poll messages, bad input; jobs by a stand-in worker."""

import functools
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from ct2hair_addon.settings import PRESETS, Settings, parameters

from .conftest import Window, block_counts

pytestmark = pytest.mark.usefixtures("extension")
OPERATORS = ("import_scan", "reconstruct", "cancel", "load_result", "export", "render", "hair_colour")


@pytest.fixture
def properties(extension):
    return extension.operators.properties


@pytest.fixture
def stand_in(extension, job_folder, monkeypatch):
    """A worker that says what it is told to in place of the real one, for a job whose result is there already.

    Its last line waits until the file `until` exists, if one is named.
    """
    scene = extension.ct2hair_addon.scene
    jobs = extension.ct2hair_addon.jobs

    def install(*lines: str, code: int = 0, wait: float = 0.0, until: Path | None = None):
        script = textwrap.dedent(f"""
            import os, sys, time
            lines, until = {list(lines)!r}, {str(until) if until else None!r}
            for at, line in enumerate(lines):
                while until and at == len(lines) - 1 and not os.path.exists(until):
                    time.sleep(0.02)
                print(line, flush=True)
            time.sleep({wait})
            sys.exit({code})
        """)

        def start_job(scan, folder, settings, head=None, until=None, **options):
            log = jobs.JobFolder.create(scan, job_folder, settings)
            process = subprocess.Popen(
                [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
            )
            return jobs.Job(log, process)

        monkeypatch.setattr(scene, "start_job", start_job)

    return install


def test_all_operators_are_registered_with_a_description():
    for name in OPERATORS:
        operator = getattr(bpy.ops.ct2hair, name).get_rna_type()
        assert operator.name and len(operator.description) > 20, name
        for known in operator.properties:
            if known.identifier in ("scan", "folder", "name", "unit", "view", "samples", "size", "colour", "diameter"):
                assert known.description, (name, known.identifier)


def test_every_parameter_is_a_property_with_its_range_and_unit():
    groups = bpy.context.scene.ct2hair.settings
    for name, known in parameters():
        stage, key = name.split(".")
        rna = getattr(groups, stage).bl_rna.properties[key]
        assert known.metadata["help"].lower()[:20] in rna.description.lower(), name
        if known.metadata["unit"]:
            assert known.metadata["unit"] in rna.name and f"Unit: {known.metadata['unit']}" in rna.description
        if known.type in ("int", "float") and known.metadata["low"] is not None:
            assert rna.hard_min == pytest.approx(known.metadata["low"])
        if known.type in ("int", "float") and known.metadata["high"] is not None:
            assert rna.hard_max == pytest.approx(known.metadata["high"])
        if known.metadata["choices"]:
            assert [item.identifier for item in rna.enum_items] == list(known.metadata["choices"])


def test_properties_hold_the_very_settings(properties):
    group = bpy.context.scene.ct2hair.settings
    assert properties.settings_of(group).to_dict() == Settings().to_dict()
    for preset in PRESETS:
        properties.set_settings(group, Settings.preset(preset))
        assert properties.settings_of(group).to_dict() == Settings.preset(preset).to_dict()


def test_a_preset_leaves_scan_head_and_job_alone(properties):
    mine = bpy.context.scene.ct2hair
    mine.settings.run.seed, mine.settings.head.face = 7, "-y"
    mine.preset = "draft"
    settings = properties.settings_of(mine.settings)
    assert settings.run.seed == 7 and settings.head.face == "-y"
    for name, value in PRESETS["draft"].items():
        stage, key = name.split(".")
        assert getattr(getattr(settings, stage), key) == value


def test_load_result_and_undo(job_folder):
    bpy.ops.ed.undo_push(message="start")
    before = block_counts()
    assert bpy.ops.ct2hair.load_result(directory=str(job_folder), colour="blond") == {"FINISHED"}
    assert "CT2Hair wig" in bpy.data.collections
    bpy.ops.ed.undo_push(message="loaded")
    bpy.ops.ed.undo()
    assert block_counts() == before
    bpy.ops.ed.redo()
    assert len(bpy.data.objects["wig Hair"].data.curves) == 200


def test_bad_input_is_reported_and_changes_nothing(tmp_path):
    before = block_counts()
    with pytest.raises(RuntimeError, match="no report"):
        bpy.ops.ct2hair.load_result(directory=str(tmp_path))
    with pytest.raises(RuntimeError, match="no such file"):
        bpy.ops.ct2hair.import_scan(filepath=str(tmp_path / "none.vdb"))
    with pytest.raises(RuntimeError, match="No scan is chosen"):
        bpy.ops.ct2hair.reconstruct()
    with pytest.raises(RuntimeError, match="no such file"):
        bpy.ops.ct2hair.reconstruct(scan=str(tmp_path / "none.tif"), folder=str(tmp_path / "out"))
    assert block_counts() == before
    assert not (tmp_path / "out").exists()


def test_buttons_say_why_they_are_grey():
    for name in ("export", "render", "hair_colour"):
        with pytest.raises(RuntimeError, match=r"no result in the scene"):
            getattr(bpy.ops.ct2hair, name)()
    with pytest.raises(RuntimeError, match="No reconstruction is running"):
        bpy.ops.ct2hair.cancel()


def test_import_scan_shows_a_grid_and_remembers_it(job_folder):
    path = job_folder / "volume.vdb"
    assert bpy.ops.ct2hair.import_scan(filepath=str(path)) == {"FINISHED"}
    assert bpy.context.scene.ct2hair.scan == str(path)
    assert bpy.data.objects["volume import Volume"].type == "VOLUME"


def test_reconstruct_waits_without_a_window_and_loads_the_result(stand_in, job_folder):
    stand_in(
        '{"kind": "status", "stage": "scan", "text": "reading the scan"}',
        '{"kind": "progress", "stage": "scan", "fraction": 0.5, "total": 0.1, "remaining": 12.0}',
        '{"kind": "warning", "text": "the scan is small"}',
        '{"kind": "result", "out": "x", "strands": 200, "seconds": 1.0}',
    )
    scan = job_folder / "volume.vdb"
    bpy.ops.ct2hair.import_scan(filepath=str(scan))
    assert bpy.ops.ct2hair.reconstruct(folder=str(job_folder)) == {"FINISHED"}
    assert len(bpy.data.objects["wig Hair"].data.curves) == 200
    assert bpy.data.objects["volume import Volume"].hide_get()  # the result brings its own


@pytest.mark.parametrize(
    ("lines", "code", "message"),
    [
        (['{"kind": "error", "text": "no hair was found", "log": "l", "cancelled": false}'], 1, "no hair was found.*log.txt"),
        ([], -9, "ended without a word.*log.txt"),
    ],
)
def test_a_failed_job_says_why_and_leaves_the_scene(extension, stand_in, job_folder, lines, code, message):
    stand_in(*lines, code=code % 256)
    before = block_counts()
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.ct2hair.reconstruct(scan=str(job_folder / "volume.vdb"), folder=str(job_folder))
    assert block_counts() == before
    running = extension.operators.running.current
    assert running.job is None and running.failed and running.log.name == "log.txt"


def test_a_cancelled_job_leaves_the_scene(extension, stand_in, job_folder):
    stand_in('{"kind": "error", "text": "cancelled", "log": "l", "cancelled": true}', code=130)
    before = block_counts()
    assert bpy.ops.ct2hair.reconstruct(scan=str(job_folder / "volume.vdb"), folder=str(job_folder)) == {"CANCELLED"}
    assert block_counts() == before
    assert not extension.operators.running.current.failed


@pytest.fixture
def modal(extension, job_folder, monkeypatch):
    """Run the modal operator as a window would: (operator, context, step) with `step(event type)` -> what modal() returned."""
    module = extension.operators.reconstruct
    monkeypatch.setattr(module, "headless", lambda: False)
    cls, context, reports = module.CT2HAIR_OT_reconstruct, Window(), []
    methods = {key: getattr(cls, key) for key in ("_finish", "_leave", "_wait")}
    operator = SimpleNamespace(
        scan=str(job_folder / "volume.vdb"), folder=str(job_folder), until="result", _timer=None, reports=reports
    )
    operator.report = lambda kind, text: reports.append((*kind, text))
    for key, method in methods.items():
        setattr(operator, key, functools.partial(method, operator))

    def step(kind, value="NOTHING"):
        return cls.modal(operator, context, SimpleNamespace(type=kind, value=value))

    yield SimpleNamespace(start=lambda: cls.execute(operator, context), step=step, context=context, operator=operator, cls=cls)
    extension.operators.running.current.end("", failed=False)


def through(modal, seconds=60.0):
    """Timer events until the operator is through."""
    end = time.monotonic() + seconds
    while (outcome := modal.step("TIMER")) == {"PASS_THROUGH"} and time.monotonic() < end:
        time.sleep(0.02)
    return outcome


PROGRESS = (
    '{"kind": "status", "stage": "scan", "text": "reading the scan"}',
    '{"kind": "progress", "stage": "scan", "fraction": 0.5, "total": 0.1, "remaining": 12.0}',
)


def test_in_a_window_the_job_runs_beside_the_events(extension, stand_in, modal, tmp_path):
    go_on = tmp_path / "go on"
    stand_in(*PROGRESS, '{"kind": "result", "out": "x", "strands": 200, "seconds": 1.0}', until=go_on)
    before = block_counts()
    assert modal.start() == {"RUNNING_MODAL"} and modal.context.timers and modal.context.handlers
    assert modal.step("MOUSEMOVE") == {"PASS_THROUGH"}
    end = time.monotonic() + 60.0
    while "reading the scan 10% 12 s left" not in (modal.context.status or ""):
        assert modal.step("TIMER") == {"PASS_THROUGH"} and time.monotonic() < end
        assert block_counts() == before
        time.sleep(0.02)
    go_on.touch()
    assert through(modal) == {"FINISHED"}
    assert modal.context.status is None and not modal.context.timers
    assert len(bpy.data.objects["wig Hair"].data.curves) == 200
    assert ("INFO", "Reconstructed 200 strands: 'CT2Hair wig'") in modal.operator.reports
    assert extension.operators.running.current.job is None


def test_escape_cancels(extension, stand_in, modal):
    stand_in(*PROGRESS, wait=60)
    before = block_counts()
    modal.start()
    assert modal.step("ESC", "PRESS") == {"RUNNING_MODAL"}
    assert through(modal, 30.0) == {"CANCELLED"}  # the worker itself would go on for a minute
    assert block_counts() == before and not modal.context.timers
    assert modal.operator.reports[-1][0] == "WARNING"


def test_closing_the_file_ends_the_worker(extension, stand_in, modal):
    stand_in(*PROGRESS, wait=60)
    modal.start()
    process = extension.operators.running.current.job.process
    modal.cls.cancel(modal.operator, modal.context)
    assert process.poll() is not None and extension.operators.running.current.job is None


def test_cancel_ends_the_worker(extension, stand_in, job_folder):
    stand_in('{"kind": "status", "stage": "scan", "text": "reading"}', wait=60)
    current = extension.operators.running.current
    job = extension.ct2hair_addon.scene.start_job(job_folder / "volume.vdb", job_folder, Settings())
    current.begin(job, job_folder)
    try:
        with pytest.raises(RuntimeError, match="is running"):
            bpy.ops.ct2hair.clear_cache()
        assert bpy.ops.ct2hair.cancel() == {"FINISHED"}
        job.process.wait(timeout=5)
    finally:
        current.end("", failed=False)
    assert job.process.poll() is not None


def test_export_and_colour(job_folder, tmp_path):
    bpy.ops.ct2hair.load_result(directory=str(job_folder))
    out = tmp_path / "out"
    assert bpy.ops.ct2hair.export(directory=str(out), alembic=False, usd=False) == {"FINISHED"}
    assert (out / "hair.blend").is_file() and (out / "report.html").is_file()
    with pytest.raises(RuntimeError, match="at least one format"):
        bpy.ops.ct2hair.export(directory=str(out), blend=False, alembic=False, usd=False)
    bpy.context.scene.ct2hair.colour = "white"
    assert bpy.ops.ct2hair.hair_colour() == {"FINISHED"}
    shader = bpy.data.objects["wig Hair"].active_material.node_tree.nodes["Hair"]
    assert shader.inputs["Melanin"].default_value == pytest.approx(0.03)


def test_render_writes_a_picture(job_folder, tmp_path):
    bpy.ops.ct2hair.load_result(directory=str(job_folder))
    assert bpy.ops.ct2hair.render(filepath=str(tmp_path / "look.png"), samples=1, size=16) == {"FINISHED"}
    assert (tmp_path / "look.png").is_file()


def test_the_command_line_answers_with_exit_codes(extension, capsys):
    assert extension.operators.command.run(["--version"]) == 0
    assert "ct2hair" in capsys.readouterr().out
    assert extension.operators.command.run(["no-such-command"]) == 2


def test_the_extension_can_be_switched_off_and_on(extension):
    extension.unregister()
    try:
        assert not hasattr(bpy.types.Scene, "ct2hair")
        assert not hasattr(bpy.types, "CT2HAIR_OT_reconstruct")
    finally:
        extension.register()
    assert bpy.context.scene.ct2hair.preset == "standard"
