"""Operators for the scan: import it as a Volume object."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from .properties import settings_of
from .reporting import reported
from .running import headless

EXTENSIONS = (".vdb", ".npy", ".raw", ".tif", ".tiff", ".nii", ".gz", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")


class CT2HAIR_OT_import_scan(bpy.types.Operator, ImportHelper):
    """Import the CT scan of a wig: a Volume object of the hair alone, without air and mannequin"""

    bl_idname = "ct2hair.import_scan"
    bl_label = "Import CT Scan"
    bl_options = {"REGISTER", "UNDO"}

    filter_glob: StringProperty(default=";".join(f"*{extension}" for extension in EXTENSIONS), options={"HIDDEN"})
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    whole_folder: BoolProperty(
        name="Folder of slices",
        description="The scan is all slices (DICOM or TIFF) in the folder of the chosen file",
        default=False,
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "whole_folder")
        layout.prop(context.scene.ct2hair.settings.scan, "spacing")
        if self.filepath.lower().endswith(".raw"):
            layout.prop(context.scene.ct2hair.settings.scan, "raw_shape")
            layout.prop(context.scene.ct2hair.settings.scan, "raw_type")

    @reported(CT2HairError, OSError)
    def execute(self, context):
        properties = context.scene.ct2hair
        path = Path(bpy.path.abspath(self.filepath or self.directory))
        if path.is_file() and (self.whole_folder or path.suffix.lower() == ".dcm"):
            path = path.parent
        if path.suffix.lower() != ".vdb" and path.exists() and not headless():
            return self._in_background(properties, path)
        window_manager = context.window_manager
        window_manager.progress_begin(0, 100)
        try:
            imported = scene.import_scan(
                path,
                settings_of(properties.settings),
                context=context,
                progress=lambda done, total: window_manager.progress_update(100 * done / total),
            )
        finally:
            window_manager.progress_end()
        properties.scan = str(path)
        for warning in imported.warnings:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, f"Imported {path.name} as '{imported.collection.name}'")
        return {"FINISHED"}

    def _in_background(self, properties, path):
        """Have the worker read it, which takes long: the job's first stage, that a reconstruction then goes on from."""
        if not bpy.ops.ct2hair.reconstruct.poll():
            self.report({"ERROR"}, "Too many jobs wait in line: wait for one of them, or cancel it")
            return {"CANCELLED"}
        properties.scan = str(path)
        outcome = bpy.ops.ct2hair.reconstruct("INVOKE_DEFAULT", scan=str(path), until="scan")
        if "CANCELLED" not in outcome:
            self.report({"INFO"}, f"{path.name} is being read; it appears when it is through (ESC: cancel)")
        return {"CANCELLED"} if "CANCELLED" in outcome else {"FINISHED"}


class CT2HAIR_FH_scan(bpy.types.FileHandler):
    """Scans dropped into the viewport are imported."""

    bl_idname = "CT2HAIR_FH_scan"
    bl_label = "CT scan of a wig"
    bl_import_operator = "ct2hair.import_scan"
    bl_file_extensions = ";".join(extension for extension in EXTENSIONS if extension not in (".gz", ".raw"))

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator(CT2HAIR_OT_import_scan.bl_idname, text="CT Scan of a Wig (CT2Hair)")


CLASSES = (CT2HAIR_OT_import_scan, CT2HAIR_FH_scan)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
