"""The command line.

synthesize | inspect | reconstruct | batch | evaluate | benchmark | convert | train-prior | study-blending, and those that
`main` is given, such as `groom`.

Options of `reconstruct` are made from `settings.py`.

Exit codes: 0 done, 1 refused with a clear error (`batch`: one scan or more failed), 2 wrong usage, 130 cancelled.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
import traceback
from argparse import SUPPRESS, BooleanOptionalAction
from collections.abc import Callable, Container, Sequence
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from . import __version__
from .errors import Cancelled, CT2HairError, explained
from .settings import PRESETS, STOPS, Settings, SynthesisSettings, parameters

DONE, REFUSED, WRONG_USAGE, STOPPED = 0, 1, 2, 130
SHORT_NAMES = {
    "scan.spacing": "--spacing",
    "head.mesh": "--head",
    "head.face": "--face",
    "head.up": "--up",
    "interpolation.strands": "--strands",
    "run.seed": "--seed",
    "run.threads": "--threads",
    "run.memory": "--memory",
}
"""Options that are asked for so often that the stage's name is left out."""
_TYPES = {"float": float, "int": int, "str": str}


def main(arguments: Sequence[str], more: Sequence[Callable[..., None]] = ()) -> int:
    """Run one command; returns the exit code. Errors go to standard error as one readable line.

    more: functions that add the commands of whoever stands above this module, by `add_command`.
    """
    parser = _parser(more)
    chosen = parser.parse_args(_with_axes(arguments))
    previous = signal.signal(signal.SIGTERM, _interrupt)
    try:
        return chosen.run(chosen)
    except (Cancelled, KeyboardInterrupt):
        print("ct2hair: cancelled; finished stages are kept", file=sys.stderr)
        return STOPPED
    except Exception as error:
        if (text := explained(error)) is None:
            raise
        print(f"ct2hair: error: {text}", file=sys.stderr)
        return REFUSED
    finally:
        signal.signal(signal.SIGTERM, previous)


def _with_axes(arguments: Sequence[str]) -> list[str]:
    """The arguments with `--face -y` as `--face=-y`, since argparse takes what begins with a dash for an option."""
    out: list[str] = []
    for argument in arguments:
        if argument in ("-x", "-y", "-z") and out and out[-1].startswith("--") and "=" not in out[-1]:
            out[-1] += f"={argument}"
        else:
            out.append(argument)
    return out


def _interrupt(*_) -> None:
    raise KeyboardInterrupt


def _parser(more: Sequence[Callable[..., None]]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="ct2hair", description="Hair strands from a CT scan of a wig.")
    parser.add_argument("--version", action="version", version=f"ct2hair {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in (
        _add_synthesize, _add_inspect, _add_reconstruct, _add_batch, _add_evaluate, _add_benchmark, _add_convert,
        *more, _add_train_prior, _add_study_blending,
    ):  # fmt: skip
        add(commands)
    return parser


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Defaults beside the help, but for those that say nothing."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if action.default in (None, False, []) else super()._get_help_string(action)


def add_command(commands, name: str, run: Callable[[argparse.Namespace], int], help: str) -> argparse.ArgumentParser:
    """A command of the command line: run(options) returns its exit code."""
    parser = commands.add_parser(name, help=help, description=help, formatter_class=_HelpFormatter)
    parser.set_defaults(run=run)
    return parser


def _add_reconstruct(commands) -> None:
    parser = add_command(commands, "reconstruct", _reconstruct, "reconstruct the hair of a scan into a folder")
    parser.add_argument("scan", type=Path, help="the CT volume: .vdb .npy .raw .tif .nii .nrrd .mha, or a folder of slices")
    parser.add_argument("--out", type=Path, required=True, help="folder for hair.npz, guides.npz, head.obj and the report")
    parser.add_argument("--preset", choices=list(PRESETS), default="standard", help="speed against quality")
    parser.add_argument("--settings", type=Path, help="JSON file of settings, over the preset")
    parser.add_argument("--until", choices=STOPS, help="stop after this stage; the same call without it goes on from there")
    _add_raw_options(parser)
    for name, known in parameters():
        option = SHORT_NAMES.get(name, "--" + name.replace(".", "-").replace("_", "-"))
        add_parameter(parser, option, name, known, f"preset's value, {known.default!r} in standard")


