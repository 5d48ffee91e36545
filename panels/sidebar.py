"""The panels of the sidebar in the order of the work: scan, head, reconstruct, result, simulate, export. Layout only."""

import bpy

from ..ct2hair_addon import scene
from ..ct2hair_addon.scene import REGIONS
from ..operators import look
from ..operators.preferences import preferences
from ..operators.properties import STAGES, CT2HAIR_PG_simulation
from ..operators.reconstruct import STAGE_NAMES
from ..operators.result import WHAT, cloud_material
from ..operators.running import current, looking, time_left

STAGE_LABELS = {
    "scan": "Scan",
    "head": "Head",
    "orientation": "Orientation",
    "guides": "Guides",
    "interpolation": "Dense hair",
    "refinement": "Refinement",
    "run": "Job",
}
ON_TOP = {
    *(("scan", name) for name in ("spacing", "air", "hair", "knots", "solid")),
    *(("head", name) for name in ("face", "up", "net_clearance", "place")),
    ("interpolation", "strands"),
    ("run", "seed"),
}
"""Parameters that are shown without opening a stage."""
STATES = {"running": "SORTTIME", "done": "CHECKMARK", "stopped": "PAUSE", "": "RADIOBUT_OFF"}
"""Icons of a stage's state."""
PICTURE = 9.0
"""Size of pictures in the panel, in buttons' heights."""


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
        if looking.process is None:
            column.operator("ct2hair.look", icon="VIEWZOOM")
        else:
            column.label(text="Looking at the scan (ESC: cancel)", icon="SORTTIME")


