"""The command line: options made from the settings, conversions, clear errors and exit codes."""

import json

import numpy as np
import pytest

from ct2hair_addon import cli
from ct2hair_addon.settings import parameters
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


def test_a_settings_file_is_laid_over_the_preset(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"guides": {"step": 0.5}}))
    assert cli._settings_file(path) == {"guides.step": 0.5}
    path.write_text("[1]")
    with pytest.raises(cli.CT2HairError, match="not a file of settings"):
        cli._settings_file(path)
