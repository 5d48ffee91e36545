"""The stages in order, from a scan to hair: checkpoints, resume, progress with remaining time, and the result's folder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, Protocol, TypeVar

import numba
import numpy as np

from . import __version__
from .checkpoints import Checkpoints, chained_key, fingerprint
from .errors import CT2HairError
from .evaluation import write_report
from .guides import Guides, Habit, amend_guides, strands_by_knots, trace_guides
from .head import Head, HeadMesh, Registration, load_obj, register_head, remove_hairnet, template_head
from .interpolation import Dense, estimate_strand_count, fill_scalp
from .kernels import compiled_ahead
from .measure import Meter, allowed_memory, machine_memory, needed_memory, release_memory
from .orientation import OrientationField, field_along, orientation_field
from .progress import Progress, part
from .refinement import Refined, check_device, refine, unexplained, without_surplus
from .settings import STOPS, RefinementSettings, Settings
from .strands import Strands
from .volume import BrickVolume, Thresholds, WigScan, find_thresholds, import_scan, open_scan, save_vdb
from .volume.strand_signal import StrandProfile, lone_profile

STAGES = ("scan", "head", "orientation", "guides", "dense", "refinement", "result")
SHARES = dict(zip(STAGES, (0.09, 0.08, 0.04, 0.54, 0.04, 0.18, 0.03), strict=True))
"""Each stage's usual share of the time, for the total progress."""
TEXTS = {
    "scan": "reading the scan",
    "head": "finding the head",
    "orientation": "estimating orientations",
    "guides": "tracing guide strands",
    "dense": "filling the scalp",
    "refinement": "fitting strands to the scan",
    "result": "writing the result",
}
AMENDED_BY = RefinementSettings(iterations=10)
"""How guides are fitted to be amended, whatever is wanted of the refinement: guides then depend on their own settings alone."""
TRACED, AMENDING = "traced", 0.7
"""The checkpoint within the guides' stage, and how long one amendment takes, tracing taking 1."""

_TYPES = (
    BrickVolume, Dense, Guides, Habit, HeadMesh, OrientationField, Refined, Registration, StrandProfile, Strands, Thresholds,
    WigScan,
)  # fmt: skip
"""What checkpoints are made of."""

Value = TypeVar("Value")
"""A stage's result: whatever it is, its `tally` says in numbers what became of what."""


class Observer(Protocol):
    """Whoever wants to know how it goes. `progressed` may raise `Cancelled` to stop the work."""

    def started(self, stage: str, text: str) -> None: ...

    def warned(self, text: str) -> None: ...

    def progressed(self, stage: str, fraction: float, total: float, remaining: float | None) -> None: ...


class Silent:
    """The observer that looks away."""

    def started(self, stage: str, text: str) -> None:
        pass

    def warned(self, text: str) -> None:
        pass

    def progressed(self, stage: str, fraction: float, total: float, remaining: float | None) -> None:
        pass


@dataclass(frozen=True)
class Reconstruction:
    """What `reconstruct` made: all in the scan frame, mm.

    dense: the strands before the refinement. head_to_scan: 4 x 4, the head frame's place in the scan (rigid, with the
    template's scale). report: as in report.json.
    """

    hair: Strands
    dense: Strands
    guides: Strands
    head: HeadMesh
    head_to_scan: np.ndarray
    report: dict[str, Any]
    seconds: float