def add_parameter(parser, option: str, dest: str, known: Field, default: str = "") -> None:
    """An option for a parameter of `settings.py`; left out, nothing is set. default: what that means, else the parameter's."""
    unit = f" [{known.metadata['unit']}]" if known.metadata["unit"] else ""
    text = f"{known.metadata['help']}{unit} ({default or f'default: {known.default}'})".replace("%", "%%")
    common = {"dest": dest, "default": SUPPRESS, "help": text}
    if known.type == "bool":
        parser.add_argument(option, action=BooleanOptionalAction, **common)
    else:
        choices = known.metadata["choices"] or None
        name = None if choices else option.lstrip("-").split("-")[-1].upper()
        parser.add_argument(option, type=_TYPES[known.type], choices=choices, metavar=name, **common)


def given(chosen: argparse.Namespace, names: Container[str]) -> dict[str, Any]:
    """What was given of the options that `add_parameter` made with these `dest` names."""
    return {name: value for name, value in vars(chosen).items() if name in names}


def _add_inspect(commands) -> None:
    parser = add_command(commands, "inspect", _inspect, "look at a scan: its size, histogram and thresholds")
    parser.add_argument("scan", type=Path, help="the CT volume")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also keep histogram and a small copy as .npz")
    parser.add_argument("--settings", type=Path, help="JSON file of settings")
    parser.add_argument("--spacing", type=float, default=0.0, metavar="MM", help="voxel size; 0 takes it from the file [mm]")
    _add_raw_options(parser)


def _inspect(chosen: argparse.Namespace) -> int:
    from .volume import inspect_scan, open_scan

    settings = Settings().changed(_settings_file(chosen.settings) if chosen.settings else {})
    if chosen.spacing:
        settings = settings.changed({"scan.spacing": chosen.spacing})
    observer = TerminalObserver()
    with open_scan(chosen.scan, settings.scan, chosen.raw_shape, chosen.raw_type) as reader:
        found = inspect_scan(reader, settings.scan, lambda done, total: observer.progressed("scan", 0.0, done / total, None))
    if chosen.out:
        found.save(chosen.out)
    size = " x ".join(f"{n * s / 10:.1f}" for n, s in zip(found.shape, found.spacing, strict=True))
    print(f"{' x '.join(map(str, found.shape))} voxels, {size} cm: {chosen.scan}")
    if found.thresholds is None:
        raise CT2HairError(found.problem)
    for name in ("air", "noise", "strand", "hair", "knots", "solid"):
        print(f"{name:8} {getattr(found.thresholds, name)}")
    print(f"about {found.hair_voxels / 1e6:.1f} million hair voxels")
    return DONE


