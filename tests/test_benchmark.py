"""The benchmark on tables and plots by hand, what it keeps, and a tiny set from end to end."""

import dataclasses
import json
import os
import xml.etree.ElementTree as xml

import numpy as np
import pytest

from ct2hair_addon import benchmark, cli
from ct2hair_addon.benchmark import Bench, Case, Options, plots, run_benchmark, runner, sets
from ct2hair_addon.benchmark.peers import fullest_cube
from ct2hair_addon.benchmark.sets import _flags, methods
from ct2hair_addon.benchmark.tables import PRINTED, Table, cost_table, head_table, shown, table1
from ct2hair_addon.errors import CT2HairError, ScanError, SettingsError
from ct2hair_addon.evaluation import hairstyle, synthesize
from ct2hair_addon.head import template_head
from ct2hair_addon.pipeline import Silent
from ct2hair_addon.settings import Settings
from ct2hair_addon.volume import BrickVolume


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (8000, "8,000"), (0.12345, "0.123"), (3.14159, "3.14"), (42.42, "42.4"), ("a", "a"),
     (12345.6, "12,346")],
)  # fmt: skip
def test_numbers_are_shown_with_the_digits_that_count(value, text):
    assert shown(value) == text


def test_a_table_is_markdown():
    table = Table("Scores", ("style", "IoU"), [("bob", 0.5), ("curly", None)], "By hand.")
    assert table.markdown().splitlines() == [
        "### Scores", "", "| style | IoU |", "|---|---:|", "| bob | 0.500 |", "| curly | – |", "", "By hand.",
    ]  # fmt: skip


def test_the_printed_table_says_that_optimisation_helps():
    # the text's claim (4.2), and a guard against a slip in copying its 32 numbers
    for without, with_ in PRINTED.values():
        assert all(b > a for a, b in zip(without[:3], with_[:3], strict=True)) and with_[3] < without[3]
    assert sum(iou for _, (iou, *_) in PRINTED.values()) == pytest.approx(0.609 + 0.666 + 0.533 + 0.458)


def test_plots_are_well_formed_and_in_proportion():
    chart = xml.fromstring(plots.bars("IoU <a>", ["bob"], {"ours": [0.5], "paper": [1.0], "none": [None]}))
    bars = [float(r.get("height")) for r in chart.iter("{http://www.w3.org/2000/svg}rect") if float(r.get("width")) > 20]
    assert len(bars) == 2 and bars[1] == pytest.approx(2 * bars[0], rel=1e-2)
    drawn = xml.fromstring(plots.lines("Time", "voxels", "s", {"scan": [(1e5, 1.0), (1e6, 10.0), (1e7, 100.0), (0, 5)]}))
    (line,) = drawn.iter("{http://www.w3.org/2000/svg}polyline")
    points = np.array([[float(n) for n in pair.split(",")] for pair in line.get("points").split()])
    steps = np.diff(points, axis=0)
    np.testing.assert_allclose(steps[0], steps[1], atol=0.2)  # a power law is straight
    assert steps[0, 0] > 0 > steps[0, 1]


class Heard(Silent):
    def __init__(self) -> None:
        self.stages = []

    def started(self, stage, text):
        self.stages.append(stage)


def test_a_process_of_its_own_does_the_same_and_says_how_it_goes(tmp_path):
    scan, head, heard = tmp_path / "scan.vdb", template_head(), Heard()
    synthesize(hairstyle("pixie", head, 600, 3), head, scan, 1.46, snr=4.0, seed=3)
    runner._reconstructed_apart(scan, tmp_path / "apart", Settings(), "scan", heard)
    runner._reconstructed(scan, tmp_path / "here", Settings(), "scan", Silent())
    apart, here = (json.loads((tmp_path / name / "stage.json").read_text()) for name in ("apart", "here"))
    assert heard.stages == ["scan"] and apart["scan"] == here["scan"] and apart["thresholds"] == here["thresholds"]


def test_what_a_process_of_its_own_refuses_is_raised_here(tmp_path):
    with pytest.raises(ScanError, match=r"no\.vdb"):
        runner._reconstructed_apart(tmp_path / "no.vdb", tmp_path / "out", Settings(), None, Silent())


def test_a_process_of_its_own_that_dies_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "_work_apart", os._exit)  # which takes no such arguments: the process ends with its traceback
    with pytest.raises(CT2HairError, match="ended by itself"):
        runner._reconstructed_apart(tmp_path / "no.vdb", tmp_path / "out", Settings(), None, Silent())


def test_the_papers_texels_follow_the_number_of_strands():
    whole = methods(Case("bob", 100_000, 0.1))["paper"].interpolation
    assert (whole.strands, whole.texture, whole.neighbours, whole.nearest, whole.farthest) == (100_000, 2048, 3, 0.6, 6.0)
    part = methods(Case("bob", 6250, 0.4))["paper"].interpolation
    # a sixteenth of the strands on a quarter of the edge: as many texels from root to root
    assert (part.strands, part.texture) == (6250, 512)


