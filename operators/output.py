"""Operators for the result: export it, render a picture of it."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from .reporting import reported


class OfResult:
    """What needs a result in the scene."""

    @classmethod
    def poll(cls, context):
        if scene.active_result(context) is None:
            cls.poll_message_set("There is no result in the scene: reconstruct a scan or load a result first")
            return False
        return True


class CT2HAIR_OT_export(OfResult, bpy.types.Operator):
    """Export the result of the active object (or the newest one): .blend, Alembic groom, USD, picture, report"""

    bl_idname = "ct2hair.export"
    bl_label = "Export Hair"
    bl_options = {"REGISTER"}

    directory: StringProperty(name="Folder", description="Where the files are written", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})
    name: StringProperty(name="Name", description="Name of the files, without ending", default="hair")
    blend: BoolProperty(name="Blender (.blend)", description="A copy of the whole file", default=True)
    alembic: BoolProperty(
        name="Alembic groom (.abc)",
        description="Hair, guides and head with groom attributes, as Unreal, Houdini and Maya read them; Y up",
        default=True,
    )
    unit: EnumProperty(
        name="Alembic unit",
        description="Unit of the coordinates in the Alembic file",
        items=[
            ("m", "Metres", "Houdini, Blender"),
            ("cm", "Centimetres", "Unreal, Maya"),
            ("mm", "Millimetres", "As the scan"),
        ],
        default="m",
    )
    up: EnumProperty(
        name="Alembic up axis",
        description="Axis of the Alembic file that points up",
        items=[("y", "Y", "Unreal, Houdini, Maya"), ("z", "Z", "As in Blender")],
        default="y",
    )
    animated: BoolProperty(
        name="Animated",
        description="Alembic and USD hold a sample a frame over the scene's frame range, for hair that is simulated or whose "
        "head moves. Off, the hair as it stands now",
        default=False,
    )
    usd: BoolProperty(
        name="USD (.usda)", description="Hair, guides and head; attributes as primvars; metres, Z up", default=True
    )
    bin: BoolProperty(name="CT2Hair (.bin)", description="Points, directions and labels of the strands", default=False)
    data: BoolProperty(name="USC-HairSalon (.data)", description="Points of the strands", default=False)
    hair: BoolProperty(name="Cem Yuksel (.hair)", description="Points of the strands", default=False)
    npz: BoolProperty(name="CT2Hair for Blender (.npz)", description="Strands with all their attributes", default=False)
    strand_unit: EnumProperty(
        name="Strand file unit",
        description="Unit of the coordinates in .bin, .data, .hair and .npz",
        items=[(unit, unit, f"Coordinates in {unit}") for unit in scene.STRAND_UNITS],
        default="mm",
    )
    strand_up: EnumProperty(
        name="Strand file up axis",
        description="Axis that points up in .bin, .data, .hair and .npz",
        items=[("z", "Z", "As in Blender"), ("y", "Y", "USC-HairSalon, Cem Yuksel")],
        default="z",
    )
    picture: BoolProperty(name="Picture (render.png)", description="A Cycles picture; takes a minute or more", default=False)

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "name")
        column = layout.column(heading="Scene")
        column.prop(self, "blend")
        column.prop(self, "picture")
        column = layout.column(heading="Groom")
        column.prop(self, "alembic")
        column.prop(self, "usd")
        column.prop(self, "animated")
        column = layout.column()
        column.active = self.alembic
        column.prop(self, "unit")
        column.prop(self, "up")
        column = layout.column(heading="Strands")
        for ending in scene.STRAND_FORMATS:
            column.prop(self, ending)
        column = layout.column()
        column.active = any(getattr(self, ending) for ending in scene.STRAND_FORMATS)
        column.prop(self, "strand_unit")
        column.prop(self, "strand_up")

    @reported(CT2HairError, OSError, RuntimeError)
    def execute(self, context):
        formats = tuple(name for name in scene.FORMATS if getattr(self, name))
        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        if folder is None or not formats:
            self.report({"ERROR"}, "Nothing to export: choose a folder and at least one format")
            return {"CANCELLED"}
        written = scene.export_all(
            scene.active_result(context),
            folder,
            formats=formats,
            name=self.name,
            unit=self.unit,
            up=self.up,
            strand_unit=self.strand_unit,
            strand_up=self.strand_up,
            frames=(context.scene.frame_start, context.scene.frame_end) if self.animated else None,
        )
        self.report({"INFO"}, f"Wrote {', '.join(path.name for path in written.values())} to {folder}")
        return {"FINISHED"}


class CT2HAIR_OT_render(OfResult, bpy.types.Operator, ExportHelper):
    """Render a picture of the result with Cycles in a studio of its own; the scene stays as it is"""

    bl_idname = "ct2hair.render"
    bl_label = "Render Picture"
    bl_options = {"REGISTER"}

    filename_ext = ".png"
    filter_glob: StringProperty(default="*.png", options={"HIDDEN"})
    view: EnumProperty(
        name="View",
        description="From where the head is seen",
        items=[
            ("three_quarter", "Three-quarter", "From the front, a little from the side"),
            ("front", "Front", "The face from the front"),
            ("side", "Side", "From the wearer's right"),
            ("back", "Back", "From behind"),
        ],
    )
    samples: IntProperty(
        name="Samples", description="Cycles samples a pixel: more are cleaner and slower", default=64, min=1, max=4096
    )
    size: IntProperty(name="Size", description="Edge of the picture. Unit: pixels", default=800, min=16, max=8192)

    @reported(CT2HairError, OSError, RuntimeError)
    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath)).with_suffix(".png")
        scene.render_picture(scene.active_result(context), path, view=self.view, samples=self.samples, size=self.size)
        self.report({"INFO"}, f"Rendered {path}")
        return {"FINISHED"}


class CT2HAIR_OT_turntable(OfResult, bpy.types.Operator):
    """Render pictures all round the head with Cycles, the lights turning with the camera; the scene stays as it is"""

    bl_idname = "ct2hair.turntable"
    bl_label = "Render Turntable"
    bl_options = {"REGISTER"}

    directory: StringProperty(name="Folder", description="Where turntable_0000.png and on are written", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})
    frames: IntProperty(name="Pictures", description="Pictures in one turn", default=24, min=2, max=720)
    samples: IntProperty(
        name="Samples", description="Cycles samples a pixel: more are cleaner and slower", default=48, min=1, max=4096
    )
    size: IntProperty(name="Size", description="Edge of each picture. Unit: pixels", default=600, min=16, max=8192)

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reported(CT2HairError, OSError, RuntimeError)
    def execute(self, context):
        if not self.directory:
            self.report({"ERROR"}, "Choose a folder for the pictures")
            return {"CANCELLED"}
        folder = Path(bpy.path.abspath(self.directory))
        pictures = scene.render_turntable(
            scene.active_result(context), folder, frames=self.frames, samples=self.samples, size=self.size
        )
        self.report({"INFO"}, f"Rendered {len(pictures)} pictures to {folder}")
        return {"FINISHED"}


class CT2HAIR_OT_hair_colour(OfResult, bpy.types.Operator):
    """Give the hair's material the scene's hair colour"""

    bl_idname = "ct2hair.hair_colour"
    bl_label = "Apply Hair Colour"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        material = scene.active_result(context).hair.active_material
        if material is None or material.node_tree is None or "Hair" not in material.node_tree.nodes:
            self.report({"ERROR"}, "The hair has another material than ours; set its colour in the shader editor")
            return {"CANCELLED"}
        scene.set_hair_colour(material, context.scene.ct2hair.colour)
        return {"FINISHED"}


CLASSES = (CT2HAIR_OT_export, CT2HAIR_OT_render, CT2HAIR_OT_turntable, CT2HAIR_OT_hair_colour)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
