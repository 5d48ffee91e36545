"""The named sets: what is run, and the page, numbers and plots that come of it (paper 4, issue "the paper's evaluation")."""

from __future__ import annotations

import dataclasses
import itertools
import json
import platform
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import CT2HairError, SettingsError
from ..evaluation import STYLES
from ..head import orientations
from ..kernels import compiled_ahead
from ..settings import Settings, parameters
from . import peers as peers_
from . import plots
from .runner import Bench, Case, Say, machine, sources
from .tables import Table, cost_table, head_table, shown, stage_table, strand_table, table1, voxel_row

ROWS = {
    "short": ("pixie", "mop_top"),
    "ponytail": ("ponytail", "bangs"),
    "complex": ("wavy",),
    "curly": ("curly",),
}
"""Rows of the paper's Table 1 and the hairstyles that stand for them, the first that there is."""
FULL = (8000, 0.4)
"""Strands and voxel size (mm) of a scan as hard as the paper's (fill 1280), 64 times smaller."""
HALF = (2000, 0.8)
"""As hard, with an eighth of the voxels."""
SMALL = (1500, 0.9)
"""The same difficulty (fill 1215) with a tenth of the voxels."""
SMALLEST = (800, 1.2)
"""The same (fill 1152) in minutes."""
FILL = 1280.0
SIZES = (600, 1200, 2400, 4800, 8000, 16000, 32000, 60000)
"""Strands of the scans of `scale`, at FILL; as many are run as stay under the largest number of voxels. Of fewer strands a scan
is so coarse that its knots run together and place no head."""
SCALED = "pixie"
"""The hairstyle of `scale`: short, so that SIZES are 10^5 to 10^8 active voxels."""
VOXELS_A_STRAND = {SCALED: 650.0}
LONG_STRAND = 3.8e3
"""Active voxels a strand, at 8,000 of them and 0.4 mm, to guess a scan's size before it is made, and those of wavy hair, which
has most; they grow with the root of the strands."""
SNR, SNRS = 4.0, (2.0, 10.0)
"""The scans' signal-to-noise ratio, and those of `heads`."""
PAPER_STRANDS = 100_000


@dataclass(frozen=True)
class Options:
    """What of a set can be changed.

    strands, spacing (mm), snr: of each scan; 0 takes the set's own, as no styles do. largest: active voxels of the largest scan
    of `scale`. keep: keep the runs' folders. fresh: forget results of earlier calls.
    """

    seeds: Sequence[int] = (101,)
    strands: int = 0
    spacing: float = 0.0
    snr: float = 0.0
    styles: Sequence[str] = ()
    largest: float = 6e6
    threads: int = 0
    keep: bool = False
    fresh: bool = False


@dataclass
class Page:
    """What a set gives: tables, pictures (name -> SVG), notes, and its numbers."""

    tables: list[Table]
    pictures: dict[str, str]
    notes: list[str]
    numbers: Any


def run_benchmark(name: str, out: Path, options: Options | None = None, say: Say = lambda text: None) -> Path:
    """Run a named set into the folder `out`; returns its Markdown page, beside which its JSON and SVG files lie.

    What was measured before with the same scan, settings and sources is not measured again. Raises SettingsError for an
    unknown set or style.
    """
    options = options or Options()
    if name not in SETS:
        raise SettingsError(f"unknown benchmark '{name}'; there are {', '.join(SETS)}")
    for style in options.styles:
        if style not in STYLES:
            raise SettingsError(f"unknown hairstyle '{style}'; there are {', '.join(STYLES)}")
    if not options.seeds:
        raise SettingsError("a benchmark needs at least one seed")
    out = Path(out)
    bench = Bench(out, say, options.keep, apart=name in APART)
    if options.fresh:
        for path in (out / "results").glob("*.json"):
            path.unlink()
    begun = time.time()
    with compiled_ahead("synthesize", "reconstruct", "evaluate", "paper"):
        page = SETS[name](bench, options)
    bench.clear_runs()
    return _write(name, out, options, page, time.time() - begun, bench)