def test_what_was_measured_is_kept_until_something_changes(tmp_path, monkeypatch):
    bench, done = Bench(tmp_path), []

    def work():
        done.append(1)
        return {"value": len(done)}

    assert bench.kept("a", {"x": 1}, work) == bench.kept("a", {"x": 1}, work) == {"value": 1}
    assert bench.kept("a", {"x": 2}, work) == {"value": 2}
    monkeypatch.setattr(runner, "sources", lambda: "other code")
    assert bench.kept("a", {"x": 1}, work) == {"value": 3}
    assert not list(tmp_path.rglob("*.part"))


def test_the_fullest_cube_holds_the_most_hair():
    volume = np.zeros((64, 48, 48), np.float32)
    volume[33:63, 17:40, 20:31] = 2.0
    volume[0, 0, 0] = 2.0
    assert fullest_cube(BrickVolume.from_dense(volume, 1.0), 1.0, edge=2).tolist() == [2, 1, 0]


def test_what_a_stage_costs_is_told_for_ten_million_voxels_where_it_was_run_at_all():
    seconds = {"scan": 4.0, "guides": 30.0, "dense": 1.0, "refinement": 9.0}
    stages = [{"name": n, "seconds": s, "peak_memory": 1.0, "resumed": False} for n, s in seconds.items()]
    resumed = [stage | {"resumed": stage["name"] == "dense"} for stage in stages]
    results = {("bob", "ours"): {"hair_voxels": 5_000_000, "stages": stages}}
    results["bob", "paper"] = {"hair_voxels": 5_000_000, "stages": resumed}
    results["pixie", "paper"] = {"hair_voxels": 5_000_000, "stages": stages[:2]}
    ours, paper, guides_alone = cost_table(results).rows
    assert ours[-3:] == ("44 (1.0)", 60.0, 20.0)
    assert paper[-2:] == (60.0, None)
    assert guides_alone[-2:] == (60.0, None)


def test_table1_has_a_cell_for_every_column():
    rest = {"precision": 0.9, "recall": 0.8, "mse": 0.01}
    scored = {"fine": {"iou": 0.5, **rest}, "coarse": {"iou": 0.7, **rest}}
    table = table1({("short", "ours"): {"scores": {"refined": {"voxel": scored}}}}, {"short": "pixie"})
    assert {len(row) for row in table.rows} == {len(table.columns)}
    assert table.rows[-1] == ("short (pixie)", "ours: refined", 0.5, 0.9, 0.8, 1.0, 0.7, 0.9, 0.8)


def test_the_heads_table_has_a_row_for_a_scan_that_was_refused():
    case = {"style": "bun", "mannequin": False, "snr": 2.0, "axes": ["+x", "-z"], "strands": 100}
    found = {
        "case": {**case, "mannequin": True},
        "head": {"face_axis": "+x", "up_axis": "-z", "certainty": 0.9},
        "registration_mm": {"median": 0.25, "p90": 0.5},
        "thresholds": {"air": 1003.0, "noise": 6.0, "strand": 120.0},
        "scan": {"value_of_air": 1000.0, "lone_strand_above_air": 100.0},
        "hair_kept": 0.9,
        "tallies": {"scan": {"knot points": 80}},
    }
    refused, row = head_table([{"case": case, "refused": "no hair was found"}, found]).rows
    assert refused == ("bun", "no", 2.0, "+x -z", "refused", *[None] * 6)
    assert row == ("bun", "yes", 2.0, "+x -z", "+x -z", 0.9, "0.25 / 0.50", 0.5, 1.2, 0.9, 0.8)


