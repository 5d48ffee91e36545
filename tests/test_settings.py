"""Settings: every field documented, checked, and back from JSON."""

import math

import pytest

from ct2hair_addon.errors import SettingsError
from ct2hair_addon.settings import PRESETS, Settings, parameters


def test_every_parameter_has_help_and_its_default_is_in_range():
    for name, known in parameters():
        assert known.metadata["help"], name
        Settings().changed({name: known.default})


@pytest.mark.parametrize("name", PRESETS)
def test_presets_come_back_from_json(name):
    settings = Settings.preset(name)
    assert Settings.from_json(settings.to_json()) == settings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"guides.stp": 1.0}, "unknown setting 'guides.stp'"),
        ({"guides.step": -1.0}, "expected 0.1 to 4.0 voxel"),
        ({"guides.step": "fast"}, "must be of type float"),
        ({"guides.step": float("nan")}, "must be of type float"),
        ({"head.face": "left"}, "must be one of auto"),
        ({"interpolation.strands": 1.5}, "must be of type int"),
        ({"interpolation.strands": True}, "must be of type int"),
    ],
)
def test_bad_settings_say_what_was_expected(changes, message):
    with pytest.raises(SettingsError, match=message):
        Settings().changed(changes)


def test_whole_numbers_are_taken_for_floats():
    assert Settings().changed({"guides.step": 2}).guides.step == 2.0


def test_malformed_json_is_refused():
    with pytest.raises(SettingsError, match="not valid JSON"):
        Settings.from_json("{")
    with pytest.raises(SettingsError, match="nested"):
        Settings.from_json('{"guides": 3}')


def test_unknown_preset_names_the_known_ones():
    with pytest.raises(SettingsError, match="draft, standard, final, paper"):
        Settings.preset("fast")


def test_the_manual_lists_the_parameters_as_they_are():
    import runpy
    from pathlib import Path

    script = Path(__file__).resolve().parents[1] / "docs" / "settings_table.py"
    page = runpy.run_path(str(script))
    assert page["PAGE"].read_text(encoding="utf-8") == page["table"](), "run `make manual`"


def test_the_paper_preset_gathers_gradients_three_voxels_to_each_side():
    paper = Settings.preset("paper").orientation
    assert paper.sigma == 0.0 and math.ceil(2.0 * paper.rho) == 3
    assert Settings().orientation.sigma > 0.0