def reconstruct(
    scan: str | os.PathLike,
    out: str | os.PathLike,
    settings: Settings | None = None,
    *,
    raw_shape: Sequence[int] | None = None,
    raw_type: str | None = None,
    template: HeadMesh | None = None,
    observer: Observer | None = None,
    until: str | None = None,
) -> Reconstruction | None:
    """Reconstruct the hair of a scan into the folder `out`.

    Writes hair.npz, guides.npz (`Strands`, mm, scan frame), head.obj, volume.vdb (the wig's density), report.json and
    report.html, each whole or not at all; with `settings.run.orientation` orientation.vdb, too. Finished stages are kept in
    `out/checkpoints`: the same call goes on after the last one whose input and settings are unchanged.

    raw_shape (x, y, z) and raw_type (a numpy type, "<u2" say) describe a raw file. template: a head mesh in the head frame
    instead of `settings.head.mesh`. until: one of `STOPS`: stop after that stage, write what there is by then (volume.vdb,
    head.obj, orientation.vdb with lines to look at in orientation.npz, guides.npz, dense.npz) with stage.json, and return
    None. Raises CT2HairError (bad input, said in a sentence) and Cancelled (by the observer).
    """
    settings = settings or Settings()
    if until is not None and until not in STOPS:
        raise CT2HairError(f"unknown stage '{until}' to stop after; there are {', '.join(STOPS)}")
    check_device(settings.run.device)
    job = _Job(Path(scan), Path(out), settings, raw_shape, raw_type, template, observer or Silent(), until)
    kernels = "paper" if settings.guides.method == "paper" else "reconstruct"
    with _own_folder(job.out), _threads(settings.run.threads), compiled_ahead(kernels):
        return job.run()