def methods(case: Case) -> dict[str, Settings]:
    """Ours and the paper's, for one scan. The paper's number of texels and its texture follow the wig's strands, as 100,000
    and 2048^2 follow a whole head's: on the same texture a wig of 8,000 would be filled with twelve times its hair."""
    share = case.strands / PAPER_STRANDS
    paper = {"interpolation.strands": case.strands, "interpolation.texture": max(round(2048 * share**0.5), 64)}
    return {"ours": Settings.preset("standard"), "paper": Settings.preset("paper").changed(paper)}


def _cases(options: Options, styles: Sequence[str], size: tuple[int, float]) -> list[Case]:
    strands, spacing = options.strands or size[0], options.spacing or size[1]
    return [Case(style, strands, spacing, options.snr or SNR, seed) for seed in options.seeds for style in styles]


def _threaded(settings: Settings, options: Options) -> Settings:
    return settings.changed({"run.threads": options.threads}) if options.threads else settings


def _tried(bench: Bench, case: Case, label: str, settings: Settings, until: str | None) -> dict[str, Any]:
    """`Bench.run`, or what the scan was refused for: a scan that a method can't do is a result as well."""
    try:
        return bench.run(case, label, settings, until)
    except CT2HairError as error:
        return {"case": dataclasses.asdict(case) | {"fill": case.fill}, "label": label, "refused": str(error)}


def _compared(
    bench: Bench,
    options: Options,
    names: dict[str, str],
    size: tuple[int, float],
    with_paper: Callable[[Case], bool] = lambda case: True,
    paper_until: str | None = None,
) -> Page:
    """Ours and, where wanted, the paper's on each style: Table 1, strand scores, the stages' own, and what they cost.

    paper_until: the stage after which the paper's is stopped.
    """
    results: dict[tuple[str, str], dict[str, Any]] = {}
    by_style = {style: row for row, style in names.items()}
    for case in _cases(options, list(names.values()), size):
        for method, settings in methods(case).items():
            row = by_style[case.style]
            key = row if len(options.seeds) == 1 else f"{row}, seed {case.seed}"
            if method != "paper" or with_paper(case):
                until = paper_until if method == "paper" else None
                results[key, method] = _tried(bench, case, method, _threaded(settings, options), until)
        bench.clear_runs()
    return _comparison(options, names, results)


def _comparison(options: Options, names: dict[str, str], results: dict[tuple[str, str], dict[str, Any]]) -> Page:
    """The page of results by (row, method); names: row -> hairstyle."""
    notes = _notes(options, results.values())
    results = {key: result for key, result in results.items() if "refused" not in result}
    shown_names = {row: names[row.split(",")[0]] for row, _ in results}
    groups = list(shown_names)

    def series(stages: Sequence[str], score: Callable[[dict[str, Any]], float]) -> dict[str, list[float | None]]:
        known = {key: result["scores"] for key, result in results.items()}
        return {
            f"{method}, {stage}": [
                score(known[row, method][stage]) if stage in known.get((row, method), {}) else None for row in groups
            ]
            for method in ("paper", "ours")
            for stage in stages
        }

    iou = series(("dense", "refined"), lambda scores: scores["voxel"]["fine"]["iou"])
    f_scores = series(("guides", "refined"), lambda scores: scores["strand"]["1/10"]["f"])
    pictures = {}
    if groups:
        pictures["iou"] = plots.bars("IoU, voxels of 1.25 times the scan's", groups, iou)
        pictures["strands"] = plots.bars("F at 1 mm / 10 degrees", groups, f_scores)
    tables = [table1(results, shown_names), strand_table(results), stage_table(results), cost_table(results)]
    return Page(tables, pictures, notes, list(results.values()))


def quick(bench: Bench, options: Options) -> Page:
    """Ours on two small scans, the paper's, whose optimisation takes longest, on the first: minutes."""
    names = {style: style for style in options.styles or ("bob", "curly")}
    first = next(iter(names))
    return _compared(bench, options, names, SMALLEST, lambda case: case.style == first)


def paper_table(bench: Bench, options: Options) -> Page:
    """The paper's Table 1 on scans as hard as its own."""
    names = {row: next(style for style in styles if style in STYLES) for row, styles in ROWS.items()}
    if options.styles:
        rows = {style: row for row, style in names.items()}
        names = {rows.get(style, style): style for style in options.styles}
    page = _compared(bench, options, names, FULL)
    missing = [f"{row} ({styles[0]} by {names[row]})" for row, styles in ROWS.items() if names.get(row, styles[0]) != styles[0]]
    if missing:
        page.notes.append(f"Hairstyles that aren't there yet are stood in for: {', '.join(missing)}.")
    return page


