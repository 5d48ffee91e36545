"""Every parameter, once: a dataclass a stage, with unit, range and help; presets; JSON.

The panel's properties, the command line's options, the job file and the manual's table are all made from these fields.
0 (or "") means "found automatically" wherever the help says so.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from .errors import SettingsError

STOPS = ("scan", "head", "orientation", "guides", "dense")
"""Stages of the pipeline that a reconstruction may stop after, to be looked at; without, it goes through."""
AXES = ("auto", "+x", "-x", "+y", "-y", "+z", "-z")


def parameter(default, help: str, *, unit: str = "", low=None, high=None, choices: tuple[str, ...] = (), label: str = ""):
    """A settings field: its default, what it does, its unit, and the range or the choices that it is held to."""
    metadata = {"help": help, "unit": unit, "low": low, "high": high, "choices": choices, "label": label}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class ScanSettings:
    """The scan as it comes from the scanner (paper 3.1, supplement 1)."""

    spacing: float = parameter(0.0, "voxel size; 0 takes it from the file", unit="mm", low=0.0, high=10.0)
    raw_shape: str = parameter("", "voxels along x, y, z of a raw file, 512x512x300, say; empty takes them from its name")
    raw_type: str = parameter("", "numbers of a raw file, uint16 or float32be (big-endian), say; empty takes it from its name")
    air: float = parameter(0.0, "scan value of air; 0 finds it from the histogram")
    hair: float = parameter(0.0, "scan value above which a voxel is hair; 0 finds it from the histogram")
    knots: float = parameter(0.0, "scan value above which a voxel may be a knot of the net; 0 finds it from the histogram")
    solid: float = parameter(0.0, "scan value above which a large body is the mannequin; 0 finds it from the histogram")


@dataclass(frozen=True)
class HeadSettings:
    """The template head and its registration (supplement 1)."""

    mesh: str = parameter("", "OBJ file of a head with a group or material 'scalp'; empty takes the built-in mannequin")
    face: str = parameter("auto", "scan axis that the face looks along", choices=AXES)
    up: str = parameter("auto", "scan axis that points to the crown", choices=AXES)
    place: str = parameter(
        "",
        "where the head stands in the scan, by hand: the 16 numbers, by row, of the matrix head to scan; empty finds it",
        unit="mm",
    )
    net_clearance: float = parameter(
        0.0,
        "hair voxels closer to the scalp than this are taken for the hairnet; 0: 0.5 and the scan's blur, 1.5 at most",
        unit="mm",
        low=0.0,
        high=10.0,
    )


@dataclass(frozen=True)
class OrientationSettings:
    """The 3D orientation field (paper 3.2.1, eqs. 1 and 2)."""

    method: str = parameter(
        "gradient",
        "gradient: the direction across which density changes; gabor: the best of many oriented filters (the paper's ablation)",
        choices=("gradient", "gabor"),
    )
    sigma: float = parameter(0.7, "Gaussian under the density gradient", unit="voxel", low=0.0, high=3.0)
    rho: float = parameter(1.75, "Gaussian over which gradients are gathered", unit="voxel", low=0.5, high=5.0)
    reweighting: int = parameter(0, "steps of iterative reweighting against outliers", low=0, high=10)
    confidence: float = parameter(0.1, "voxels of a lower confidence are left out", low=0.0, high=1.0)


@dataclass(frozen=True)
class GuideSettings:
    """Guide strands from the orientation field (paper 3.2.2, Algorithm 1, supplement 2)."""

    method: str = parameter(
        "trace",
        "trace: strands followed through the density and taken out of it; paper: the paper's mean shift, Euler steps, growing",
        choices=("trace", "paper"),
    )
    step: float = parameter(1.0, "Euler step along a segment", unit="voxel", low=0.1, high=4.0)
    max_turn: float = parameter(30.0, "a segment ends where it would turn more in one step", unit="degrees", low=1.0, high=90.0)
    smoothing: float = parameter(
        0.6, "a segment's points are smoothed as far as this keeps the curve within", unit="voxel", low=0.0, high=5.0
    )
    min_length: float = parameter(4.0, "shorter segments are dropped", unit="mm", low=0.0, high=100.0)
    fine_length: float = parameter(36.0, "shorter segments are never fine (tau_l)", unit="mm", low=0.0, high=500.0)
    scalp_reach: float = parameter(8.0, "a fine segment starts this close to the scalp (tau_c)", unit="mm", low=0.0, high=50.0)
    scalp_angle: float = parameter(
        75.0, "largest angle to the scalp's normal at a root (tau_a)", unit="degrees", low=1.0, high=90.0
    )
    link: bool = parameter(True, "segments are joined into whole strands before they are grown")
    knots: bool = parameter(True, "roots are led to the hairnet's knots, where hair is tied, as far as the scan shows them")
    min_support: float = parameter(
        0.15, "a strand of which less than this share was traced in the scan is dropped", low=0.0, high=1.0
    )
    amend: int = parameter(
        2,
        "how often guides are fitted to the scan, what they have too many is cut out and what they lack traced anew",
        low=0,
        high=8,
    )
    neighbour_radius: float = parameter(
        3.0, "reach of a poor segment for a fine neighbour (tau_s)", unit="mm", low=0.1, high=50.0
    )


@dataclass(frozen=True)
class InterpolationSettings:
    """Dense strands from the guides, over the scalp (paper 3.3.1, eq. 3)."""

    method: str = parameter(
        "scalp",
        "scalp: new roots evenly over the scalp, as many as asked for; texture: the paper's texels, drawn at random",
        choices=("scalp", "texture"),
    )
    strands: int = parameter(
        0,
        "strands of the result; 0 takes as many as the scan's density holds; texture: texels drawn (N_i), 0 takes 100,000",
        low=0,
        high=1_000_000,
    )
    neighbours: int = parameter(3, "guides that are blended into a new strand (k_i)", low=1, high=16)
    nearest: float = parameter(0.6, "no new strand closer to a guide than this (sigma_min)", unit="texel", low=0.0, high=100.0)
    farthest: float = parameter(
        60.0, "no new strand farther from a guide than this (sigma_max)", unit="texel", low=0.1, high=10000.0
    )
    texture: int = parameter(
        0,
        "edge of the scalp texture that texels count in; 0: 6.6 texels from root to root",
        unit="texel",
        low=0,
        high=8192,
    )
    similarity: float = parameter(
        0.85,
        "guides less alike than this (mean cosine times ratio of lengths) are not blended",
        low=0.0,
        high=1.0,
    )
    coder: str = parameter(
        "network",
        "what guides are blended as: codes of the learned prior, cosines of their directions, or plain positions",
        choices=("network", "linear", "euclidean"),
    )
    phase: str = parameter(
        "aligned",
        "network and linear: curls are brought into phase before they are blended, or blended as they are found",
        choices=("aligned", "found"),
    )
    without_prior: str = parameter(
        "refuse",
        "where the learned prior can't be loaded: refuse the job, or go on with the linear coder",
        choices=("refuse", "linear"),
    )


@dataclass(frozen=True)
class RefinementSettings:
    """Strands moved to fit the volume (paper 3.3.2, eqs. 4 to 6)."""

    method: str = parameter(
        "volume",
        "volume: all strands against the density itself; chamfer: the paper's, points of strands against points of the scan",
        choices=("volume", "chamfer"),
    )
    iterations: int = parameter(30, "steps of the optimiser at most; 0 leaves the dense strands as they are", low=0, high=1000)
    points: int = parameter(128, "control points of each strand at most", low=8, high=256)
    prune: bool = parameter(
        True, "volume: made-up strands and tips that explain nothing of the scan go, and traced strands that only double others"
    )
    exchange: bool = parameter(
        True, "volume: traced strands that went over to each other's course, where they touch, exchange their tips"
    )
    coarsest: float = parameter(
        1.0,
        "volume: largest voxel of the coarse-to-fine search, in the scan's: how far strands are drawn; 1 takes the scan alone",
        unit="voxel",
        low=1.0,
        high=64.0,
    )
    stiffness: float = parameter(
        3.5,
        "volume: waves shorter than about six times this length are noise of the tracing, but where hair bends as sharply",
        unit="voxel",
        low=0.0,
        high=100.0,
    )
    rate: float = parameter(0.1, "chamfer: learning rate of Adam", unit="mm", low=1e-4, high=10.0)
    batch: int = parameter(1600, "chamfer: neighbouring strands optimised together", low=1, high=100_000)
    targets: int = parameter(16, "chamfer: nearest points of the scan per strand point (k_o)", low=1, high=64)
    patience: float = parameter(
        0.05, "chamfer: a batch is done where the loss drops by no more than this (epsilon)", low=0.0, high=1e6
    )
    length_weight: float = parameter(100.0, "chamfer: weight of kept lengths (eq. 4)", low=0.0, high=1e6)
    tangent_weight: float = parameter(100.0, "chamfer: weight of kept tangents (eq. 5)", low=0.0, high=1e6)


@dataclass(frozen=True)
class RunSettings:
    """How the job runs; nothing here but the seed changes the result by more than a rounding."""

    seed: int = parameter(0, "seed of everything random", low=0, high=2**31 - 1)
    threads: int = parameter(0, "processor threads; 0 takes all", low=0, high=1024)
    memory: float = parameter(
        0.0, "memory to stay under; 0 takes three quarters of the machine's", unit="GB", low=0.0, high=4096.0
    )
    device: str = parameter(
        "auto",
        "where strands are fitted to the scan; auto: on a CUDA card where torch has one, on the processor where it has no room",
        choices=("auto", "cpu", "cuda"),
    )
    orientation: bool = parameter(
        False, "the orientation field, with the traced strands' directions in it, is written as well: orientation.vdb"
    )


@dataclass(frozen=True)
class SynthesisSettings:
    """A scan made from strands: how the scanner and the wig's base look in it (supplement 3). No part of a reconstruction."""

    snr: float = parameter(4.0, "peak of a lone strand over the noise's standard deviation", low=0.1, high=1000.0)
    clean: bool = parameter(False, "the blurred counts alone: no air, noise, hairnet or mannequin")
    seed: int = parameter(0, "seed of the noise, the net and the knots", low=0, high=2**31 - 1)
    blur: float = parameter(0.85, "the scanner's blur (sigma)", unit="voxel", low=0.0, high=4.0)
    mannequin: str = parameter("shell", "what the mannequin is made of", choices=("shell", "solid", "foam", "none"))
    mannequin_level: float = parameter(
        0.0, "density of the mannequin; 0 takes 12 for plastic, 0.3 for foam", unit="lone strands", low=0.0, high=400.0
    )
    mannequin_thickness: float = parameter(3.0, "wall of the mannequin's shell", unit="mm", low=0.1, high=50.0)
    net: bool = parameter(True, "a hairnet over the scalp, with a knot at every root")
    net_cell: float = parameter(0.0, "width of a mesh of the hairnet; 0 takes 10 voxels", unit="mm", low=0.0, high=50.0)
    net_height: float = parameter(0.5, "how far over the scalp the net's threads wave", unit="mm", low=0.0, high=10.0)
    knot_level: float = parameter(4.0, "peak of a knot; 0 leaves the knots out", unit="lone strands", low=0.0, high=100.0)
    rings: float = parameter(0.0, "standard deviation of ring artefacts", unit="noise", low=0.0, high=10.0)
    strand: float = parameter(130.0, "scan value of a lone strand above air", low=1.0, high=10_000.0)
    air: float = parameter(1000.0, "scan value of air", low=0.0, high=30_000.0)
    margin: float = parameter(4.0, "air left around the wig", unit="mm", low=0.0, high=100.0)

    def changed(self, changes: Mapping[str, Any]) -> SynthesisSettings:
        """These settings with some set, `{"snr": 2.0}`. Raises SettingsError for bad ones."""
        return _changed(self, changes, "synthesis")