SCAN_ENDINGS = (".vdb", ".npy", ".raw", ".tif", ".tiff", ".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
"""Files that `batch` takes for scans in a folder; so are folders of DICOM or TIFF slices in it."""


def _add_batch(commands) -> None:
    parser = add_command(commands, "batch", _batch, "reconstruct many scans; one that fails doesn't stop the others")
    parser.add_argument("source", type=Path, help="a folder of scans, or a JSON file: [{scan, name, preset, settings}, ...]")
    parser.add_argument("--out", type=Path, required=True, help="folder; each scan's result goes to a folder of its name in it")
    parser.add_argument("--preset", choices=list(PRESETS), default="standard", help="where the JSON names none")
    parser.add_argument("--settings", type=Path, help="JSON file of settings for all, over the preset")


def _batch(chosen: argparse.Namespace) -> int:
    jobs = _batch_jobs(chosen)
    from . import pipeline  # late: it loads numba and torch

    outcomes = []
    for number, (name, scan, settings) in enumerate(jobs, 1):
        print(f"ct2hair: {number} of {len(jobs)}: {scan}", file=sys.stderr, flush=True)
        begun, out = time.monotonic(), chosen.out / name
        outcome = {"name": name, "scan": str(scan), "out": str(out), "state": "failed", "strands": 0, "error": ""}
        try:
            result = pipeline.reconstruct(scan, out, settings(), observer=TerminalObserver())
            outcome |= {"state": "done", "strands": len(result.hair)}
        except Cancelled:
            raise
        except Exception as error:  # even a fault of ours in one scan is no reason to leave the others undone
            outcome["error"] = explained(error) or f"unforeseen {type(error).__name__}: {error}"
            if explained(error) is None:
                traceback.print_exc()
        outcome["seconds"] = round(time.monotonic() - begun, 1)
        outcomes.append(outcome)
        chosen.out.mkdir(parents=True, exist_ok=True)
        (chosen.out / "batch.json").write_text(json.dumps(outcomes, indent=2), encoding="utf-8")
    failed = [outcome for outcome in outcomes if outcome["state"] == "failed"]
    for outcome in outcomes:
        what = outcome["error"] if outcome in failed else f"{outcome['strands']} strands"
        print(f"{outcome['state']:7}{outcome['seconds']:8.0f} s  {outcome['name']}: {what}")
    print(f"{len(outcomes) - len(failed)} of {len(outcomes)} done: {chosen.out / 'batch.json'}")
    return REFUSED if failed else DONE


def _batch_jobs(chosen: argparse.Namespace) -> list[tuple[str, Path, Callable[[], Settings]]]:
    """(name, scan, its settings when asked for) of each scan; bad settings of one are that one's failure."""
    shared = _settings_file(chosen.settings) if chosen.settings else {}
    if chosen.source.is_dir():
        entries = [{"scan": str(path)} for path in sorted(chosen.source.iterdir()) if _is_scan(path)]
        base = Path()
    else:
        try:
            entries, base = json.loads(chosen.source.read_text(encoding="utf-8")), chosen.source.parent
        except OSError as error:
            raise CT2HairError(f"{chosen.source}: can't be read ({error.strerror}); name a folder or a JSON file") from error
        except ValueError as error:
            raise CT2HairError(f"{chosen.source}: not JSON ({error})") from error
        if not isinstance(entries, list) or not all(isinstance(e, dict) and isinstance(e.get("scan"), str) for e in entries):
            raise CT2HairError(
                f'{chosen.source}: expected a list [{{"scan": FILE, "name": ..., "preset": ..., "settings": ...}}]'
            )
    if not entries:
        raise CT2HairError(f"{chosen.source}: there is no scan; known are {', '.join(SCAN_ENDINGS)} and folders of slices")
    jobs, names = [], set()
    for entry in entries:
        scan = base / entry["scan"]
        name = wanted = str(entry.get("name") or _stem(scan))
        while name in names:
            name = f"{wanted}_{sum(known.startswith(wanted) for known in names)}"
        names.add(name)

        def settings(entry=entry) -> Settings:
            nested = entry.get("settings", {})
            flat = {f"{stage}.{key}": value for stage, group in nested.items() for key, value in group.items()}
            return Settings.preset(entry.get("preset", chosen.preset)).changed({**shared, **flat})

        jobs.append((name, scan, settings))
    return jobs


def _is_scan(path: Path) -> bool:
    if path.is_dir():
        return any(file.suffix.lower() in (".dcm", ".tif", ".tiff") for file in path.iterdir())
    return path.name.lower().endswith(SCAN_ENDINGS)


def _stem(path: Path) -> str:
    ending = next((known for known in sorted(SCAN_ENDINGS, key=len, reverse=True) if path.name.lower().endswith(known)), "")
    return path.name[: len(path.name) - len(ending)] or "scan"


def _add_raw_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--raw-shape", type=_shape, metavar="X,Y,Z", help="voxels of a .raw scan, x fastest")
    parser.add_argument("--raw-type", metavar="TYPE", help="numpy type of a .raw scan, such as <u2 or >i2")


def _shape(text: str) -> tuple[int, int, int]:
    try:
        x, y, z = (int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected three whole numbers such as 512,512,300, got {text!r}") from None
    return x, y, z


def _reconstruct(chosen: argparse.Namespace) -> int:
    settings = Settings.preset(chosen.preset)
    if chosen.settings:
        settings = settings.changed(_settings_file(chosen.settings))
    settings = settings.changed(given(chosen, dict(parameters())))
    from . import pipeline  # late: it loads numba and torch

    result = pipeline.reconstruct(
        chosen.scan,
        chosen.out,
        settings,
        raw_shape=chosen.raw_shape,
        raw_type=chosen.raw_type,
        observer=TerminalObserver(),
        until=chosen.until,
    )
    if result is None:
        print(f"stopped after the stage '{chosen.until}': {chosen.out / 'stage.json'}")
        return DONE
    print(
        f"{len(result.hair)} strands from {len(result.guides)} guides in {result.seconds:.0f} s: {chosen.out / 'hair.npz'}\n"
        f"report: {chosen.out / 'report.html'}"
    )
    return DONE


def _settings_file(path: Path) -> dict[str, Any]:
    """Dotted names and values of a JSON file of settings."""
    try:
        nested = json.loads(path.read_text(encoding="utf-8"))
        return {f"{stage}.{name}": value for stage, group in nested.items() for name, value in group.items()}
    except OSError as error:
        raise CT2HairError(f"{path}: can't be read ({error.strerror})") from error
    except (json.JSONDecodeError, AttributeError) as error:
        raise CT2HairError(f'{path}: not a file of settings, {{"stage": {{"name": value}}}} ({error})') from error


class TerminalObserver:
    """Progress on standard error: one line that is rewritten in a terminal, a line every tenth elsewhere."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._told = -1
        self._last = 0.0

    def started(self, stage: str, text: str) -> None:
        if not self._live:
            print(f"ct2hair: {text}", file=sys.stderr, flush=True)

    def warned(self, text: str) -> None:
        print(f"{self._clear()}ct2hair: warning: {text}", file=sys.stderr, flush=True)

    def progressed(self, stage: str, fraction: float, total: float, remaining: float | None) -> None:
        left = "" if remaining is None else f", {remaining:.0f} s left"
        if self._live:
            if time.monotonic() - self._last > 0.2 or total >= 1.0:
                self._last = time.monotonic()
                end = "\n" if total >= 1.0 else ""
                print(f"{self._clear()}ct2hair: {total:4.0%} {stage}{left}", end=end, file=sys.stderr, flush=True)
        elif int(10 * total) > self._told:
            self._told = int(10 * total)
            print(f"ct2hair: {total:4.0%}{left}", file=sys.stderr, flush=True)

    def _clear(self) -> str:
        return "\r\x1b[K" if self._live else ""


def _add_synthesize(commands) -> None:
    parser = add_command(commands, "synthesize", _synthesize, "make a raw CT scan of a procedural hairstyle or of strands")
    parser.add_argument(
        "hair", metavar="STYLE|STRANDS", help="name of a hairstyle, or a file of strands (.npz .data .bin .hair)"
    )
    parser.add_argument("--spacing", type=float, required=True, metavar="MM", help="voxel size of the scan [mm]")
    parser.add_argument("--out", type=Path, required=True, metavar="SCAN", help="the scan; its ending says the format")
    parser.add_argument(
        "--head", type=Path, metavar="MESH", help="OBJ of the head; without one the template is fitted to the roots"
    )
    parser.add_argument("--strands", type=int, default=8000, metavar="N", help="strands of a hairstyle")
    for known in fields(SynthesisSettings):
        # --strand would be read for --strands
        add_parameter(parser, f"--{_SYNTHESIS.get(known.name, known.name).replace('_', '-')}", known.name, known)
    parser.add_argument(
        "--no-mannequin", dest="mannequin", action="store_const", const="none", default=SUPPRESS, help="as --mannequin none"
    )


_SYNTHESIS = {"strand": "strand_value"}
"""Options of `synthesize` that aren't named as their parameter is."""


def _synthesize(chosen: argparse.Namespace) -> int:
    from .evaluation import STYLES, hairstyle, synthesize
    from .head import load_obj, mark_scalp, template_head
    from .strand_files import read_strands

    settings = SynthesisSettings().changed(given(chosen, [known.name for known in fields(SynthesisSettings)]))
    if chosen.hair in STYLES:
        head = load_obj(chosen.head) if chosen.head else template_head()
        strands = hairstyle(chosen.hair, head, chosen.strands, settings.seed)
    elif Path(chosen.hair).suffix:
        strands = read_strands(chosen.hair)
        head = load_obj(chosen.head, align=False, need_scalp=False) if chosen.head else None
        if head is not None and not len(head.scalp_faces):
            head = mark_scalp(head, strands.roots)
    else:
        raise CT2HairError(f"'{chosen.hair}' is neither a hairstyle ({', '.join(STYLES)}) nor a file of strands")
    made = synthesize(strands, head, chosen.out, chosen.spacing, settings=settings)
    voxels = " x ".join(map(str, made.description["shape"]))
    print(f"{len(strands)} strands, {voxels} voxels of {chosen.spacing} mm: {chosen.out}")
    return DONE


def _add_evaluate(commands) -> None:
    parser = add_command(commands, "evaluate", _evaluate, "score strands against the truth")
    parser.add_argument("truth", type=Path, help="the true strands")
    parser.add_argument("result", type=Path, help="the strands to score, in the same frame")
    parser.add_argument("--head", type=Path, metavar="MESH", help="OBJ of the head, for roots and points inside")
    parser.add_argument(
        "--voxel", type=float, nargs="+", default=[0.5, 1.0], metavar="MM", help="voxel sizes of the voxel scores"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the scores as JSON")


def _evaluate(chosen: argparse.Namespace) -> int:
    from .evaluation import evaluate, format_scores
    from .head import load_obj
    from .strand_files import read_strands

    head = load_obj(chosen.head) if chosen.head else None
    scores = evaluate(read_strands(chosen.truth), read_strands(chosen.result), head, voxels=tuple(chosen.voxel))
    if chosen.json:
        chosen.json.write_text(json.dumps(scores, indent=2), encoding="utf-8")
    print(format_scores(scores))
    return DONE


def _add_benchmark(commands) -> None:
    parser = add_command(commands, "benchmark", _benchmark, "measure our method and the paper's side by side on made scans")
    parser.add_argument("name", metavar="NAME", help="quick (minutes), table1, styles, heads, ablation, scale or peers")
    parser.add_argument("--out", type=Path, default=Path("out/benchmark"), metavar="DIR", help="folder for scans and results")
    parser.add_argument("--seeds", type=int, nargs="+", default=[101], metavar="N", help="seeds of hair and noise")
    parser.add_argument("--strands", type=int, default=0, metavar="N", help="strands of each scan; 0 takes the set's")
    parser.add_argument("--spacing", type=float, default=0.0, metavar="MM", help="voxel size; 0 takes the set's [mm]")
    parser.add_argument("--snr", type=float, default=0.0, metavar="S", help="a strand's peak over the noise; 0 takes the set's")
    parser.add_argument("--styles", nargs="+", default=[], metavar="STYLE", help="hairstyles instead of the set's")
    parser.add_argument("--largest", type=float, default=6e6, metavar="VOXELS", help="scale: active voxels at most")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="processor threads; 0 takes all")
    parser.add_argument("--keep", action="store_true", help="keep the folders of the reconstructions")
    parser.add_argument("--fresh", action="store_true", help="forget results of earlier calls")


def _benchmark(chosen: argparse.Namespace) -> int:
    from .benchmark import Options, run_benchmark

    options = Options(**{known.name: getattr(chosen, known.name) for known in fields(Options)})
    page = run_benchmark(
        chosen.name, chosen.out, options, say=lambda text: print(f"ct2hair: {text}", file=sys.stderr, flush=True)
    )
    print(page.read_text(encoding="utf-8"))
    return DONE


def _add_convert(commands) -> None:
    parser = add_command(commands, "convert", _convert, "turn strands from one file format into another")
    parser.add_argument("source", type=Path, help="strands: .npz .bin .data .hair")
    parser.add_argument("target", type=Path, help="the file to write; its ending says the format")
    parser.add_argument("--points", type=int, metavar="N", help="resample each strand to N points")
    parser.add_argument("--scale", type=float, default=1.0, help="multiply coordinates, 0.001 from mm to m, say")


def _convert(chosen: argparse.Namespace) -> int:
    import numpy as np

    from .strand_files import read_strands, write_strands
    from .strands import Strands

    strands = read_strands(chosen.source)
    if chosen.points:
        if chosen.points < 2:
            raise CT2HairError(f"--points {chosen.points}: a strand needs at least 2 points")
        strands = Strands.from_array(strands.resampled(chosen.points), **strands.strand_attributes)
    if chosen.scale != 1.0:
        strands = strands.with_points(strands.points * np.float32(chosen.scale))
    write_strands(strands, chosen.target)
    print(f"{len(strands)} strands, {len(strands.points)} points: {chosen.target}")
    return DONE


def _add_train_prior(commands) -> None:
    parser = add_command(commands, "train-prior", _train_prior, "train the strand prior's network, or measure its weights")
    parser.add_argument("--out", type=Path, metavar="WEIGHTS", help="where the weights go (.safetensors)")
    parser.add_argument("--folder", type=Path, help="keeps the strands and the training's state; the same call goes on there")
    parser.add_argument("--measure", type=Path, metavar="WEIGHTS", help="only measure these weights on held-out strands")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw held-out strands and their decodings")
    parser.add_argument("--steps", type=int, default=600, metavar="N", help="steps of the optimiser; 0 keeps the linear start")
    parser.add_argument("--batch", type=int, default=256, metavar="N", help="strands a step")
    parser.add_argument("--rate", type=float, default=5e-5, metavar="R", help="Adam's rate for the deeper layers")
    parser.add_argument("--styles", type=int, default=30_000, metavar="N", help="strands of the hairstyles")
    parser.add_argument("--single", type=int, default=30_000, metavar="N", help="procedural single strands")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the strands and of the training")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads of torch; 0 takes all")


def _train_prior(chosen: argparse.Namespace) -> int:
    from . import training
    from .interpolation.train import TrainingPlan

    weights = chosen.measure
    if weights is None:
        if chosen.out is None or chosen.folder is None:
            raise CT2HairError("train-prior needs --out and --folder, or --measure with weights that are there")
        if chosen.batch < 1 or chosen.rate <= 0.0 or min(chosen.steps, chosen.styles, chosen.single) < 0:
            raise CT2HairError("--batch is at least 1, --rate is above 0, --steps, --styles and --single are not negative")
        weights = chosen.out
        plan = TrainingPlan(chosen.steps, chosen.batch, chosen.rate, seed=chosen.seed)
        recipe = training.Recipe(chosen.styles, chosen.single, chosen.seed)
        figures = training.train_prior(
            chosen.out, chosen.folder, recipe, plan, chosen.threads, lambda text: print(f"ct2hair: {text}", file=sys.stderr)
        )
    else:
        figures = training.held_out_figures(weights, chosen.seed)
    print(training.as_table(figures))
    if chosen.picture:
        training.draw_decodings(weights, chosen.picture, chosen.seed)
    return DONE


def _add_study_blending(commands) -> None:
    parser = add_command(
        commands, "study-blending", _study_blending, "hold back strands of hairstyles and blend them by each coder"
    )
    parser.add_argument("styles", nargs="*", metavar="STYLE", help="names of hairstyles; none takes all")
    parser.add_argument("--strands", type=int, default=3000, metavar="N", help="strands of each hairstyle")
    parser.add_argument("--held-back", type=float, default=0.5, metavar="SHARE", help="share of them that is blended anew")
    parser.add_argument("--noise", type=float, default=0.0, metavar="MM", help="error put on the strands that are kept")
    parser.add_argument("--similarity", type=float, metavar="S", help="in place of interpolation.similarity")
    parser.add_argument("--phase", choices=("aligned", "found"), help="in place of interpolation.phase")
    parser.add_argument("--seed", type=int, default=31, metavar="N", help="seed of the hairstyles")


def _study_blending(chosen: argparse.Namespace) -> int:
    from . import blending_study
    from .evaluation import STYLES

    settings = blending_study.settings_for(chosen.similarity, chosen.phase)
    table = blending_study.as_table(
        chosen.styles or STYLES,
        settings,
        strands=chosen.strands,
        held_back=chosen.held_back,
        seed=chosen.seed,
        noise=chosen.noise,
    )
    print(table)
    return DONE