def every_style(bench: Bench, options: Options) -> Page:
    """All hairstyles by ours, and the paper's guides beside ours: its optimisation of all of them takes a day."""
    return _compared(bench, options, {style: style for style in options.styles or STYLES}, FULL, paper_until="guides")


def heads(bench: Bench, options: Options) -> Page:
    """Thresholds, scalp and the head's place alone: each hairstyle turned another way, with and without a mannequin, in much
    noise and in little."""
    every = orientations()
    turns = itertools.cycle(every[7 * n % len(every)] for n in range(len(every)))
    strands, spacing = options.strands or HALF[0], options.spacing or HALF[1]
    results = []
    for seed in options.seeds:
        for style, mannequin in itertools.product(options.styles or STYLES, (True, False)):
            for snr in (options.snr,) if options.snr else SNRS:
                case = Case(style, strands, spacing, snr, seed, mannequin, next(turns))
                results.append(_tried(bench, case, "head", _threaded(Settings(), options), "head"))
            bench.clear_runs()
    return Page([head_table(results)], {}, _notes(options, results), results)


def ablation(bench: Bench, options: Options) -> Page:
    """The paper's ablations: orientations by gradients and by Gabor filters, blending, optimisation (4.1)."""
    fields = Table(
        "Orientation (paper 4.1.1), and the guides that the paper's own steps make of it",
        ("style", "method", "median off (degrees)", "90 %", "guides", "F 1/10", "F 2/20", "consistency", "covered", "seconds"),
    )
    blends = Table(
        "Interpolation (paper 4.1.2), the guides being the same",
        ("style", "method", "strands", "IoU", "precision", "recall", "MSE (10^-2)", "F 1/10", "F 2/20", "inside the head"),
    )
    fits = Table(
        "Optimisation (paper 4.1.3), the dense strands being the same",
        ("style", "method", "IoU", "precision", "recall", "MSE (10^-2)", "F 1/10", "F 2/20", "seconds"),
    )
    numbers, notes = [], []
    coders = _coders()
    if len(coders) == 1:
        notes.append("The learned prior is not in this version: blends are Euclidean, the paper's way and ours.")
    for case in _cases(options, options.styles or ("wavy", "curly"), SMALL):
        known = methods(case)
        paper, ours = (_threaded(known[name], options) for name in ("paper", "ours"))
        # no refinement is wanted where only what comes before it is looked at
        bare = {"refinement.iterations": 0, "refinement.prune": False}
        own = {f"orientation.{name}": value for name, value in dataclasses.asdict(ours.orientation).items()}
        variants = {
            "raw gradients (paper)": paper.changed(bare),
            "Gabor filters": paper.changed({**bare, "orientation.method": "gabor"}),
            "smoothed gradients (ours)": paper.changed(bare | own),
        }
        for label, settings in variants.items():
            result = bench.run(case, f"orientation, {label}", settings)
            numbers.append(result)
            off, guides = result["orientation"], result["scores"]["guides"]
            f = guides["strand"]
            fields.rows.append(
                (
                    case.style, label, off["median"], off["p90"], guides["counts"]["result_strands"], f["1/10"]["f"],
                    f["2/20"]["f"], guides["consistency"], guides["coverage"], off["seconds"],
                )
            )  # fmt: skip
        interpolation = dataclasses.asdict(paper.interpolation)
        filled = {f"interpolation.{name}": value for name, value in interpolation.items()}
        variants = {}
        for coder, change in coders.items():
            variants[f"{coder}, texels (paper)"] = ours.changed({**bare, **filled, **change})
        for coder, change in coders.items():
            variants[f"{coder}, over the scalp (ours)"] = ours.changed({**bare, **change})
        for label, settings in variants.items():
            result = bench.run(case, f"interpolation, {label}", settings)
            numbers.append(result)
            scores = result["scores"]["dense"]
            blends.rows.append(
                (
                    case.style, label, scores["counts"]["result_strands"], *voxel_row(scores), scores["strand"]["1/10"]["f"],
                    scores["strand"]["2/20"]["f"], scores["inside_head"],
                )
            )  # fmt: skip
        chamfer = {f"refinement.{name}": value for name, value in dataclasses.asdict(paper.refinement).items()}
        variants = {"none": ours.changed(bare), "Chamfer (paper)": ours.changed(chamfer), "volume (ours)": ours}
        for label, settings in variants.items():
            result = bench.run(case, f"optimisation, {label}", settings)
            numbers.append(result)
            scores = result["scores"]["refined"]
            seconds = next(stage["seconds"] for stage in result["stages"] if stage["name"] == "refinement")
            fits.rows.append(
                (
                    case.style, label, *voxel_row(scores), scores["strand"]["1/10"]["f"], scores["strand"]["2/20"]["f"],
                    seconds,
                )
            )  # fmt: skip
        bench.clear_runs()
    return Page([fields, blends, fits], {}, notes + _notes(options, numbers), numbers)


