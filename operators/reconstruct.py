"""Operators for the job: reconstruct in the background, cancel, load a result."""

import time
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import Cancelled, CT2HairError
from ..ct2hair_addon.scene import HAIR_COLOURS
from .properties import settings_of
from .running import current, headless, redraw, time_left

INTERVAL = 0.15
"""Seconds between two looks at the worker's messages."""


class CT2HAIR_OT_reconstruct(bpy.types.Operator):
    """Reconstruct the hair of the scan in a background process; the result arrives as a new collection"""

    bl_idname = "ct2hair.reconstruct"
    bl_label = "Reconstruct Hair"
    bl_options = {"UNDO"}  # not REGISTER: a change in the redo panel would run the whole job again

    scan: StringProperty(
        name="Scan", description="The CT scan; empty takes the scene's", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    folder: StringProperty(
        name="Folder",
        description="Where the result is written; empty takes the scene's",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )

    _timer = None

    @classmethod
    def poll(cls, context):
        if current.job is not None:
            cls.poll_message_set("A reconstruction is running: wait for it, or cancel it")
            return False
        return True

    def execute(self, context):
        properties = context.scene.ct2hair
        scan = self.scan or properties.scan
        if not scan:
            self.report({"ERROR"}, "No scan is chosen: import one, or set its path in the panel")
            return {"CANCELLED"}
        self._scan = Path(bpy.path.abspath(scan))
        chosen = self.folder or properties.folder
        self._folder = Path(bpy.path.abspath(chosen)) if chosen else scene.default_folder(self._scan)
        self._colour = properties.colour
        try:
            job = scene.start_job(self._scan, self._folder, settings_of(properties.settings), head=properties.head)
        except (CT2HairError, OSError) as error:
            current.end(str(error), failed=True)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        current.begin(job, self._folder)
        if headless():
            return self._wait(context)
        self._timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        job = current.job
        if job is None:
            return self._leave(context, {"CANCELLED"})
        if event.type == "ESC" and event.value == "PRESS":
            job.cancel()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if job.poll():
            context.workspace.status_text_set(
                f"CT2Hair: {job.text} {job.fraction:.0%} {time_left(job.remaining)}   ESC: cancel"
            )
            redraw()
        if job.running:
            return {"PASS_THROUGH"}
        return self._leave(context, self._finish(context))

    def cancel(self, context):
        """Blender ends the operator: the file or the window closes, and the worker goes with it."""
        current.end("ended with the file; start again to go on from the last finished stage", failed=False)
        self._leave(context, {"CANCELLED"})

    def _wait(self, context):
        """Without a window: block until the job is through, saying how far it is."""
        told = -1
        job = current.job
        try:
            while job.running:
                for message in job.poll():
                    if message.kind == "status":
                        print(f"CT2Hair: {job.text}")
                if int(10 * job.fraction) > told:
                    told = int(10 * job.fraction)
                    print(f"CT2Hair: {job.fraction:.0%} {time_left(job.remaining)}")
                time.sleep(INTERVAL)
        except BaseException:
            current.end("interrupted", failed=True)
            raise
        return self._finish(context)

    def _finish(self, context):
        """Load what the job made, or say why there is nothing; the scene is untouched then."""
        job = current.job
        job.poll()
        try:
            scene.check_job(job)
            result = scene.load_result(self._folder, colour=self._colour, context=context)
        except Cancelled as stopped:
            current.end(str(stopped), failed=False)
            self.report({"WARNING"}, f"Reconstruction {stopped}")
            return {"CANCELLED"}
        except (CT2HairError, OSError) as error:
            current.end(str(error), failed=True)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        _hide_scan(self._scan, context)
        for warning in job.warnings:
            self.report({"WARNING"}, warning)
        count = len(result.hair.data.curves)
        current.end(f"{count} strands in '{result.collection.name}'", failed=False)
        self.report({"INFO"}, f"Reconstructed {count} strands: '{result.collection.name}'")
        return {"FINISHED"}

    def _leave(self, context, outcome):
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        redraw()
        return outcome


class CT2HAIR_OT_cancel(bpy.types.Operator):
    """Stop the reconstruction; finished stages are kept, and the next start goes on from them"""

    bl_idname = "ct2hair.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        if current.job is None:
            cls.poll_message_set("No reconstruction is running")
            return False
        return True

    def execute(self, context):
        current.job.cancel()
        return {"FINISHED"}


class CT2HAIR_OT_load_result(bpy.types.Operator):
    """Load the result of a finished job from its folder, as a new collection with head, hair, guides and scan"""

    bl_idname = "ct2hair.load_result"
    bl_label = "Load Result"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(name="Folder", description="The job's folder, with hair.npz and report.json", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})
    colour: EnumProperty(
        name="Hair colour",
        description="Pigment of the hair's material",
        items=[(name, colour.label, "") for name, colour in HAIR_COLOURS.items()],
        default="brown",
    )
    diameter: FloatProperty(
        name="Strand diameter (mm)",
        description="Mean diameter of the strands. Unit: mm",
        default=0.075,
        min=0.04,
        max=0.12,
        precision=3,
    )

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        folder = Path(bpy.path.abspath(self.directory))
        try:
            result = scene.load_result(folder, colour=self.colour, diameter=self.diameter, context=context)
        except (CT2HairError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for reason, count in result.tally.items():
            self.report({"INFO"}, f"{count} strands {reason}")
        self.report({"INFO"}, f"Loaded {len(result.hair.data.curves)} strands: '{result.collection.name}'")
        return {"FINISHED"}


def _hide_scan(path: Path, context) -> None:
    """Hide the cloud that the scan was imported as: the result brings its own, where the head is now known to be."""
    for collection in scene.results("scan"):
        if Path(collection.get("ct2hair_scan", "")) == path.resolve():
            for ob in collection.all_objects:
                if ob.type == "VOLUME" and ob.name in context.view_layer.objects:
                    ob.hide_set(True, view_layer=context.view_layer)


CLASSES = (CT2HAIR_OT_reconstruct, CT2HAIR_OT_cancel, CT2HAIR_OT_load_result)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    if current.job is not None:
        current.end("ended: the extension was switched off", failed=False)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
