"""The whole job on a small raw scan: outputs, resume after a kill in each stage, refusals that leave nothing behind."""

from __future__ import annotations

import json
import signal
import sys

import numpy as np
import pytest
import torch

from ct2hair_addon import cli, pipeline
from ct2hair_addon.errors import Cancelled, CT2HairError, ScanError
from ct2hair_addon.evaluation import evaluate, hairstyle, synthesize
from ct2hair_addon.evaluation.scores import strand_scores
from ct2hair_addon.head import Head, load_obj, template_head
from ct2hair_addon.jobs import start
from ct2hair_addon.orientation.field import LINES
from ct2hair_addon.settings import STOPS, Settings
from ct2hair_addon.strands import Strands

SPACING = 0.9
SETTINGS = Settings.preset("draft").changed({"head.face": "-y", "head.up": "+z"})


@pytest.fixture(scope="session")
def scan(tmp_path_factory):
    """A raw scan of a bob of 1500 strands at 0.9 mm (fill 1215, as hard as the paper's)."""
    path = tmp_path_factory.mktemp("scan") / "bob.vdb"
    head = template_head()
    synthesize(hairstyle("bob", head, 1500, 11), head, path, SPACING, snr=4.0, seed=11)
    return path


@pytest.fixture(scope="session")
def result(scan, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    return out, pipeline.reconstruct(scan, out, SETTINGS)


def test_the_result_folder_holds_what_it_should(result):
    out, made = result
    hair, guides = Strands.load(out / "hair.npz"), Strands.load(out / "guides.npz")
    assert hair.points.dtype == np.float32 and hair.offsets.dtype == np.int64
    for strands in (hair, guides):
        assert strands.strand_attributes["root_uv"].shape == (len(strands), 2)
        support = strands.strand_attributes["support"]
        assert support.shape == (len(strands),) and support.min() >= 0 and support.max() <= 1
    assert np.isfinite(hair.points).all() and hair.counts.min() >= 2
    assert len(load_obj(out / "head.obj").vertices) == len(made.head.vertices)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert [stage["name"] for stage in report["stages"]] == list(pipeline.STAGES)
    assert report["hair"]["strands"] == len(hair)
    assert "<html" in (out / "report.html").read_text(encoding="utf-8")[:500].lower()
    assert (out / "volume.vdb").stat().st_size > 10_000


def test_the_hair_is_rooted_outside_the_head_and_like_the_truth(result, scan):
    out, made = result
    hair, head = Strands.load(out / "hair.npz"), Head(made.head)
    assert np.mean(head.closest_scalp(hair.roots).distance < 0.5) > 0.95
    assert np.mean(head.signed_distance(hair.points) < -0.1) < 0.005
    truth = Strands.load(scan.with_name("bob.strands.npz"))
    scores = evaluate(truth, hair, None, voxels=(2.0,))
    assert scores["strand"]["2/20"]["f"] > 0.6
    assert scores["voxel"]["2"]["iou"] > 0.5


def test_the_same_call_again_reuses_every_stage(result, scan):
    out, _ = result
    before = (out / "hair.npz").read_bytes()
    again = pipeline.reconstruct(scan, out, SETTINGS)
    assert all(stage["resumed"] for stage in again.report["stages"] if stage["name"] != "result")
    assert (out / "hair.npz").read_bytes() == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_job_killed_in_each_stage_goes_on_and_ends_the_same_bit_for_bit(result, scan, tmp_path):
    undisturbed = (result[0] / "hair.npz").read_bytes()
    seen = []
    for stage in (*pipeline.STAGES, None):
        job = start(scan, tmp_path / "out", SETTINGS)
        try:
            while job.running:
                messages = job.poll()
                if stage and any(m.kind == "progress" and m.data["stage"] == stage for m in messages):
                    job.process.send_signal(signal.SIGKILL)
                    seen.append(stage)
                    break
            if stage is None:
                assert job.wait(600) is not None, job.error
        finally:
            job.close()
    assert seen == list(pipeline.STAGES)
    assert (tmp_path / "out" / "hair.npz").read_bytes() == undisturbed


def test_a_cancelled_run_keeps_its_finished_stages(result, scan, tmp_path):
    class Impatient(pipeline.Silent):
        def progressed(self, stage, fraction, total, remaining):
            if stage == "guides":
                raise Cancelled

    with pytest.raises(Cancelled):
        pipeline.reconstruct(scan, tmp_path / "out", SETTINGS, observer=Impatient())
    assert sorted(p.name for p in (tmp_path / "out" / "checkpoints").iterdir()) == ["head.npz", "orientation.npz", "scan.npz"]
    assert not (tmp_path / "out" / "hair.npz").exists()


def test_stopped_after_each_stage_it_shows_what_there_is_and_ends_as_if_it_had_not(result, scan, tmp_path):
    out = tmp_path / "out"
    more = {
        "scan": {"volume.vdb"},
        "head": {"head.obj"},
        "orientation": {"orientation.vdb", "orientation.npz"},
        "guides": {"guides.npz"},
        "dense": {"dense.npz"},
    }
    assert tuple(more) == STOPS
    there = {"checkpoints", "stage.json"}
    for stage, files in more.items():
        assert pipeline.reconstruct(scan, out, SETTINGS, until=stage) is None
        there |= files
        assert {path.name for path in out.iterdir()} - {".running"} == there
        assert json.loads((out / "stage.json").read_text(encoding="utf-8"))["until"] == stage
    lines = Strands.load(out / "orientation.npz")
    assert len(lines) == LINES and set(lines.counts) == {2}
    estimated = (out / "orientation.vdb").read_bytes()
    made = pipeline.reconstruct(scan, out, SETTINGS.changed({"run.orientation": True}))
    assert all(stage["resumed"] for stage in made.report["stages"] if stage["name"] in ("scan", "head", "guides", "dense"))
    assert (out / "hair.npz").read_bytes() == (result[0] / "hair.npz").read_bytes()
    assert (out / "orientation.vdb").read_bytes() != estimated  # with the guides in it
    with pytest.raises(CT2HairError, match="unknown stage 'end'"):
        pipeline.reconstruct(scan, out, SETTINGS, until="end")


@pytest.mark.parametrize("mannequin", ["shell", "none"])
def test_knots_are_counted_where_there_is_a_mannequin(mannequin, tmp_path, monkeypatch):
    head = template_head()
    synthesize(hairstyle("bob", head, 1500, 11), head, tmp_path / "bob.vdb", 1.2, snr=4.0, seed=11, mannequin=mannequin)
    told = []

    def listen(*args, counted, **kwargs):
        told.append(counted)
        raise CT2HairError("heard enough")

    monkeypatch.setattr(pipeline, "trace_guides", listen)
    with pytest.raises(CT2HairError, match="heard enough"):
        pipeline.reconstruct(tmp_path / "bob.vdb", tmp_path / "out", SETTINGS)
    assert told == [mannequin != "none"]


def test_a_scan_that_is_not_there_leaves_nothing(tmp_path):
    with pytest.raises(ScanError, match=r"absent\.vdb"):
        pipeline.reconstruct(tmp_path / "absent.vdb", tmp_path / "out", SETTINGS)
    assert not (tmp_path / "out").exists()


def test_a_real_head_without_hair_is_refused_and_leaves_nothing(shared_data, tmp_path, capsys):
    scan = shared_data / "ct" / "CT_AVM.nii.gz"
    assert cli.main(["reconstruct", str(scan), "--out", str(tmp_path / "out")]) == cli.REFUSED
    assert "no hair" in capsys.readouterr().err.lower()
    assert not (tmp_path / "out").exists()


def test_two_runs_do_not_share_a_folder(scan, tmp_path):
    out = tmp_path / "out"
    with pipeline._own_folder(out), pytest.raises(CT2HairError, match="another reconstruction"):
        pipeline.reconstruct(scan, out, SETTINGS)


def test_too_little_memory_is_said_before_the_long_stages(scan, tmp_path):
    settings = SETTINGS.changed({"run.memory": 0.1})
    with pytest.raises(CT2HairError, match="GB of memory"):
        pipeline.reconstruct(scan, tmp_path / "out", settings)


def test_a_card_that_is_not_there_is_said_at_once(scan, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CT2HairError, match=r"run\.device is cuda"):
        pipeline.reconstruct(scan, tmp_path / "out", SETTINGS.changed({"run.device": "cuda"}))
    assert not (tmp_path / "out").exists()


def test_guides_are_amended_and_an_interrupted_amendment_goes_on_from_the_traced_ones(scan, tmp_path, monkeypatch):
    settings = SETTINGS.changed({"guides.amend": 1})
    traced = tmp_path / "out" / "checkpoints" / "traced.npz"
    rooting, tracing = pipeline.amend_guides, pipeline.trace_guides

    def cut_off(*args, **kwargs):
        raise Cancelled

    monkeypatch.setattr(pipeline, "amend_guides", cut_off)
    with pytest.raises(Cancelled):
        pipeline.reconstruct(scan, tmp_path / "out", settings, until="guides")
    assert traced.exists() and not (tmp_path / "out" / "guides.npz").exists()
    monkeypatch.setattr(pipeline, "amend_guides", rooting)
    monkeypatch.setattr(pipeline, "trace_guides", cut_off)
    assert pipeline.reconstruct(scan, tmp_path / "out", settings, until="guides") is None
    assert not traced.exists()
    monkeypatch.setattr(pipeline, "trace_guides", tracing)
    truth = Strands.load(scan.with_suffix(".strands.npz"))
    amended = Strands.load(tmp_path / "out" / "guides.npz")
    assert pipeline.reconstruct(scan, tmp_path / "plain", SETTINGS, until="guides") is None
    plain = Strands.load(tmp_path / "plain" / "guides.npz")
    scores = [strand_scores(truth, guides)["strand"]["1/10"]["f"] for guides in (plain, amended)]
    assert scores[1] > scores[0] + 0.01


def test_an_interrupted_run_goes_on_after_the_last_amendment(scan, tmp_path, monkeypatch):
    settings, amending, calls = SETTINGS.changed({"guides.amend": 2}), pipeline.amend_guides, []
    assert pipeline.reconstruct(scan, tmp_path / "whole", settings, until="guides") is None

    def cut_off_at_the_second(*args, **kwargs):
        calls.append(args[0].points.tobytes())  # of two amendments the pieces may be as many
        if len(calls) == 2:
            raise Cancelled
        return amending(*args, **kwargs)

    def traced_again(*args, **kwargs):
        raise AssertionError("guides were traced already")

    monkeypatch.setattr(pipeline, "amend_guides", cut_off_at_the_second)
    with pytest.raises(Cancelled):
        pipeline.reconstruct(scan, tmp_path / "out", settings, until="guides")
    monkeypatch.setattr(pipeline, "trace_guides", traced_again)
    assert pipeline.reconstruct(scan, tmp_path / "out", settings, until="guides") is None
    assert len(calls) == 3 and calls[1] == calls[2] != calls[0]
    whole, resumed = (Strands.load(tmp_path / name / "guides.npz") for name in ("whole", "out"))
    np.testing.assert_array_equal(resumed.points, whole.points)
    assert not (tmp_path / "out" / "checkpoints" / "traced.npz").exists()
