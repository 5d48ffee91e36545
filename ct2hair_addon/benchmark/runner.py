"""One scan, one method: made, reconstructed, scored stage by stage, and kept, so that a run that was cut off goes on.

A result is kept under a key of the scan, the settings and the engine's own sources: where any of them changes, it is made anew.
"""

from __future__ import annotations

import functools
import hashlib
import json
import multiprocessing
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numba
import numpy as np

from ..errors import CT2HairError
from ..evaluation import (
    centre_line_error,
    coverage,
    direction_share,
    evaluate,
    hair_kept,
    hairstyle,
    orientation_error,
    registration_error,
    rooted_length,
    strip_picture,
    synthesize,
)
from ..head import Head, HeadMesh, axis_rotation, load_obj, remove_hairnet, template_head
from ..measure import Meter, machine_memory
from ..orientation import field_along, orientation_field
from ..pipeline import Observer, Silent, reconstruct
from ..settings import Settings
from ..strands import Strands
from ..volume import BrickVolume, load_vdb

VOXELS = (1.25, 2.5)
"""Voxels of the voxel scores in units of the scan's (EVALUATION.md)."""
COVERED = 2.5
"""A hair voxel is covered by a guide within this many voxels of the scan: 1 mm at 0.4 mm."""
ORIENTED = 200_000
"""Hair voxels at most that the orientation error is taken at."""
DENSE = "dense.npz"
"""Beside the files of a result: the strands before their refinement."""

UPRIGHT = ("-y", "+z")
"""Where the project's own heads look, and where their crown is."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Case:
    """A scan to be made: hairstyle, strands, voxel size (mm), signal-to-noise ratio, seed of hair and noise, whether there is
    a mannequin, and the scan's axes that the face looks along and the crown points to."""

    style: str
    strands: int
    spacing: float
    snr: float = 4.0
    seed: int = 101
    mannequin: bool = True
    axes: tuple[str, str] = UPRIGHT

    @property
    def name(self) -> str:
        more = ("" if self.mannequin else "-bare") + ("" if self.axes == UPRIGHT else f"-face{self.axes[0]}-up{self.axes[1]}")
        return f"{self.style}-{self.strands}-{self.spacing:g}mm-snr{self.snr:g}-seed{self.seed}{more}"

    @property
    def fill(self) -> float:
        """Strands times a voxel's face, mm^2: how hard the scan is (EVALUATION.md)."""
        return self.strands * self.spacing**2


@dataclass(frozen=True)
class Scan:
    """A scan on disk with what is true in it, all in its frame, and how it was made (`Synthesis.description`)."""

    path: Path
    truth: Strands
    head: HeadMesh
    made: dict[str, Any]