class _Job:
    """One run through the stages: the input, the keys of the checkpoints, and what each stage cost."""

    def __init__(self, scan, out, settings, raw_shape, raw_type, template, observer, until=None) -> None:
        self.scan: Path = scan
        self.out: Path = out
        self.settings: Settings = settings
        self.raw = {"shape": raw_shape and [int(n) for n in raw_shape], "dtype": raw_type}
        self.observer: Observer = observer
        self.until: str | None = until
        self.template = template or self._template()
        self.checkpoints = Checkpoints(out / "checkpoints", _TYPES)
        self.keys = self._keys()
        self.costs: list[dict[str, Any]] = []
        self.warnings: list[str] = []
        self.begun = time.monotonic()
        self.resumed_share = 0.0

    def run(self) -> Reconstruction | None:
        settings, seed = self.settings, self.settings.run.seed
        wig = self._stage("scan", self._import)
        self._warn(wig.warnings)
        self._check_memory(wig.density)
        level = wig.hair_level
        if self.until == "scan":
            return self._stop(wig)
        registration = self._stage(
            "head",
            lambda progress: register_head(
                self.template, wig.knots, wig.solid_points, wig.density, level, settings.head, progress=progress
            ),
        )
        self._warn(registration.warnings)
        head = Head(registration.head)
        density, net_tally = remove_hairnet(wig.density, head, settings.head)
        self.costs[-1]["tally"] |= net_tally
        wig = dataclasses.replace(wig, density=density)  # the net's voxels are needed no more
        if self.until == "head":
            return self._stop(wig, registration)
        if self.until == "orientation":
            field = self._stage("orientation", lambda progress: self._orientation(density, level, progress))
            field.save(self.out / "orientation.vdb")
            return self._stop(wig, registration, orientation=field.lines())
        lone = wig.thresholds.strand
        guides = self._guides(wig, density, head)
        if self.until == "guides":
            return self._stop(wig, registration, guides=guides.strands)

        def fill(progress: Progress) -> Dense:
            count = settings.interpolation.strands
            if not count and settings.interpolation.method == "scalp":
                # every guide was traced in the scan: the estimate says how many more there are
                count = max(estimate_strand_count(density, level, guides.strands, head, peak=lone), len(guides.strands))
            return fill_scalp(guides.strands, head, count, settings.interpolation, seed, progress=progress)

        dense = self._stage("dense", fill)
        if self.until == "dense":
            return self._stop(wig, registration, guides=guides.strands, dense=dense.strands)
        # who asks for a number of strands gets that number
        wanted = dataclasses.replace(
            settings.refinement, prune=settings.refinement.prune and not settings.interpolation.strands
        )

        def fit(progress: Progress) -> Refined:
            trusted = settings.guides.knots and wig.counted
            known, _ = strands_by_knots(wig.knots if trusted else None, head, density.spacing)
            device = settings.run.device
            return refine(dense.strands, density, level, head, wanted, seed, progress, device=device, peak=lone, fewest=known)

        refined = self._stage("refinement", fit)
        return self._write(wig, registration, head, guides.strands, dense.strands, refined)

    def _stop(self, wig: WigScan, registration: Registration | None = None, **strands: Strands) -> None:
        """Write what there is after the stage that the run was to stop at, stage.json last."""
        if registration is not None:
            registration.head.save(self.out / "head.obj")
        for name, some in strands.items():
            some.save(self.out / f"{name}.npz")
        known = {"until": self.until, **self._facts(wig, registration)}
        beside = self.out / ".stage.part.json"
        beside.write_text(json.dumps(known, indent=2), encoding="utf-8")
        beside.replace(self.out / "stage.json")

    def _facts(self, wig: WigScan, registration: Registration | None) -> dict[str, Any]:
        """What report.json and stage.json say of the program, the scan, the head and the stages until now."""
        return {
            "program": {"name": "CT2Hair for Blender", "version": __version__, "python": platform.python_version()},
            "machine": {"cores": os.cpu_count(), "threads": numba.get_num_threads(), "memory_gb": machine_memory()},
            "scan": {
                "file": self.scan.name,
                "spacing_mm": wig.density.spacing,
                "hair_voxels": int(wig.density.count_above(wig.hair_level).sum()),
                "stored_voxels": int(wig.density.bricks.size),
                "hair_level": wig.hair_level,
            },
            "thresholds": dataclasses.asdict(wig.thresholds),
            "head": {}
            if registration is None
            else {
                "face_axis": registration.face_axis,
                "up_axis": registration.up_axis,
                "certainty": registration.certainty,
                "residual_mm": registration.residual_mm,
                "head_to_scan": np.asarray(registration.matrix, float).tolist(),
            },
            "settings": self.settings.to_dict(),
            "stages": self.costs,
            "warnings": self.warnings,
        }

    def _import(self, progress: Progress) -> WigScan:
        reader = open_scan(self.scan, self.settings.scan, **self.raw)
        thresholds = find_thresholds(reader, self.settings.scan, progress=part(progress, 0.0, 0.3))
        wig = import_scan(reader, thresholds, self.settings.scan, progress=part(progress, 0.3, 0.95))
        self.out.mkdir(parents=True, exist_ok=True)
        save_vdb(wig.density, self.out / "volume.vdb")
        return wig

    def _orientation(self, density: BrickVolume, level: float, progress: Progress) -> OrientationField:
        return orientation_field(density, level, self.settings.orientation, progress=progress)

    def _guides(self, wig: WigScan, density: BrickVolume, head: Head) -> Guides:
        """The guides in `density`, the wig's without its net; the orientation field, large and quickly made again, is computed
        and kept only until they are there."""
        guides = self.checkpoints.load("guides", self.keys["guides"])
        if guides is None:
            # in a list, to be handed over and held no longer: it is of the guides' peak of memory
            fields = [self._stage("orientation", lambda progress: self._orientation(density, wig.hair_level, progress))]
        guides = self._stage("guides", lambda progress: self._guides_amended(wig, density, head, fields, progress), guides)
        self.checkpoints.drop("orientation")
        self.checkpoints.drop(TRACED)
        if not len(guides.strands):
            dropped = "; ".join(f"{reason}: {count}" for reason, count in guides.tally.items())
            raise CT2HairError(
                f"{self.scan}: no guide strand could be traced ({dropped}). Check scan.hair and the head's place, "
                "or lower orientation.confidence"
            )
        return guides

    def _guides_amended(self, wig, density, head, fields, progress: Progress) -> Guides:
        """Traced guides, amended as often as the settings want it; what there is before each amendment is kept until all are
        done."""
        settings, seed, level, lone = self.settings, self.settings.run.seed, wig.hair_level, wig.thresholds.strand
        rounds = settings.guides.amend if settings.guides.method == "trace" else 0
        share = 1.0 / (1.0 + AMENDING * rounds)
        keys = [chained_key(self.keys["guides"], amended=number) for number in range(rounds)]
        done, guides = rounds, None
        while done and guides is None:
            done -= 1
            guides = self.checkpoints.load(TRACED, keys[done])
        if guides is None:
            step = part(progress, 0.0, share)
            guides = trace_guides(
                density, level, fields.pop(), head, settings.guides, seed, step, wig.knots, lone, counted=wig.counted
            )
            if rounds:
                self.checkpoints.save(TRACED, keys[0], guides)
        fields.clear()
        held = [guides]  # so is each lot of guides
        del guides
        for number in range(done, rounds if len(held[0].strands) else 0):
            step = part(part(progress, share, 1.0), number / rounds, (number + 1) / rounds)
            held.append(self._amended(held, number + 1, wig, density, head, step))
            if number + 1 < rounds:
                self.checkpoints.save(TRACED, keys[number + 1], held[0])
        return held.pop()

    def _amended(self, held: list[Guides], number: int, wig, density, head, progress: Progress) -> Guides:
        """The guides, taken out of `held`, fitted to the scan; what they have too many cut out, what they lack traced anew."""
        settings, seed, level, lone = self.settings, self.settings.run.seed, wig.hair_level, wig.thresholds.strand
        guides = held.pop()
        traced = guides.strands.with_attributes(guide=np.ones(len(guides.strands), bool))
        profile = lone_profile(density, level, traced, lone, part(progress, 0.0, 0.05))
        device, step = settings.run.device, part(progress, 0.05, 0.6)
        fitted = refine(traced, density, level, head, AMENDED_BY, seed, step, profile, device, lone, final=False)
        if not len(fitted.strands):
            return guides
        usual, known, habit = guides.profile, guides.tally, guides.habit
        del guides, traced
        pieces, cut = without_surplus(fitted.strands, density, level, head, profile, part(progress, 0.6, 0.65))
        counts = fitted.tally | cut
        del fitted
        # in a list, to be handed over and held no longer
        fields = [self.checkpoints.load("orientation", self.keys["orientation"])]
        if fields[0] is None:
            fields = [self._orientation(density, level, part(progress, 0.65, 0.75))]
        step, wanted = part(progress, 0.75, 1.0), settings.guides
        rest = partial(unexplained, pieces, density, level, head, profile)
        amended = amend_guides(
            pieces, rest, density, level, fields.pop(), head, profile, wanted, seed, step, wig.knots, wig.counted, habit
        )
        tally = {f"amended {number}: {name}": count for name, count in (counts | amended.tally).items()}
        return dataclasses.replace(amended, profile=usual, tally=known | tally)

    def _write(
        self, wig: WigScan, registration: Registration, head: Head, guides: Strands, dense: Strands, refined: Refined
    ) -> Reconstruction:
        """Write the result's files, each whole or not at all."""
        self.observer.started("result", TEXTS["result"])
        progress, meter = self._progress("result"), Meter()
        progress(0.0, 1.0)
        hair = refined.strands
        hair.save(self.out / "hair.npz")
        guides.save(self.out / "guides.npz")
        registration.head.save(self.out / "head.obj")
        progress(0.1, 1.0)
        if self.settings.run.orientation:
            field = self._orientation(wig.density, wig.hair_level, part(progress, 0.1, 0.2))
            field_along(field, guides, part(progress, 0.2, 0.3)).save(self.out / "orientation.vdb")
        progress(0.3, 1.0)
        lengths = hair.lengths()
        summary = {
            **self._facts(wig, registration),
            "hair": {
                "strands": len(hair),
                "points": len(hair.points),
                "guides": len(guides),
                "mean_length_mm": float(lengths.mean()) if len(hair) else 0.0,
                "mean_support": float(np.mean(hair.strand_attributes["support"])) if len(hair) else 0.0,
            },
            "scores": refined.scores,
        }
        summary["stages"].append(
            {"name": "result", "seconds": meter.seconds, "peak_memory": meter.peak_memory, "resumed": False, "tally": {}}
        )
        write_report(self.out, summary, wig.density, hair, guides, head, progress=part(progress, 0.3, 1.0))
        seconds = time.monotonic() - self.begun
        progress(1.0, 1.0)
        return Reconstruction(hair, dense, guides, registration.head, np.asarray(registration.matrix), summary, seconds)

    def _template(self) -> HeadMesh:
        path = self.settings.head.mesh
        return load_obj(path) if path else template_head()

    def _keys(self) -> dict[str, str]:
        """The checkpoint key of each stage: all that its result depends on."""
        depends: dict[str, dict[str, Any]] = {stage: {} for stage in STAGES[:-1]}
        depends["scan"] = {"scan": fingerprint(self.scan), **self.raw}
        depends["head"] = {"template": _digest(self.template.vertices, self.template.faces, self.template.scalp)}
        for stage in ("guides", "dense", "refinement"):
            depends[stage] = {"seed": self.settings.run.seed}
        settings_of = {"dense": "interpolation"}
        keys, previous = {}, chained_key("", version=__version__)
        for stage, values in depends.items():
            chosen = dataclasses.asdict(getattr(self.settings, settings_of.get(stage, stage)))
            keys[stage] = previous = chained_key(previous, stage=stage, settings=chosen, **values)
        return keys

    def _stage(self, name: str, work: Callable[[Progress], Value], known: Value | None = None) -> Value:
        """The stage's result, from its checkpoint (or `known`, read before) or by `work`; notes what it cost."""
        self.observer.started(name, TEXTS[name])
        progress, meter = self._progress(name), Meter()
        result = self.checkpoints.load(name, self.keys[name]) if known is None else known
        resumed = result is not None
        if resumed:
            self.resumed_share += SHARES[name]
        else:
            progress(0.0, 1.0)
            result = work(progress)
            self.checkpoints.save(name, self.keys[name], result)
            release_memory()
        cost = {"name": name, "seconds": meter.seconds, "peak_memory": meter.peak_memory, "resumed": resumed}
        self.costs.append(cost | {"tally": dict(result.tally)})
        progress(1.0, 1.0)
        return result

    def _progress(self, name: str) -> Progress:
        """The stage's own progress, told to the observer with the share of the whole and the time that remains."""
        before = sum(SHARES[stage] for stage in STAGES[: STAGES.index(name)])

        def progress(done: float, total: float) -> None:
            fraction = min(done / total, 1.0) if total > 0 else 1.0
            whole = before + SHARES[name] * fraction
            own = whole - self.resumed_share
            elapsed = time.monotonic() - self.begun
            remaining = elapsed * (1.0 - whole) / own if own > 0.02 and elapsed > 2.0 else None
            self.observer.progressed(name, fraction, whole, remaining)

        return progress

    def _warn(self, warnings: Sequence[str]) -> None:
        for text in warnings:
            if text not in self.warnings:
                self.warnings.append(text)
                self.observer.warned(text)

    def _check_memory(self, density: BrickVolume) -> None:
        """Refuse before the long stages what would not fit the memory allowed."""
        allowed = allowed_memory(self.settings.run.memory)
        needed = needed_memory(density.bricks.size, density.bricks.itemsize)
        if needed > allowed:
            raise CT2HairError(
                f"{self.scan}: the stages need about {needed:.1f} GB of memory, {allowed:.1f} GB are allowed; "
                "set run.memory higher or scan.spacing coarser"
            )


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """numba and torch held to `count` threads (0: all)."""
    before = numba.get_num_threads()
    most = numba.config.NUMBA_NUM_THREADS
    numba.set_num_threads(min(count or most, most))
    try:
        yield
    finally:
        numba.set_num_threads(before)


@contextmanager
def _own_folder(out: Path) -> Iterator[None]:
    """`out` to ourselves: refuse a folder that another live run works in, and leave none behind that we made for nothing."""
    made = not out.exists()
    if out.exists() and not out.is_dir():
        raise CT2HairError(f"{out}: is a file; name a folder for the result")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CT2HairError(f"{out}: the folder can't be made ({error.strerror}); choose another") from error
    lock = out / ".running"
    with lock.open("a") as file:
        if not _locked(file):
            raise CT2HairError(f"{out}: another reconstruction is writing there; wait for it or choose another folder")
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            if made and not any(out.iterdir()):
                out.rmdir()


def _locked(file: IO) -> bool:
    """Lock an open file for this process until it is closed; False where another process holds it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
