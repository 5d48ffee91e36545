"""The panels of the sidebar: scan, reconstruct, result."""

import bpy

from ..ct2hair_addon import scene
from ..operators.properties import STAGES
from ..operators.running import current, time_left

STAGE_LABELS = {
    "scan": "Scan",
    "head": "Head",
    "orientation": "Orientation",
    "guides": "Guides",
    "interpolation": "Dense hair",
    "refinement": "Refinement",
    "run": "Job",
}
ON_TOP = {("scan", "spacing"), ("head", "face"), ("head", "up"), ("interpolation", "strands"), ("run", "seed")}
"""Parameters that are shown without opening a stage."""


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "CT2Hair"

    def column(self):
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        return self.layout.column()


class CT2HAIR_PT_scan(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_scan"
    bl_label = "Scan"
    bl_order = 0

    def draw(self, context):
        properties = context.scene.ct2hair
        column = self.column()
        column.operator("ct2hair.import_scan", icon="IMPORT")
        column.prop(properties, "scan")
        column.prop(properties.settings.scan, "spacing")
        if properties.scan.lower().endswith(".raw"):
            column.prop(properties.settings.scan, "raw_shape")
            column.prop(properties.settings.scan, "raw_type")


class CT2HAIR_PT_reconstruct(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_reconstruct"
    bl_label = "Reconstruct"
    bl_order = 1

    def draw(self, context):
        properties = context.scene.ct2hair
        settings = properties.settings
        column = self.column()
        column.enabled = current.job is None
        column.prop(properties, "preset")
        column.prop(settings.interpolation, "strands")
        column.prop(settings.run, "seed")
        column.prop(properties, "head")
        column.prop(settings.head, "face")
        column.prop(settings.head, "up")
        column.prop(properties, "folder")
        column = self.column()
        if current.job is None:
            row = column.row()
            row.scale_y = 1.4
            row.operator("ct2hair.reconstruct", icon="OUTLINER_OB_CURVES")
            self._draw_outcome(column)
        else:
            self._draw_progress(column)

    @staticmethod
    def _draw_progress(column):
        job = current.job
        column.label(text=job.text.capitalize() or "Starting", icon="SORTTIME")
        column.progress(factor=job.fraction, type="BAR", text=f"{job.fraction:.0%}  {time_left(job.remaining)}".strip())
        column.operator("ct2hair.cancel", icon="CANCEL")

    @staticmethod
    def _draw_outcome(column):
        if not current.ended:
            return
        box = column.box()
        for number, line in enumerate(_wrapped(current.ended)):
            box.label(text=line, icon=("ERROR" if current.failed else "CHECKMARK") if number == 0 else "BLANK1")
        for warning in current.warnings[:3]:
            for number, line in enumerate(_wrapped(warning)):
                box.label(text=line, icon="INFO" if number == 0 else "BLANK1")
        if current.log is not None and current.log.is_file():
            box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(current.log)


class CT2HAIR_PT_parameters(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_parameters"
    bl_label = "All Parameters"
    bl_parent_id = "CT2HAIR_PT_reconstruct"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        self.layout.enabled = current.job is None
        settings = context.scene.ct2hair.settings
        for stage, group in STAGES.items():
            header, body = self.layout.panel(f"ct2hair_{stage}", default_closed=True)
            header.label(text=STAGE_LABELS.get(stage, stage.capitalize()))
            if body is not None:
                for name in group.__annotations__:
                    if (stage, name) not in ON_TOP:
                        body.prop(getattr(settings, stage), name)


class CT2HAIR_PT_result(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_result"
    bl_label = "Result"
    bl_order = 2

    def draw(self, context):
        column = self.column()
        result = scene.active_result(context)
        if result is None:
            column.label(text="No result in the scene", icon="INFO")
        else:
            column.label(text=result.collection.name, icon="OUTLINER_OB_CURVES")
            column.label(text=f"{len(result.hair.data.curves):,} strands")
            row = column.row(align=True)
            row.prop(context.scene.ct2hair, "colour")
            row.operator("ct2hair.hair_colour", text="", icon="CHECKMARK")
            for ob, label in ((result.hair, "Hair"), (result.guides, "Guides"), (result.volume, "Scan")):
                if ob is not None:
                    row = column.row()
                    row.label(text=label)
                    row.prop(ob, "hide_viewport", text="")
                    row.prop(ob, "hide_render", text="")
        column.operator("ct2hair.export", icon="EXPORT")
        column.operator("ct2hair.render", icon="RENDER_STILL")
        column.operator("ct2hair.load_result", icon="FILE_FOLDER")


def _wrapped(text: str, width: int = 46) -> list[str]:
    """Text in lines that fit the sidebar."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


CLASSES = (CT2HAIR_PT_scan, CT2HAIR_PT_reconstruct, CT2HAIR_PT_parameters, CT2HAIR_PT_result)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
