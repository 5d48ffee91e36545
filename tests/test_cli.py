"""The command line: options made from the settings, conversions, clear errors and exit codes."""

import json
from dataclasses import fields
from unittest.mock import Mock

import numpy as np
import pytest

from ct2hair_addon import cli
from ct2hair_addon.cli import main
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.evaluation import hairstyle
from ct2hair_addon.head import template_head
from ct2hair_addon.settings import Settings, SynthesisSettings, parameters
from ct2hair_addon.strand_files import read_strands, write_strands
from ct2hair_addon.strands import Strands


@pytest.fixture
def strands_file(tmp_path):
    rng = np.random.default_rng(1)
    path = tmp_path / "hair.data"
    write_strands(Strands.from_array(rng.normal(size=(4, 7, 3)).astype(np.float32)), path)
    return path


def test_convert_resamples_and_scales(strands_file, tmp_path, capsys):
    target = tmp_path / "hair.hair"
    assert cli.main(["convert", str(strands_file), str(target), "--points", "5", "--scale", "0.001"]) == cli.DONE
    back = read_strands(target)
    np.testing.assert_array_equal(back.counts, [5] * 4)
    np.testing.assert_allclose(back.roots, read_strands(strands_file).roots * 0.001, rtol=1e-6)
    assert "4 strands, 20 points" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["convert", "absent.data", "b.hair"], "absent.data: there is no such file"),
        (["convert", "a.obj", "b.hair"], "unknown strand format '.obj'"),
        (["evaluate", "absent.npz", "absent.npz"], "absent.npz: there is no such file"),
        (["synthesize", "mohawk", "--spacing", "1", "--out", "a.vdb"], "'mohawk' is neither a hairstyle"),
        (["reconstruct", "a.vdb", "--out", "out", "--spacing", "99"], "expected 0.0 to 10.0 mm"),
        (["reconstruct", "a.vdb", "--out", "out", "--settings", "absent.json"], "absent.json: can't be read"),
    ],
)
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == cli.REFUSED
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments", [[], ["reconstruct"], ["reconstruct", "a.vdb", "--out", "b", "--face", "left"], ["paint"]]
)
def test_wrong_usage_exits_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == cli.WRONG_USAGE and "usage" in capsys.readouterr().err


def test_every_setting_is_an_option_of_reconstruct(capsys):
    with pytest.raises(SystemExit):
        cli.main(["reconstruct", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for name, known in parameters():
        option = cli.SHORT_NAMES.get(name) or "--" + name.replace(".", "-").replace("_", "-")
        assert option in text
        assert known.metadata["help"].split(";")[0].split(",")[0] in text


def test_every_parameter_of_a_made_scan_is_an_option_of_synthesize(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["synthesize", "--help"])
    text = capsys.readouterr().out
    for known in fields(SynthesisSettings):
        name = "strand-value" if known.name == "strand" else known.name.replace("_", "-")
        assert f"--{name} " in text or f"--{name}," in text, name
    assert "(default: None)" not in text
    hair = tmp_path / "hair.npz"
    hairstyle("pixie", template_head(), 300, 1).save(hair)
    options = ["--spacing", "1.5", "--no-mannequin", "--no-net", "--rings", "2", "--strand-value", "200", "--out"]
    assert main(["synthesize", str(hair), *options, str(tmp_path / "scan.nrrd")]) == cli.DONE
    told = json.loads((tmp_path / "scan.json").read_text())["settings"]
    assert (told["rings"], told["strand"], told["mannequin"], told["net"]) == (2.0, 200.0, "none", False)
    few = Strands.load(hair).select(np.arange(20))
    few.save(tmp_path / "few.npz")
    assert main(["synthesize", str(tmp_path / "few.npz"), *options, str(tmp_path / "few.nrrd")]) == cli.REFUSED
    assert "20 strands are too few to fit a head to" in capsys.readouterr().err
    assert main(["synthesize", str(hair), "--spacing", "1", "--snr", "0", "--out", str(tmp_path / "b.nrrd")]) == cli.REFUSED
    assert "setting 'snr' is 0.0, expected 0.1 to 1000.0" in capsys.readouterr().err


def test_a_settings_file_is_laid_over_the_preset(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"guides": {"step": 0.5}}))
    assert cli._settings_file(path) == {"guides.step": 0.5}
    path.write_text("[1]")
    with pytest.raises(cli.CT2HairError, match="not a file of settings"):
        cli._settings_file(path)


