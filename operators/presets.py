"""Presets of the parameters: kept with Blender's own, as files to share, and as JSON that the command line reads."""

import json
from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bpy.props import StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ..ct2hair_addon.errors import CT2HairError
from ..ct2hair_addon.settings import Settings, parameters
from .properties import set_settings, settings_of

FOLDER = "ct2hair/reconstruction"
KEPT = ("scan.spacing", "scan.raw_shape", "scan.raw_type", "head.mesh", "head.place", "run.threads", "run.memory", "run.device")
"""Parameters that belong to one scan or one machine, and to no preset."""


class CT2HAIR_MT_presets(bpy.types.Menu):
    """Your own presets of all parameters"""

    bl_idname = "CT2HAIR_MT_presets"
    bl_label = "Your Presets"
    preset_subdir = FOLDER
    preset_operator = "script.execute_preset"
    draw = bpy.types.Menu.draw_preset


class CT2HAIR_OT_preset_add(AddPresetBase, bpy.types.Operator):
    """Keep the parameters as a preset of yours, or remove the one that is shown. Each is a file in the folder
    scripts/presets/ct2hair of Blender's user files, to be shared"""

    bl_idname = "ct2hair.preset_add"
    bl_label = "Add Preset"
    preset_menu = "CT2HAIR_MT_presets"
    preset_subdir = FOLDER
    preset_defines = ("settings = bpy.context.scene.ct2hair.settings",)
    preset_values = tuple(f"settings.{name}" for name, _ in parameters() if name not in KEPT)


class CT2HAIR_OT_settings_save(bpy.types.Operator, ExportHelper):
    """Write all parameters as JSON, as the command line's --settings and batch files read them"""

    bl_idname = "ct2hair.settings_save"
    bl_label = "Save Parameters"
    filename_ext = ".json"
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})

    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath)).with_suffix(".json")
        try:
            path.write_text(settings_of(context.scene.ct2hair.settings).to_json() + "\n", encoding="utf-8")
        except OSError as error:
            self.report({"ERROR"}, f"{path}: can't be written ({error.strerror})")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {path}")
        return {"FINISHED"}


class CT2HAIR_OT_settings_load(bpy.types.Operator, ImportHelper):
    """Read parameters from JSON, or from the report.json of a finished job; what the file lacks takes its default"""

    bl_idname = "ct2hair.settings_load"
    bl_label = "Load Parameters"
    bl_options = {"REGISTER", "UNDO"}
    filename_ext = ".json"
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})

    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath))
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            known = values.get("settings", values) if isinstance(values, dict) else values
            set_settings(context.scene.ct2hair.settings, Settings.from_dict(known))
        except (OSError, ValueError, CT2HairError) as error:
            self.report({"ERROR"}, f"{path}: {error}")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Read {path}")
        return {"FINISHED"}


CLASSES = (CT2HAIR_MT_presets, CT2HAIR_OT_preset_add, CT2HAIR_OT_settings_save, CT2HAIR_OT_settings_load)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