def test_table1_takes_hairstyles_that_the_paper_has_no_row_for(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(Bench, "run", lambda bench, case, label, settings, until: asked.append((case.style, label, until)))
    rows = {}
    monkeypatch.setattr(sets, "_comparison", lambda options, names, results: rows.update(names) or sets.Page([], {}, [], []))
    run_benchmark("table1", tmp_path, Options(styles=("pixie", "bob")))
    assert asked == [("pixie", "ours", None), ("pixie", "paper", None), ("bob", "ours", None), ("bob", "paper", None)]
    assert rows == {"short": "pixie", "bob": "bob"}
    asked.clear()
    run_benchmark("styles", tmp_path, Options(styles=("bob",)))
    assert asked == [("bob", "ours", None), ("bob", "paper", "guides")]


def test_a_size_that_is_refused_is_a_note_and_the_larger_ones_are_measured(tmp_path, monkeypatch):
    def run(bench, case, label, settings, until):
        if case.strands < 1000:
            raise ScanError("too few knots")
        done = {"name": "guides", "seconds": 5.0, "peak_memory": 1.0, "resumed": False}
        off = {"median": 5.0, "p90": 12.0}
        guides = {
            "centre_line_mm": {"median": 0.1}, "coverage": 0.8, "direction": {"right": 1.0}, "rooted_length": 1.0,
            "counts": {"result_strands": case.strands},
        }  # fmt: skip
        return {
            "case": dataclasses.asdict(case) | {"fill": case.fill}, "label": label, "hair_voxels": 500 * case.strands,
            "stages": [done], "orientation": off | {"traced": off}, "registration_mm": {"median": 0.1},
            "scores": {"guides": guides},
        }  # fmt: skip

    monkeypatch.setattr(Bench, "run", run)
    page = run_benchmark("scale", tmp_path, Options(largest=1e6)).read_text(encoding="utf-8")
    assert "- pixie, ours, refused: too few knots\n" in page and "scans of 4800, 8000, 16000, 32000, 60000 strands" in page
    rows = [line for line in page.splitlines() if "ours | " in line]
    assert [row.split("|")[1].split()[0] for row in rows] == ["1200", "2400"] * 2
    # of a size too small for all, too, there is a page
    page = run_benchmark("scale", tmp_path, Options(largest=1.5e5)).read_text(encoding="utf-8")
    assert "refused: too few knots" in page and "ours | " not in page


def test_the_commands_defaults_are_the_sets_own(tmp_path, monkeypatch):
    taken = []
    page = tmp_path / "page.md"
    page.write_text("")
    monkeypatch.setattr(benchmark, "run_benchmark", lambda name, out, options, say: taken.append(options) or page)
    assert cli.main(["benchmark", "scale"]) == cli.DONE
    assert dataclasses.replace(taken[0], seeds=tuple(taken[0].seeds), styles=tuple(taken[0].styles)) == Options()


def test_the_page_says_how_to_get_it_again():
    assert _flags(Options(seeds=[101], styles=[])) == ""
    assert _flags(Options(seeds=[3, 4], styles=["bob"], snr=2.0, keep=True, fresh=True)) == (
        " --seeds 3 4 --snr 2.0 --styles bob --keep"
    )


def test_unknown_sets_and_styles_are_refused(tmp_path, capsys):
    with pytest.raises(SettingsError, match="unknown benchmark 'huge'"):
        run_benchmark("huge", tmp_path)
    with pytest.raises(SettingsError, match="unknown hairstyle 'mohawk'"):
        run_benchmark("quick", tmp_path, Options(styles=("mohawk",)))
    assert cli.main(["benchmark", "huge", "--out", str(tmp_path)]) == cli.REFUSED
    assert "quick, table1, styles, heads, ablation, scale, peers" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_heads_of_a_hairstyle_are_found_in_whatever_axes_it_lies_and_a_scan_without_hair_is_a_row(tmp_path, monkeypatch):
    options = Options(styles=("bob",), strands=800, spacing=1.2, snr=10.0)
    values = json.loads(run_benchmark("heads", tmp_path, options).with_suffix(".json").read_text(encoding="utf-8"))
    for result, mannequin in zip(values["results"], (True, False), strict=True):
        assert result["case"]["mannequin"] is mannequin and result["case"]["axes"] != ["-y", "+z"]
        assert [result["head"]["face_axis"], result["head"]["up_axis"]] == result["case"]["axes"]
        assert result["registration_mm"]["median"] < 1.5
    assert not any("wrong way" in note for note in values["notes"]) and not (tmp_path / "runs").exists()

    def refuse(*_, **__):
        raise ScanError("no hair was found")

    monkeypatch.setattr(runner, "reconstruct", refuse)
    page = run_benchmark("heads", tmp_path, dataclasses.replace(options, seeds=[7])).read_text(encoding="utf-8")
    assert page.count("| refused |") == page.count("refused: no hair was found") == 2


@pytest.mark.slow
def test_a_tiny_set_ends_with_its_tables_and_goes_on_from_what_it_has(tmp_path, capsys):
    command = ["benchmark", "quick", "--styles", "bob", "--strands", "500", "--spacing", "1.6", "--out", str(tmp_path)]
    assert cli.main(command) == cli.DONE
    first = capsys.readouterr()
    assert "paper: refined" in first.out and "ours: guides" in first.out
    for name in ("quick.md", "quick.json", "quick-iou.svg", "quick-strands.svg"):
        assert (tmp_path / name).stat().st_size > 500
    values = json.loads((tmp_path / "quick.json").read_text(encoding="utf-8"))
    assert {result["label"] for result in values["results"]} == {"ours", "paper"}
    for result in values["results"]:
        assert 0.0 < result["scores"]["refined"]["voxel"]["coarse"]["iou"] <= 1.0
        assert [stage["name"] for stage in result["stages"]][-1] == "result"
        assert result["picture"]["shows"][0] == "truth" and result["picture"]["shows"][-1] == "refined"
        assert f"]({result['picture']['file']})" in first.out
        assert (tmp_path / result["picture"]["file"]).stat().st_size > 10_000
    assert not (tmp_path / "runs").exists()
    # one result is lost, as if the run had been cut off: only that one is made again, and comes out the same
    (lost,) = (tmp_path / "results").glob("*.ours.*.json")
    before = json.loads(lost.read_text(encoding="utf-8"))
    lost.unlink()
    assert cli.main(command) == cli.DONE
    assert json.loads(lost.read_text(encoding="utf-8"))["scores"] == before["scores"]
    assert ".paper: known" in capsys.readouterr().err
