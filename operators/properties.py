"""What the user sets in the scene: the engine's parameters, made from `settings.py` into property groups, and a few more."""

# No `from __future__ import annotations` here: Blender reads the annotations of property groups as objects.
import struct
from dataclasses import fields
from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..ct2hair_addon.scene import DENSITY_PRESETS, HAIR_COLOURS, REGIONS, ROLE, SCALP_GROUP
from ..ct2hair_addon.settings import PRESETS, Settings, SimulationSettings, parameters

SUBTYPES = {"head.mesh": "FILE_PATH"}
"""Text parameters that are paths: what the panel's field does with them."""
PRESET_HELP = {
    "draft": "Quick: to see whether scan and head are right",
    "standard": "Good hair in a few minutes",
    "final": "More fitting to the scan; twice as long and more",
    "paper": "The parameters of the paper, for comparison",
}


def _property(name: str, known) -> Any:
    """The Blender property of one parameter: type, range, unit and help as `settings.py` has them."""
    meta = known.metadata
    unit = f" ({meta['unit']})" if meta["unit"] else ""
    label = (meta["label"] or known.name.replace("_", " ").capitalize()) + unit
    help = meta["help"][:1].upper() + meta["help"][1:]
    common = {
        "name": label,
        "description": help + (f". Unit: {meta['unit']}" if meta["unit"] else ""),
        "default": known.default,
    }
    if meta["choices"]:
        items = [(choice, choice.capitalize() if choice.isalpha() else choice.upper(), "") for choice in meta["choices"]]
        return EnumProperty(items=items, **common)
    bounds = {key: meta[low] for key, low in (("min", "low"), ("max", "high")) if meta[low] is not None}
    if known.type == "bool":
        return BoolProperty(**common)
    if known.type == "int":
        return IntProperty(**common, **bounds)
    if known.type == "float":
        small = min((abs(value) for value in (known.default, meta["low"]) if value), default=1.0)
        return FloatProperty(precision=2 if small >= 0.01 else 5, step=10 if small >= 0.01 else 1, **common, **bounds)
    return StringProperty(subtype=SUBTYPES.get(name, "NONE"), **common)


def _stage_groups() -> dict[str, type]:
    """A PropertyGroup for each stage of the settings, by the stage's name."""
    annotations: dict[str, dict[str, Any]] = {}
    for name, known in parameters():
        stage, key = name.split(".")
        annotations.setdefault(stage, {})[key] = _property(name, known)
    return {
        stage: type(f"CT2HAIR_PG_{stage}", (bpy.types.PropertyGroup,), {"__annotations__": properties})
        for stage, properties in annotations.items()
    }


STAGES = _stage_groups()
CT2HAIR_PG_simulation = type(
    "CT2HAIR_PG_simulation",
    (bpy.types.PropertyGroup,),
    {
        "__doc__": "All parameters of a simulation.",
        "__annotations__": {known.name: _property(known.name, known) for known in fields(SimulationSettings)},
    },
)

CT2HAIR_PG_settings = type(
    "CT2HAIR_PG_settings",
    (bpy.types.PropertyGroup,),
    {
        "__doc__": "All parameters of a reconstruction, a group a stage.",
        "__annotations__": {stage: PointerProperty(type=group) for stage, group in STAGES.items()},
    },
)


def _preset_chosen(self, context) -> None:
    """Put a preset's values in, and leave alone what says which scan it is and how the job runs."""
    kept = {name: value for name, value in _values(self.settings).items() if name.split(".")[0] in ("scan", "head", "run")}
    set_settings(self.settings, Settings.preset(self.preset).changed(kept))


def _may_be_head(self, ob) -> bool:
    """Meshes that have a vertex group 'scalp', and are not a head of ours already."""
    return ob.type == "MESH" and ROLE not in ob and any(group.name.lower() == SCALP_GROUP for group in ob.vertex_groups)