class Bench:
    """A folder of scans, runs and results. say: told, line by line, what is being done. apart: each reconstruction in a process
    of its own, so that its memory is that of a user's."""

    def __init__(self, folder: Path, say: Say = lambda text: None, keep: bool = False, apart: bool = False) -> None:
        self.folder, self.say, self._keep, self._apart = Path(folder), say, keep, apart
        self.load = _load()

    def scan(self, case: Case) -> Scan:
        """The case's scan, made where it isn't there yet."""
        path = self.folder / "scans" / f"{case.name}.vdb"
        done = path.with_suffix(".json")
        if not done.is_file() or json.loads(done.read_text(encoding="utf-8")).get("sources") != sources():
            self.say(f"{case.name}: making the scan")
            path.parent.mkdir(parents=True, exist_ok=True)
            head = template_head()
            meter = Meter()
            turn = np.eye(4)
            turn[:3, :3] = axis_rotation(*case.axes)
            strands = hairstyle(case.style, head, case.strands, case.seed).transformed(turn)
            made = synthesize(
                strands, head.transformed(turn), path, case.spacing, snr=case.snr, seed=case.seed, mannequin=case.mannequin
            )
            cost = {"seconds": meter.seconds, "peak_memory": meter.peak_memory}
            _write_json(done, made.description | {"sources": sources(), "cost": cost})
        beside = path.with_suffix("")
        truth = Strands.load(beside.with_name(f"{beside.name}.strands.npz"))
        head = load_obj(beside.with_name(f"{beside.name}.head.obj"), align=False)
        return Scan(path, truth, head, json.loads(done.read_text(encoding="utf-8")))

    def run(self, case: Case, label: str, settings: Settings, until: str | None = None) -> dict[str, Any]:
        """Everything measured of one method on one scan, as plain values: see `_measured`. until: as in `reconstruct`."""
        depends = {"settings": settings.to_dict(), "until": until, "apart": self._apart}
        return self.kept(f"{case.name}.{label}", depends, lambda: self._measured(case, label, settings, until))

    def kept(self, name: str, depends: dict[str, Any], work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """A result from its file, or by `work`; `depends` and the engine's sources are its key."""
        key = _digest({"name": name, "threads": numba.get_num_threads(), "sources": sources(), **depends})
        path = self.folder / "results" / f"{name}.{key[:12]}.json"
        if path.is_file():
            self.say(f"{name}: known")
            return json.loads(path.read_text(encoding="utf-8"))
        result = work()
        _write_json(path, result)
        return json.loads(path.read_text(encoding="utf-8"))

    def density(self, folder: Path, head: Head, settings: Settings) -> BrickVolume:
        """The wig's density of a run, the net taken out as in the run itself."""
        return remove_hairnet(load_vdb(folder / "volume.vdb"), head, settings.head)[0]

    def _measured(self, case: Case, label: str, settings: Settings, until: str | None) -> dict[str, Any]:
        scan = self.scan(case)
        # stages that two methods share are done once: the folder is that of what comes before the guides' scores
        upstream = {stage: settings.to_dict()[stage] for stage in ("scan", "head", "orientation", "guides", "run")}
        folder = self.folder / "runs" / f"{case.name}.{_digest({'sources': sources(), **upstream})[:12]}"
        self.say(f"{case.name}: reconstructing, {label}")
        told = _Told(self.say, f"{case.name}, {label}")
        (_reconstructed_apart if self._apart else _reconstructed)(scan.path, folder, settings, until, told)
        self.say(f"{case.name}: scoring, {label}")
        report = json.loads((folder / ("stage.json" if until else "report.json")).read_text(encoding="utf-8"))
        found = load_obj(folder / "head.obj", align=False)
        files = {} if until == "head" else {"guides": "guides.npz"}
        if not until:
            files |= {"dense": DENSE, "refined": "hair.npz"}
        stages = {stage: Strands.load(folder / file) for stage, file in files.items()}
        head = Head(found)
        density, level = self.density(folder, head, settings), report["scan"]["hair_level"]
        result = {
            "case": asdict(case) | {"fill": case.fill},
            "label": label,
            "settings": settings.to_dict(),
            "hair_voxels": report["scan"]["hair_voxels"],
            "hair_kept": hair_kept(scan.truth, density),
            "thresholds": report["thresholds"],
            "scores": self._scores(case, scan.truth, stages, head),
            "scan": {name: scan.made[name] for name in ("value_of_air", "lone_strand_above_air")},
            "registration_mm": registration_error(found, scan.head),
            "head": {name: report["head"][name] for name in ("face_axis", "up_axis", "certainty", "residual_mm")},
            "stages": [{name: value for name, value in stage.items() if name != "tally"} for stage in report["stages"]],
            "tallies": {stage["name"]: stage["tally"] for stage in report["stages"]},
            "load": self.load,
        }
        if not until:
            file = f"pictures/{case.name}.{_plain_name(label)}.jpg"
            shows = _draw(self.folder / file, {"truth": scan.truth, **stages}, np.array(report["head"]["head_to_scan"]), found)
            result["picture"] = {"file": file, "shows": shows}
        if "guides" in stages:
            result["scores"]["guides"]["coverage"] = coverage(stages["guides"], density, level, COVERED * case.spacing)
            result["orientation"] = orientation_scores(density, level, settings, scan.truth, stages["guides"])
        return result

    def _scores(self, case: Case, truth: Strands, stages: dict[str, Strands], head: Head) -> dict[str, dict[str, Any]]:
        """The strands' own scores, stage by stage."""
        voxels = tuple(scale * case.spacing for scale in VOXELS)
        scores = {}
        for stage, strands in stages.items():
            # where there is nothing to fill, dense strands are the guides
            same = next((scores[known] for known in scores if _same(stages[known], strands)), None)
            scores[stage] = dict(same) if same else evaluate(truth, strands, head, voxels)
        for stage, table in scores.items():
            # whatever the voxel, the first is the finer one
            table["voxel"] = dict(zip(("fine", "coarse"), table["voxel"].values(), strict=True))
            if stage != "dense":
                table["direction"] = direction_share(stages[stage], truth)
                table["rooted_length"] = rooted_length(stages[stage], head)
        if "guides" in scores:
            scores["guides"]["centre_line_mm"] = centre_line_error(stages["guides"], truth)
        return scores

    def clear_runs(self) -> None:
        """Delete the runs' folders, gigabytes of checkpoints, unless they are to be kept."""
        if not self._keep:
            shutil.rmtree(self.folder / "runs", ignore_errors=True)


def _same(one: Strands, other: Strands) -> bool:
    """Whether two strand sets have the same points."""
    return np.array_equal(one.offsets, other.offsets) and np.array_equal(one.points, other.points)


def orientation_scores(
    density: BrickVolume, level: float, settings: Settings, truth: Strands, guides: Strands
) -> dict[str, Any]:
    """Error of the orientation field at hair voxels (degrees), and with the guides' directions in it (`traced`); seconds, and
    hair voxels a second, of the former."""
    meter = Meter()
    field = orientation_field(density, level, settings.orientation)
    cost = {"seconds": meter.seconds, "hair_voxels": field.tally["hair voxels"], "peak_memory": meter.peak_memory}
    off, traced = (orientation_error(*some.voxels(ORIENTED)[:2], truth) for some in (field, field_along(field, guides)))
    return {**off, "traced": traced, **cost}


def machine() -> dict[str, Any]:
    """The machine that it runs on: cores, threads in use, memory."""
    return {"cores": os.cpu_count(), "threads": numba.get_num_threads(), "memory_gb": round(machine_memory(), 1)}


@functools.cache
def sources() -> str:
    """A digest of the engine's sources, what only shows results left out: other code may give other results."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        place = path.relative_to(root)
        shows = place.parts[0] == "benchmark" and place.name not in ("runner.py", "peers.py")
        if not shows and place.parts[0] not in ("scene", "jobs", "cli.py", "batch.py", "__main__.py"):
            digest.update(place.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


class _Told(Silent):
    """Tells which stage a reconstruction is in."""

    def __init__(self, say: Say, name: str) -> None:
        self._say, self._name = say, name

    def started(self, stage: str, text: str) -> None:
        self._say(f"{self._name}: {text}")


class _Sent(Silent):
    """Sends on which stage a reconstruction is in."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def started(self, stage: str, text: str) -> None:
        self._pipe.send((stage, text))


def _reconstructed(scan: Path, folder: Path, settings: Settings, until: str | None, observer: Observer) -> None:
    """`reconstruct`, with the dense strands beside its files."""
    made = reconstruct(scan, folder, settings, observer=observer, until=until)
    if made:
        made.dense.save(folder / DENSE)


def _reconstructed_apart(scan: Path, folder: Path, settings: Settings, until: str | None, observer: Observer) -> None:
    """The same in a process of its own, whose errors are raised here."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work_apart, args=(theirs, scan, folder, settings, until), daemon=True)
    process.start()
    theirs.close()
    try:
        while (told := ours.recv()) is not None:
            if isinstance(told, Exception):
                raise told
            observer.started(*told)
        process.join()
    except EOFError:
        process.join()
        raise CT2HairError(f"{scan}: the process that reconstructed it ended by itself ({process.exitcode})") from None
    finally:
        process.terminate()


def _work_apart(pipe: Connection, scan: Path, folder: Path, settings: Settings, until: str | None) -> None:
    try:
        _reconstructed(scan, folder, settings, until, _Sent(pipe))
        pipe.send(None)
    except Exception as error:  # handed on: whoever waits at the pipe raises it
        pipe.send(error)


def _load() -> float | None:
    """Processes that ran or waited for a core in the last minute: above the cores, times are longer than they need be."""
    try:
        return round(os.getloadavg()[0], 1)
    except (AttributeError, OSError):  # Windows
        return None


def _draw(path: Path, sets: dict[str, Strands], head_to_scan: np.ndarray, head: HeadMesh) -> list[str]:
    """Write a picture of sets of strands side by side; returns which it shows. One that is the same as the one before is left
    out: where there is nothing to fill, dense strands are the guides."""
    from PIL import Image  # late: only pictures need it

    names, last = [], None
    for name, strands in sets.items():
        if last is None or not np.array_equal(strands.points, last.points):
            names.append(name)
        last = strands
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(strip_picture([sets[name] for name in names], head_to_scan, head)).save(path, quality=88)
    return names


def _plain_name(label: str) -> str:
    """A label as part of a file's name that needs no quotes."""
    return re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-")


def _digest(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _write_json(path: Path, values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.part")
    beside.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    beside.replace(path)
