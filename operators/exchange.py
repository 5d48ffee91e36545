"""Operators for hair of other programs: strand files become curves on a head."""

from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from .reporting import reported

ENDINGS = tuple(f".{ending}" for ending in scene.STRAND_FORMATS)


class CT2HAIR_OT_import_hair(bpy.types.Operator, ImportHelper):
    """Import strands (.npz .bin .data .hair) as hair curves on a head: your own, or the mannequin fitted to the roots"""

    bl_idname = "ct2hair.import_hair"
    bl_label = "Import Hair"
    bl_options = {"REGISTER", "UNDO"}

    filter_glob: StringProperty(default=";".join(f"*{ending}" for ending in ENDINGS), options={"HIDDEN"})
    unit: EnumProperty(
        name="Unit",
        description="Unit of the file's coordinates",
        items=[("auto", "Automatic", "The unit by which the hair is as large as hair is")]
        + [(unit, unit, f"Coordinates in {unit}") for unit in scene.STRAND_UNITS],
    )
    up: EnumProperty(
        name="Up axis",
        description="Axis of the file that points to the crown",
        items=[("z", "Z", "Face to -Y, as in Blender"), ("y", "Y", "Face to +Z: USC-HairSalon, Cem Yuksel")],
    )
    on: EnumProperty(
        name="Head",
        description="The head that the hair is attached to",
        items=[
            ("fit", "Mannequin, fitted", "The built-in head, fitted to the roots of the strands"),
            ("scene", "The scene's head", "The head chosen in the sidebar, which the strands must fit already"),
        ],
    )

    @reported(CT2HairError, OSError)
    def execute(self, context):
        head = context.scene.ct2hair.head if self.on == "scene" else None
        if self.on == "scene" and head is None:
            self.report({"ERROR"}, "The scene has no head: choose one in the sidebar, tab CT2Hair, Head")
            return {"CANCELLED"}
        path = Path(bpy.path.abspath(self.filepath))
        colour = context.scene.ct2hair.colour
        result = scene.import_strands(path, unit=self.unit, up=self.up, head=head, colour=colour, context=context)
        self.report({"INFO"}, f"Imported {len(result.hair.data.curves)} strands: '{result.collection.name}'")
        return {"FINISHED"}


class CT2HAIR_FH_hair(bpy.types.FileHandler):
    """Strand files dropped into the viewport are imported."""

    bl_idname = "CT2HAIR_FH_hair"
    bl_label = "Hair strands"
    bl_import_operator = "ct2hair.import_hair"
    bl_file_extensions = ".data;.hair;.bin"

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator(CT2HAIR_OT_import_hair.bl_idname, text="Hair Strands (.npz .bin .data .hair)")


CLASSES = (CT2HAIR_OT_import_hair, CT2HAIR_FH_hair)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