class CT2HAIR_PT_thresholds(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_thresholds"
    bl_label = "Thresholds"
    bl_parent_id = "CT2HAIR_PT_scan"

    def draw(self, context):
        column, chosen = self.column(), context.scene.ct2hair.settings.scan
        inspection = look.inspection_of(context)
        if inspection is not None:
            column.template_icon(icon_value=look.histogram_icon(context), scale=PICTURE)
            if inspection.thresholds is None:
                for number, line in enumerate(_wrapped(inspection.problem)):
                    column.label(text=line, icon="ERROR" if number == 0 else "BLANK1")
        names = ("air", "hair", "knots", "solid")
        for name in names:
            found = getattr(inspection.thresholds, name, None) if inspection is not None else None
            label = name.capitalize()
            if not getattr(chosen, name) and found is not None:
                label += f" ({found:.0f})" if abs(found) >= 100 else f" ({found:.3g})"
            column.prop(chosen, name, text=label)
        row = column.row(align=True)
        row.operator("ct2hair.thresholds", text="Change by Hand")
        row.operator("ct2hair.thresholds", text="Automatic").automatic = True


class CT2HAIR_PT_slices(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_slices"
    bl_label = "Slices"
    bl_parent_id = "CT2HAIR_PT_scan"

    def draw(self, context):
        properties, column = context.scene.ct2hair, self.column()
        inspection = look.inspection_of(context)
        if inspection is None:
            column.label(text="Look at the scan to see slices of it", icon="INFO")
            return
        row = column.row(align=True)
        row.prop(properties, "slice_axis", expand=True)
        column.prop(properties, "slice_at", slider=True)
        column.template_icon(icon_value=look.slice_icon(context), scale=PICTURE)
        size = " × ".join(f"{n * s / 10:.1f}" for n, s in zip(inspection.shape, inspection.spacing, strict=True))
        column.label(text=f"{' × '.join(map(str, inspection.shape))} voxels")
        column.label(text=f"{size} cm")


class CT2HAIR_PT_cloud(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_cloud"
    bl_label = "Cloud"
    bl_parent_id = "CT2HAIR_PT_scan"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        column = self.column()
        row = column.row(align=True)
        row.prop(context.scene.ct2hair, "density")
        row.operator("ct2hair.density_colours", text="", icon="CHECKMARK")
        material = cloud_material(context)
        window = material.node_tree.nodes.get("Window") if material is not None else None
        if window is not None:
            column.prop(window.inputs["From Min"], "default_value", text="Clear below")
            column.prop(window.inputs["From Max"], "default_value", text="Thickest from")


class CT2HAIR_PT_head(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_head"
    bl_label = "Head"
    bl_order = 1

    def draw(self, context):
        properties = context.scene.ct2hair
        head, column = properties.settings.head, self.column()
        column.prop(properties, "head")
        row = column.row(align=True)
        row.operator("ct2hair.scalp_from_selection", icon="GROUP_VERTEX")
        row.operator("ct2hair.paint_scalp", icon="BRUSH_DATA")
        column.separator()
        if head.place:
            column.label(text="Placed by hand, to be refined", icon="CHECKMARK")
            column.operator("ct2hair.forget_place", icon="X")
        else:
            column.prop(head, "face")
            column.prop(head, "up")
            column.operator("ct2hair.place_head", icon="ORIENTATION_LOCAL")
            row = column.row(align=True)
            row.operator("ct2hair.add_landmarks", icon="EMPTY_AXIS")
            row.operator("ct2hair.fit_landmarks", icon="SNAP_ON")
            column.operator("ct2hair.use_place", icon="CHECKMARK")
        column.prop(head, "net_clearance")


class CT2HAIR_PT_reconstruct(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_reconstruct"
    bl_label = "Reconstruct"
    bl_order = 2

    def draw(self, context):
        properties = context.scene.ct2hair
        settings = properties.settings
        column = self.column()
        column.prop(properties, "preset")
        row = column.row(align=True)
        row.menu("CT2HAIR_MT_presets", text="Your Presets")
        row.operator("ct2hair.preset_add", text="", icon="ADD")
        row.operator("ct2hair.preset_add", text="", icon="REMOVE").remove_active = True
        row.operator("ct2hair.settings_load", text="", icon="FILE_FOLDER")
        row.operator("ct2hair.settings_save", text="", icon="FILE_TICK")
        column.prop(settings.interpolation, "strands")
        column.prop(settings.run, "seed")
        column.prop(properties, "folder")
        cost = look.cost(context)
        if cost is not None:
            column.label(text=f"About {max(cost[0], 1):.0f} min, {cost[1]:.1f} GB", icon="TIME")
        column = self.column()
        if properties.unfinished and current.job is None:
            box = column.box()
            box.label(text="This file has an unfinished job", icon="SORTTIME")
            row = box.row(align=True)
            row.operator("ct2hair.resume", icon="PLAY")
            row.operator("ct2hair.resume", text="Forget It", icon="X").discard = True
        if current.job is not None:
            self._draw_progress(column)
        row = column.row()
        row.scale_y = 1.4
        waits = current.job is not None
        row.operator("ct2hair.reconstruct", text="Add to the Line" if waits else "Reconstruct Hair", icon="OUTLINER_OB_CURVES")
        for number, request in enumerate(current.waiting):
            row = column.row(align=True)
            row.label(text=f"{number + 1}. {request.scan.name}", icon="PREVIEW_RANGE")
            row.operator("ct2hair.unqueue", text="", icon="X").index = number
        if current.job is None:
            self._draw_outcome(column)

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


class CT2HAIR_PT_stages(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_stages"
    bl_label = "Stages"
    bl_parent_id = "CT2HAIR_PT_reconstruct"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        column = self.column()
        for stage, label in STAGE_NAMES.items():
            row = column.row()
            row.label(text=label, icon=STATES[current.stages.get(stage, "")])
            if stage != "refinement":
                row.operator("ct2hair.reconstruct", text="Run up to here", icon="PLAY").until = stage


class CT2HAIR_PT_parameters(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_parameters"
    bl_label = "All Parameters"
    bl_parent_id = "CT2HAIR_PT_reconstruct"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
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
    bl_order = 3

    def draw(self, context):
        column = self.column()
        result = scene.active_result(context)
        column.operator("ct2hair.load_result", icon="FILE_FOLDER")
        if result is None:
            column.label(text="No result in the scene", icon="INFO")
            return
        column.label(text=result.collection.name, icon="OUTLINER_OB_CURVES")
        column.label(text=f"{len(result.hair.data.curves):,} strands")
        row = column.row(align=True)
        for what, label, _ in WHAT:
            row.operator("ct2hair.show", text=label).what = what
        self._draw_scores(column, result)

    @staticmethod
    def _draw_scores(column, result):
        report = result.report
        for size, score in report.get("scores", {}).get("after", {}).items():
            text = f"Overlap at {size} mm: {score['iou']:.0%}"
            column.label(text=text, icon="BLANK1")
        support = report.get("hair", {}).get("mean_support")
        if support is not None:
            column.label(text=f"Backed by the scan: {support:.0%}", icon="BLANK1")
        page = result.folder / "report.html"
        if page.is_file():
            column.operator("wm.path_open", text="Open Report", icon="URL").filepath = str(page)


class _OfResult(_Sidebar):
    """Panels that have nothing to show without a result."""

    @classmethod
    def poll(cls, context):
        return scene.active_result(context) is not None


class CT2HAIR_PT_material(_OfResult, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_material"
    bl_label = "Hair Material"
    bl_parent_id = "CT2HAIR_PT_result"

    def draw(self, context):
        column, result = self.column(), scene.active_result(context)
        row = column.row(align=True)
        row.prop(context.scene.ct2hair, "colour")
        row.operator("ct2hair.hair_colour", text="", icon="CHECKMARK")
        material = result.hair.active_material
        shader = material.node_tree.nodes.get("Hair") if material is not None and material.node_tree is not None else None
        if shader is not None:
            for name in ("Melanin", "Melanin Redness", "Tint", "Roughness", "Random Color"):
                column.prop(shader.inputs[name], "default_value", text=name)
        row = column.row(align=True)
        row.operator("ct2hair.full_width", icon="STRANDS").on = True
        row.operator("ct2hair.full_width", text="True Widths").on = False


class CT2HAIR_PT_regions(_OfResult, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_regions"
    bl_label = "Regions"
    bl_parent_id = "CT2HAIR_PT_result"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        properties = context.scene.ct2hair
        column, measured = self.column(), scene.measured_regions(scene.active_result(context))
        column.operator("ct2hair.measure", icon="DRIVER_DISTANCE")
        for name, measure in measured.items():
            column.label(
                text=f"{REGIONS.get(name, 'All')}: {measure.strands:,} · {measure.density:.0f}/cm² · {measure.length:.0f} mm"
            )
        column.separator()
        column.prop(properties, "region")
        row = column.row(align=True)
        row.prop(properties, "trim_length")
        trim = row.operator("ct2hair.trim", text="", icon="CHECKMARK")
        trim.region, trim.length = properties.region, properties.trim_length
        row = column.row(align=True)
        row.prop(properties, "regrow_seed")
        regrow = row.operator("ct2hair.regrow", text="", icon="CHECKMARK")
        regrow.region, regrow.seed = properties.region, properties.regrow_seed


class CT2HAIR_PT_simulate(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_simulate"
    bl_label = "Simulate"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        column, group = self.column(), context.scene.ct2hair.simulation
        for name in CT2HAIR_PG_simulation.__annotations__:
            column.prop(group, name)
        row = column.row(align=True)
        row.prop(context.scene, "frame_start", text="Frames")
        row.prop(context.scene, "frame_end", text="")
        column.operator("ct2hair.simulate", icon="PLAY")
        result = scene.active_result(context)
        frames = scene.simulated_frames(result) if result is not None else None
        if frames is not None:
            column.label(text=f"Simulated, frames {frames[0]} to {frames[1]}", icon="CHECKMARK")
            column.operator("ct2hair.clear_simulation", icon="X")


class CT2HAIR_PT_export(_Sidebar, bpy.types.Panel):
    bl_idname = "CT2HAIR_PT_export"
    bl_label = "Export"
    bl_order = 5

    def draw(self, context):
        column = self.column()
        column.operator("ct2hair.export", icon="EXPORT")
        column.operator("ct2hair.render", icon="RENDER_STILL")
        column.operator("ct2hair.turntable", icon="RENDER_ANIMATION")
        column.operator("ct2hair.import_hair", icon="IMPORT")
        if preferences(context) is not None:
            shown = column.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES")
            shown.module = type(preferences(context)).bl_idname


def _wrapped(text: str, width: int = 46) -> list[str]:
    """Text in lines that fit the sidebar."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


CLASSES = (
    CT2HAIR_PT_scan,
    CT2HAIR_PT_thresholds,
    CT2HAIR_PT_slices,
    CT2HAIR_PT_cloud,
    CT2HAIR_PT_head,
    CT2HAIR_PT_reconstruct,
    CT2HAIR_PT_stages,
    CT2HAIR_PT_parameters,
    CT2HAIR_PT_result,
    CT2HAIR_PT_material,
    CT2HAIR_PT_regions,
    CT2HAIR_PT_simulate,
    CT2HAIR_PT_export,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