@pytest.fixture
def scans(tmp_path, monkeypatch):
    """A folder of three files that pass for scans, and a pipeline that takes all but one of them."""
    from types import SimpleNamespace

    from ct2hair_addon import pipeline

    folder = tmp_path / "scans"
    folder.mkdir()
    for name in ("a.npy", "b.nii.gz", "c.tif", "notes.txt"):
        (folder / name).write_bytes(b"x")
    seen = []

    def reconstruct(scan, out, settings, *, observer):
        seen.append((scan.name, out, settings))
        if scan.name == "b.nii.gz":
            raise CT2HairError("b shows no hair")
        if scan.name == "boom.npy":
            raise ZeroDivisionError("our fault")
        return SimpleNamespace(hair=[0] * 7)

    monkeypatch.setattr(pipeline, "reconstruct", reconstruct)
    return SimpleNamespace(folder=folder, seen=seen)


def test_a_batch_goes_on_after_a_failure_and_sums_up(scans, tmp_path, capsys):
    assert main(["batch", str(scans.folder), "--out", str(tmp_path / "out"), "--preset", "draft"]) == 1
    assert [name for name, *_ in scans.seen] == ["a.npy", "b.nii.gz", "c.tif"]
    assert [out.name for _, out, _ in scans.seen] == ["a", "b", "c"]
    assert all(settings == Settings.preset("draft") for *_, settings in scans.seen)
    told = capsys.readouterr().out
    assert "b: b shows no hair" in told and "2 of 3 done" in told
    summary = json.loads((tmp_path / "out" / "batch.json").read_text(encoding="utf-8"))
    assert [entry["state"] for entry in summary] == ["done", "failed", "done"] and summary[0]["strands"] == 7


def test_a_batch_file_names_scans_presets_and_settings(scans, tmp_path):
    (scans.folder / "boom.npy").write_bytes(b"x")
    entries = [
        {"scan": "a.npy", "name": "first", "preset": "final", "settings": {"guides": {"step": 0.5}}},
        {"scan": "a.npy", "name": "first"},
        {"scan": "boom.npy"},
        {"scan": "c.tif", "settings": {"guides": {"stride": 1}}},
    ]
    path = scans.folder / "jobs.json"
    path.write_text(json.dumps(entries))
    assert main(["batch", str(path), "--out", str(tmp_path / "out")]) == 1
    assert [out.name for _, out, _ in scans.seen] == ["first", "first_1", "boom"]
    assert scans.seen[0][2] == Settings.preset("final").changed({"guides.step": 0.5})
    errors = [entry["error"] for entry in json.loads((tmp_path / "out" / "batch.json").read_text(encoding="utf-8"))]
    assert errors[:2] == ["", ""] and "ZeroDivisionError" in errors[2] and "guides.stride" in errors[3]
    path.write_text(json.dumps(entries[:1]))
    assert main(["batch", str(path), "--out", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize(
    ("text", "message"), [("{", "not JSON"), ('{"scan": "a"}', "expected a list"), ("[]", "there is no scan")]
)
def test_a_batch_of_nothing_is_refused(tmp_path, capsys, text, message):
    (tmp_path / "jobs.json").write_text(text)
    assert main(["batch", str(tmp_path / "jobs.json"), "--out", str(tmp_path / "out")]) == 1
    assert message in capsys.readouterr().err


def test_a_missing_package_and_a_full_disk_are_said_in_a_line(monkeypatch, capsys):
    for error, said in (
        (ModuleNotFoundError("No module named 'SimpleITK'", name="SimpleITK"), "the package 'SimpleITK' is missing"),
        (OSError(28, "No space left on device", "scan.vdb"), "No space left on device: 'scan.vdb'"),
        (MemoryError(), "not enough memory"),
    ):
        monkeypatch.setattr(cli, "_convert", Mock(side_effect=error))
        assert cli.main(["convert", "a.npz", "b.data"]) == cli.REFUSED
        assert said in capsys.readouterr().err
    monkeypatch.setattr(cli, "_convert", Mock(side_effect=KeyError("a fault of ours")))
    with pytest.raises(KeyError):
        cli.main(["convert", "a.npz", "b.data"])


@pytest.mark.parametrize("written", [["--face", "-y", "--up", "+z"], ["--face=-y", "--up=+z"]])
def test_an_axis_may_begin_with_a_dash(written, tmp_path, capsys):
    assert cli.main(["reconstruct", str(tmp_path / "absent.vdb"), "--out", str(tmp_path / "out"), *written]) == cli.REFUSED
    assert "absent.vdb" in capsys.readouterr().err