class CT2HAIR_PG_scene(bpy.types.PropertyGroup):
    """The extension's properties of a scene: `scene.ct2hair`."""

    scan: StringProperty(
        name="Scan",
        description="The CT scan of the wig: .vdb .npy .raw .tif .nii .nii.gz .nrrd .mha .dcm, or a folder of slices",
        subtype="FILE_PATH",
    )
    folder: StringProperty(
        name="Folder",
        description="Where results are written; empty takes ct2hair/<scan> beside the saved .blend, or the user's cache folder",
        subtype="DIR_PATH",
    )
    preset: EnumProperty(
        name="Preset",
        description="Speed against quality: sets the parameters below",
        items=[(name, name.capitalize(), PRESET_HELP.get(name, "")) for name in PRESETS],
        default="standard",
        update=_preset_chosen,
    )
    colour: EnumProperty(
        name="Hair colour",
        description="Pigment of the hair's material",
        items=[(name, colour.label, "") for name, colour in HAIR_COLOURS.items()],
        default="brown",
    )
    head: PointerProperty(
        name="Head",
        description="Your own head mesh, upright at its real size, face to -Y, with a vertex group 'scalp' where hair grows; "
        "empty takes the built-in mannequin",
        type=bpy.types.Object,
        poll=_may_be_head,
    )
    settings: PointerProperty(type=CT2HAIR_PG_settings)
    simulation: PointerProperty(type=CT2HAIR_PG_simulation)
    unfinished: StringProperty(
        name="Unfinished job", description="Folder of the job that runs, or ran when the file was saved", subtype="DIR_PATH"
    )
    slice_axis: EnumProperty(
        name="Slice",
        description="Axis of the scan that the slice lies across",
        items=[(axis, axis.upper(), f"Across the scan's {axis} axis") for axis in ("x", "y", "z")],
        default="z",
    )
    slice_at: FloatProperty(
        name="Place",
        description="Place of the slice: 0 is the scan's first voxel along the axis, 1 its last",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    density: EnumProperty(
        name="Density colours",
        description="Colours of the scan's cloud",
        items=[(name, name.replace("_", "-").capitalize(), "Colours of the scan's cloud") for name in DENSITY_PRESETS],
        default="hair",
    )
    region: EnumProperty(
        name="Region",
        description="Part of the scalp that is trimmed or grown anew",
        items=[("all", "Whole scalp", "All hair")]
        + [(name, label, f"Hair rooted at the {label.lower()}") for name, label in REGIONS.items()],
    )
    trim_length: FloatProperty(
        name="Length (mm)",
        description="Longer hair is cut to this length from its root. Unit: mm",
        default=150.0,
        min=1.0,
        soft_max=600.0,
        max=3000.0,
        precision=0,
    )
    regrow_seed: IntProperty(name="Seed", description="Another seed grows other strands", default=1, min=0)


def simulation_settings_of(group) -> SimulationSettings:
    """The SimulationSettings that a scene's property group holds (`scene.ct2hair.simulation`)."""
    values = {}
    for known in fields(SimulationSettings):
        value = getattr(group, known.name)
        values[known.name] = _shortest(value) if known.type == "float" else value
    return SimulationSettings().changed(values)


def settings_of(group) -> Settings:
    """The Settings that a scene's property group holds (`scene.ct2hair.settings`)."""
    return Settings().changed(_values(group))


def set_settings(group, settings: Settings) -> None:
    """Put `settings` into a property group."""
    for stage, values in settings.to_dict().items():
        for name, value in values.items():
            setattr(getattr(group, stage), name, value)


def _values(group) -> dict[str, Any]:
    """Dotted names and values of a settings group."""
    values = {}
    for name, known in parameters():
        stage, key = name.split(".")
        value = getattr(getattr(group, stage), key)
        values[name] = _shortest(value) if known.type == "float" else value
    return values


def _shortest(value: float) -> float:
    """The shortest decimal that gives Blender's 32 bit float: 0.7, not 0.699999988, the same as on the command line."""
    for digits in range(6, 10):
        short = float(f"{value:.{digits}g}")
        if struct.pack("f", short) == struct.pack("f", value):
            return short
    return value


CLASSES = (*STAGES.values(), CT2HAIR_PG_settings, CT2HAIR_PG_simulation, CT2HAIR_PG_scene)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.ct2hair = PointerProperty(type=CT2HAIR_PG_scene)


def unregister() -> None:
    del bpy.types.Scene.ct2hair
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