def _coders() -> dict[str, dict[str, str]]:
    """The coders that strands can be blended by: name -> the settings that choose it."""
    known = dict(parameters()).get("interpolation.coder")
    if known is None:
        return {"Euclidean": {}}
    return {choice.capitalize(): {"interpolation.coder": choice} for choice in known.metadata["choices"]}


def scale(bench: Bench, options: Options) -> Page:
    """Time and memory of each stage against active voxels, at one difficulty."""
    results: dict[tuple[str, str], dict[str, Any]] = {}
    style = options.styles[0] if options.styles else SCALED
    left_out, tried = [], []
    for strands in SIZES:
        if VOXELS_A_STRAND.get(style, LONG_STRAND) * strands * (strands / FULL[0]) ** 0.5 > options.largest:
            left_out.append(strands)
            continue
        case = Case(style, strands, round((FILL / strands) ** 0.5, 3), options.snr or SNR, options.seeds[0])
        tried.append(_tried(bench, case, "ours", _threaded(methods(case)["ours"], options), None))
        if "refused" not in tried[-1]:
            results[f"{strands} strands, {case.spacing:g} mm", "ours"] = tried[-1]
        bench.clear_runs()
    names = [stage["name"] for stage in next(iter(results.values()))["stages"]] if results else []

    def series(value: str) -> dict[str, list[tuple[float, float]]]:
        return {
            name: [
                (result["hair_voxels"], stage[value])
                for result in results.values()
                for stage in result["stages"]
                if stage["name"] == name and not stage["resumed"]
            ]
            for name in names
        }

    pictures = {
        "seconds": plots.lines("Seconds of each stage", "active voxels", "seconds", series("seconds")),
        "memory": plots.lines("Peak memory of each stage", "active voxels", "GB", series("peak_memory")),
    }
    notes = _notes(options, tried)
    if left_out:
        counts = ", ".join(map(str, left_out))
        notes.append(f"Left out, larger than --largest {options.largest:g} active voxels: scans of {counts} strands.")
    return Page([cost_table(results), stage_table(results)], pictures, notes, tried)


def peers(bench: Bench, options: Options) -> Page:
    """structure-tensor (PyPI) against our orientation field on the same voxels and threads, by turns in one run."""
    table = Table(
        "Orientation by others",
        ("style", "method", "sigma, rho", "seconds", "million hair voxels / s", "million voxels / s", "time over ours",
         "median off (degrees)", "90 %"),
        note=f"The fullest cube of {peers_.EDGE * 16} voxels an edge, float32; the shortest of {peers_.ROUNDS} rounds; errors "
        "at the same hair voxels. Ours works at hair voxels alone, the other at all.",
    )  # fmt: skip
    notes = []
    if peers_.installed() is None:
        notes.append("structure-tensor isn't installed here, so ours stands alone: pip install structure-tensor and run again.")
    numbers = []
    for case in _cases(options, options.styles or ("wavy", "curly"), FULL):

        def work(case: Case = case) -> dict[str, Any]:
            scan = bench.scan(case)
            bench.say(f"{case.name}: comparing")
            rows = peers_.compare(*peers_.hair_of(scan.path, scan.head, _threaded(Settings(), options)), scan.truth)
            return {"case": dataclasses.asdict(case), "rows": rows, "load": bench.load}

        result = bench.kept(f"{case.name}.peers", {"structure-tensor": peers_.installed()}, work)
        numbers.append(result)
        for row in result["rows"]:
            table.rows.append(
                (
                    case.style, row["name"], ", ".join(shown(value) for value in row["sigma, rho"]), row["seconds"],
                    row["hair voxels a second"] / 1e6, row["voxels a second"] / 1e6, 1.0 / row["times ours"], row["median"],
                    row["p90"],
                )
            )  # fmt: skip
    return Page([table], {}, notes, numbers)


