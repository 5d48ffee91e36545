"""`ct2hair groom`, the panel's command-line twin: a job's hair edited, simulated, exported and pictured without a window."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from ct2hair_addon import cli, scene
from ct2hair_addon.groom import add_groom
from ct2hair_addon.head import load_obj
from ct2hair_addon.strand_files import read_strands, write_strands
from ct2hair_addon.strands import Strands


def groom(*arguments) -> int:
    return cli.main(["groom", *map(str, arguments)], [add_groom])


def test_a_result_becomes_what_was_asked_for_and_nothing_else(job_folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        groom(job_folder, "--out", out, "--name", "wig", "--trim", "left=20", "--trim", "40", "--formats", "npz", "blend") == 0
    )
    made = {path.name for path in out.iterdir()}
    assert made == {"wig.npz", "wig.blend", "report.html", "report.json"}
    said = capsys.readouterr().out
    assert "strands cut to 20 mm: left" in said and "all           200" in said and str(out / "wig.blend") in said
    before = Strands.load(job_folder / "hair.npz").lengths()
    lengths = Strands.load(out / "wig.npz").lengths()
    assert len(lengths) == 200 and before.max() > 50.0
    assert lengths.max() == pytest.approx(40.0, abs=0.01)
    assert np.count_nonzero(np.abs(lengths - 20.0) < 0.01) > 20
    bpy.ops.wm.open_mainfile(filepath=str(out / "wig.blend"))
    assert len(scene.active_result().hair.data.curves) == 200


def test_simulated_hair_moves_in_the_file_that_is_written(job_folder, tmp_path):
    out = tmp_path / "out"
    assert groom(job_folder, "--out", out, "--simulate", 5, 9, "--wind-y", 8, "--gravity", 1, "--formats", "blend") == 0
    bpy.ops.wm.open_mainfile(filepath=str(out / "hair.blend"))
    shown = bpy.context.scene
    assert (shown.frame_start, shown.frame_end, shown.frame_current) == (5, 9, 5)
    hair = scene.active_result().hair
    tips = []
    for frame in (5, 9):
        shown.frame_set(frame)
        strands = scene.strands_of(hair, evaluated=True)
        tips.append(strands.points[strands.offsets[1:] - 1])
    assert np.linalg.norm(tips[1] - tips[0], axis=1).mean() > 1.0


def test_strands_of_a_file_are_put_on_their_head(job_folder, tmp_path, dome):
    hair, head = tmp_path / "hair.data", tmp_path / "head.obj"
    strands = Strands.load(job_folder / "hair.npz")
    write_strands(strands, hair)
    mesh = load_obj(job_folder / "head.obj")
    mesh.save(head)
    assert groom(hair, "--head", head, "--out", tmp_path / "out", "--source-unit", "mm", "--formats", "npz") == 0
    back = read_strands(tmp_path / "out" / "hair.npz")
    np.testing.assert_allclose(back.points, strands.points, atol=1e-3)
    assert np.isfinite(back.strand_attributes["root_uv"]).all()


def test_pictures_are_rendered_without_blenders_chatter(job_folder, tmp_path, capfd):
    options = ["--formats", "picture", "--turntable", 2, "--samples", 1, "--size", 32, "--fuller", "--regrow", "crown=4"]
    assert groom(job_folder, "--out", tmp_path, *options) == 0
    for name in ("render.png", "turntable_0000.png", "turntable_0001.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"
    said = capfd.readouterr().out
    assert "Fra:" not in said and "grown anew: crown" in said and "turntable_0001.png" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--colour", "mauve"], "--colour mauve: not known; choose of black"),
        (["--formats", "fbx"], "--formats fbx: not known; choose of blend"),
        (["--trim", "ear=20"], "--trim ear: not known; choose of all, front"),
        (["--regrow", "ear"], "--regrow ear: not known"),
        (["--simulate", "9", "5"], "expected the last frame after the first"),
        (["--turntable", "1"], "--turntable 1: expected 2 or more"),
        (["--stiffness", "7"], "setting 'stiffness' is 7.0, expected 0.0 to 1.0"),
        (["--head", "head.obj"], "has a head of its own"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(job_folder, tmp_path, capsys, arguments, message):
    assert groom(job_folder, "--out", tmp_path / "out", *arguments) == cli.REFUSED
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_no_result_is_said_in_a_line(tmp_path, capsys):
    assert groom(tmp_path / "absent", "--out", tmp_path / "out") == cli.REFUSED
    assert "there is no such folder or file" in capsys.readouterr().err
    assert groom(tmp_path, "--out", tmp_path / "out") == cli.REFUSED
    assert "no report.json" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("wrong", [["--trim", "left=short"], ["--regrow", "left=x"], ["--simulate", "1"]])
def test_wrong_usage_exits_with_two(job_folder, tmp_path, wrong, capsys):
    with pytest.raises(SystemExit) as stop:
        groom(job_folder, "--out", tmp_path, *wrong)
    assert stop.value.code == cli.WRONG_USAGE