@dataclass(frozen=True)
class SimulationSettings:
    """Hair in motion (ours; the paper has none). No part of a reconstruction."""

    guides: int = parameter(1000, "strands simulated at most; the others follow them", low=1, high=100_000)
    points: int = parameter(24, "points of each simulated strand", low=4, high=256)
    stiffness: float = parameter(
        0.7, "how firmly hair keeps its curls and bends: 0 is wet string, 1 is wire", low=0.0, high=1.0
    )
    hold: float = parameter(
        3.0, "pull back to where the hair stood in the scan: 0 none, 20 hair spray", unit="1/s", low=0.0, high=1000.0
    )
    gravity: float = parameter(
        0.5,
        "share of the scene's gravity: the scan hangs by it already, so 0 leaves hair on a still head at rest",
        low=-10.0,
        high=10.0,
    )
    drag: float = parameter(4.0, "share of its speed that hair loses to the air", unit="1/s", low=0.0, high=1000.0)
    wind_x: float = parameter(0.0, "wind along x of the scene", unit="m/s", low=-100.0, high=100.0)
    wind_y: float = parameter(0.0, "wind along y of the scene", unit="m/s", low=-100.0, high=100.0)
    wind_z: float = parameter(0.0, "wind along z of the scene", unit="m/s", low=-100.0, high=100.0)

    def changed(self, changes: Mapping[str, Any]) -> SimulationSettings:
        """These settings with some set, `{"wind_y": 2.0}`. Raises SettingsError for bad ones."""
        return _changed(self, changes, "simulation")