SETS: dict[str, Callable[[Bench, Options], Page]] = {
    "quick": quick,
    "table1": paper_table,
    "styles": every_style,
    "heads": heads,
    "ablation": ablation,
    "scale": scale,
    "peers": peers,
}
"""The sets by name."""

APART = ("scale",)
"""Sets that reconstruct in processes of their own: what was made or compiled before is no part of a stage's memory."""


def _notes(options: Options, results) -> list[str]:
    """What a reader of the numbers has to know."""
    results = list(results)
    notes = [
        f"{result['case']['style']}, {result['label']}, refused: {result['refused']}"
        for result in results
        if "refused" in result
    ]
    found = [(r["case"], [r["head"]["face_axis"], r["head"]["up_axis"]]) for r in results if "head" in r]
    wrong = [case["style"] for case, axes in found if axes != list(case["axes"])]
    if wrong:
        notes.append(f"The head was found facing the wrong way on: {', '.join(sorted(set(wrong)))}.")
    cores = machine()["cores"] or 1
    busy = [result["load"] for result in results if result.get("load") and result["load"] > cores]
    if busy:
        notes.append(
            f"The machine was shared: up to {max(busy):g} processes on {cores} cores. Times are longer than on free cores, and "
            "can be compared only within a run."
        )
    return notes


def _write(name: str, out: Path, options: Options, page: Page, seconds: float, bench: Bench) -> Path:
    """The set's Markdown, JSON and SVG files."""
    facts = machine()
    command = f"python -m ct2hair_addon benchmark {name}{_flags(options)}"
    cases = {(n["case"]["strands"], n["case"]["spacing"], n["case"]["snr"]) for n in page.numbers}
    sizes = "; ".join(f"{n:,} strands at {s:g} mm (fill {n * s * s:.0f}), SNR {r:g}" for n, s, r in sorted(cases))
    lines = [
        f"# Benchmark: {name}",
        "",
        f"`{command}`",
        "",
        f"{facts['cores']} cores, {facts['threads']} threads in use, {facts['memory_gb']} GB; {platform.system()}, "
        f"Python {platform.python_version()}; version {__version__}, sources {sources()}. {sizes}. "
        f"This call took {seconds / 60:.1f} minutes.",
        "",
        *(f"- {note}" for note in page.notes),
        *([""] if page.notes else []),
    ]
    text = "\n".join(lines) + "\n" + "\n".join(table.markdown() for table in page.tables)
    for picture, svg in page.pictures.items():
        path = out / f"{name}-{picture}.svg"
        path.write_text(svg, encoding="utf-8")
        text += f"\n![{picture}]({path.name})\n"
    for result in page.numbers:
        if "picture" in result and (out / result["picture"]["file"]).is_file():
            text += _captioned(result)
    values = {
        "benchmark": name, "command": shlex.split(command), "machine": facts, "version": __version__, "sources": sources(),
        "seconds": seconds, "notes": page.notes, "results": page.numbers,
    }  # fmt: skip
    (out / f"{name}.json").write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    target = out / f"{name}.md"
    target.write_text(text, encoding="utf-8")
    return target


def _captioned(result: dict[str, Any]) -> str:
    """The picture of a result under a line that says what it shows, in Markdown."""
    picture = result["picture"]
    title = f"{result['case']['style']}, {result['label']}: {', '.join(picture['shows'])}"
    return f"\n{title}, from left to right; below a part of each, larger\n\n![{title}]({picture['file']})\n"


def _flags(options: Options) -> str:
    """The options that differ from their defaults, as on the command line."""
    usual, flags = Options(), ""
    for known in dataclasses.fields(Options):
        value = getattr(options, known.name)
        values = list(value) if isinstance(value, (list, tuple)) else [] if value is True else [value]
        if known.name == "fresh" or value == getattr(usual, known.name) or tuple(values) == getattr(usual, known.name):
            continue
        flags += f" --{known.name} {' '.join(map(str, values))}".rstrip()
    return flags