@dataclass(frozen=True)
class Settings:
    """All settings of one reconstruction."""

    scan: ScanSettings = ScanSettings()
    head: HeadSettings = HeadSettings()
    orientation: OrientationSettings = OrientationSettings()
    guides: GuideSettings = GuideSettings()
    interpolation: InterpolationSettings = InterpolationSettings()
    refinement: RefinementSettings = RefinementSettings()
    run: RunSettings = RunSettings()

    def changed(self, changes: Mapping[str, Any]) -> Settings:
        """These settings with dotted names set, `{"guides.step": 0.5}`. Raises SettingsError for bad ones."""
        stages: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            stage, _, key = name.partition(".")
            known = _PARAMETERS.get(name)
            if known is None:
                raise SettingsError(f"unknown setting '{name}'; settings of a stage are written stage.name, guides.step, say")
            stages.setdefault(stage, {})[key] = _checked(name, known, value)
        return dataclasses.replace(
            self, **{stage: dataclasses.replace(getattr(self, stage), **values) for stage, values in stages.items()}
        )

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Nested plain values, a dictionary a stage."""
        return dataclasses.asdict(self)

    def to_json(self) -> str:
        return json.dumps(self.to_dict(), indent=2, sort_keys=True)

    @classmethod
    def from_dict(cls, values: Mapping[str, Mapping[str, Any]]) -> Settings:
        """The inverse of `to_dict`; what is missing keeps its default."""
        try:
            flat = {f"{stage}.{name}": value for stage, group in values.items() for name, value in group.items()}
        except AttributeError:
            raise SettingsError('settings must be nested as {"stage": {"name": value}}') from None
        return cls().changed(flat)

    @classmethod
    def from_json(cls, text: str) -> Settings:
        try:
            values = json.loads(text)
        except json.JSONDecodeError as error:
            raise SettingsError(f"the settings are not valid JSON: {error}") from None
        return cls.from_dict(values)

    @classmethod
    def preset(cls, name: str) -> Settings:
        """The settings of a preset by name. Raises SettingsError for an unknown one."""
        if name not in PRESETS:
            raise SettingsError(f"unknown preset '{name}'; there are {', '.join(PRESETS)}")
        return cls().changed(PRESETS[name])


def parameters() -> Iterator[tuple[str, dataclasses.Field]]:
    """Every parameter as (dotted name, field), in the order of the stages."""
    for stage in fields(Settings):
        for parameter_field in fields(type(stage.default)):
            yield f"{stage.name}.{parameter_field.name}", parameter_field


_PARAMETERS = dict(parameters())
_TYPES = {"float": float, "int": int, "str": str, "bool": bool}

PRESETS: dict[str, dict[str, Any]] = {
    "draft": {"guides.amend": 0, "refinement.iterations": 15, "refinement.points": 64},
    "standard": {},
    "final": {"guides.amend": 3, "refinement.iterations": 60, "refinement.points": 192},
    "paper": {
        "orientation.sigma": 0.0,
        "orientation.rho": 1.5,
        "orientation.reweighting": 1,
        "guides.method": "paper",
        "interpolation.method": "texture",
        "interpolation.strands": 100_000,
        "interpolation.farthest": 6.0,
        "interpolation.texture": 2048,
        "interpolation.similarity": 0.0,
        "interpolation.phase": "found",
        "refinement.method": "chamfer",
        "refinement.iterations": 80,
        "refinement.points": 64,
    },
}
"""Named changes to the defaults: speed against quality, and the paper's own parameters."""


def _changed(settings, changes: Mapping[str, Any], of: str):
    """A dataclass of parameters with some set. Raises SettingsError for unknown and bad ones."""
    known = {known_field.name: known_field for known_field in fields(settings)}
    for name in changes:
        if name not in known:
            raise SettingsError(f"unknown setting '{name}' of the {of}; there are {', '.join(known)}")
    return dataclasses.replace(settings, **{name: _checked(name, known[name], value) for name, value in changes.items()})


def _checked(name: str, known: dataclasses.Field, value: Any) -> Any:
    """`value` in the parameter's type, or SettingsError where it is of another type or out of range."""
    wanted = _TYPES[known.type]
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)) or value != value:
        raise SettingsError(f"setting '{name}' must be of type {known.type}, got {value!r}")
    low, high, choices = (known.metadata[key] for key in ("low", "high", "choices"))
    unit = f" {known.metadata['unit']}" if known.metadata["unit"] else ""
    if choices and value not in choices:
        raise SettingsError(f"setting '{name}' must be one of {', '.join(choices)}, got {value!r}")
    if (low is not None and value < low) or (high is not None and value > high):
        raise SettingsError(f"setting '{name}' is {value}{unit}, expected {low} to {high}{unit}")
    return value
