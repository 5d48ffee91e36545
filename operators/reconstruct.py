"""Operators for the job: reconstruct in the background, wait in line, resume, cancel, load a result."""

import time
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import Cancelled, CT2HairError
from ..ct2hair_addon.jobs import JobFolder
from ..ct2hair_addon.scene import HAIR_COLOURS
from ..ct2hair_addon.settings import STOPS
from .preferences import chosen_cache, preferences, with_machine, worker_options
from .properties import set_settings, settings_of
from .reporting import reported
from .running import Request, current, headless, redraw, time_left

LINE = 8
"""Jobs that may wait."""
STAGE_NAMES = {
    "scan": "Scan",
    "head": "Head",
    "orientation": "Orientation",
    "guides": "Guides",
    "dense": "Dense hair",
    "refinement": "Refinement",
    "result": "Result",
}
"""The pipeline's stages, as the panel calls them."""
INTERVAL = 0.15
"""Seconds between two looks at the worker's messages."""


class CT2HAIR_OT_reconstruct(bpy.types.Operator):
    """Reconstruct the hair of the scan in a background process; the result arrives as a new collection. While one job runs,
    the next waits in line"""

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
    until: EnumProperty(
        name="Until",
        description="The stage to stop after, to look at what there is; the next start goes on from there",
        items=[("result", "Result", "All stages")] + [(stage, STAGE_NAMES[stage], "Stop after this stage") for stage in STOPS],
        default="result",
        options={"SKIP_SAVE"},
    )

    _timer = None

    @classmethod
    def description(cls, context, properties):
        if properties.until == "result":
            return cls.__doc__
        return f"Run all stages up to '{STAGE_NAMES[properties.until]}', show what there is, and go on from there next time"

    @classmethod
    def poll(cls, context):
        if len(current.waiting) >= LINE:
            cls.poll_message_set(f"A job runs and {LINE} wait in line: wait for one of them, or cancel it")
            return False
        return True

    def execute(self, context):
        properties = context.scene.ct2hair
        scan = self.scan or properties.scan
        if not scan:
            self.report({"ERROR"}, "No scan is chosen: import one, or set its path in the panel")
            return {"CANCELLED"}
        path = Path(bpy.path.abspath(scan))
        chosen = self.folder or properties.folder
        folder = Path(bpy.path.abspath(chosen)) if chosen else job_folder(path, context)
        try:
            if current.job is not None:
                _check_line(folder)
                current.waiting.append(_request(context, path, folder, self.until))
                self.report({"INFO"}, f"{path.name} waits in line: it starts when the running job is through")
                redraw()
                return {"FINISHED"}
            _start(_request(context, path, folder, self.until))
        except (CT2HairError, OSError) as error:
            if current.job is None:
                current.end(str(error), failed=True)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
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
            current.heard()
            context.workspace.status_text_set(
                f"CT2Hair: {job.text} {job.fraction:.0%} {time_left(job.remaining)}   ESC: cancel"
            )
            redraw()
        if job.running:
            return {"PASS_THROUGH"}
        outcome = self._finish(context)
        while current.waiting:
            try:
                _start(current.waiting.pop(0))
            except (CT2HairError, OSError) as error:
                current.end(str(error), failed=True)
                self.report({"ERROR"}, str(error))
                continue
            redraw()
            return {"PASS_THROUGH"}
        return self._leave(context, outcome)

    def cancel(self, context):
        """Blender ends the operator: the file or the window closes, and the worker goes with it."""
        current.end_all("ended with the file; start again to go on from the last finished stage")
        self._leave(context, {"CANCELLED"})

    def _wait(self, context):
        """Without a window: block until the job is through, saying how far it is."""
        told = -1
        job = current.job
        try:
            while job.running:
                for message in job.poll():
                    current.heard()
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
        job, request = current.job, current.request
        job.poll()
        try:
            scene.check_job(job)
            if request.until is None:
                result = scene.load_result(request.folder, colour=request.colour, context=context)
                said = f"Reconstructed {len(result.hair.data.curves)} strands: '{result.collection.name}'"
            else:
                collection = scene.load_stage(request.folder, colour=request.colour, context=context)
                said = f"'{collection.name}' shows the stage {STAGE_NAMES[request.until]}: look at it, then go on"
        except Cancelled as stopped:
            current.end(str(stopped), failed=False)
            self.report({"WARNING"}, f"Reconstruction {stopped}")
            return {"CANCELLED"}
        except (CT2HairError, OSError) as error:
            current.end(str(error), failed=True)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        _hide_scan(request.scan, context)
        if request.until is not None:
            collection["ct2hair_scan"] = str(request.scan.resolve())  # to be hidden when more is known
        for warning in job.warnings:
            self.report({"WARNING"}, warning)
        _forget_unfinished(request)
        current.end(said, failed=False)
        self.report({"INFO"}, said)
        return {"FINISHED"}

    def _leave(self, context, outcome):
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        redraw()
        return outcome


def job_folder(scan: Path, context) -> Path:
    """Where a job for `scan` goes unless the scene names a folder: beside the .blend, or into the cache folder."""
    known = preferences(context)
    if known is None or (known.beside_blend and bpy.data.filepath):
        return scene.default_folder(scan)
    return chosen_cache(known) / "jobs" / scene.scan_name(scan)


def _check_line(folder: Path) -> None:
    """Refuse a folder that the running job or a waiting one writes to."""
    taken = [current.folder, *(request.folder for request in current.waiting)]
    if folder.resolve() in [other.resolve() for other in taken if other is not None]:
        raise CT2HairError(f"a job for {folder} is running or waits already; choose another folder in the panel")


def _request(context, scan: Path, folder: Path, until: str) -> Request:
    """All that the job needs of the scene as it is now. Raises CT2HairError for what would fail at once."""
    properties, known = context.scene.ct2hair, preferences()
    if not scan.exists():
        raise CT2HairError(f"{scan}: there is no such file; choose the scan again")
    settings = with_machine(settings_of(properties.settings), known)
    if properties.head is not None:
        template = scene.save_head(properties.head, folder / "template.obj", local=bool(settings.head.place))
        settings = settings.changed({"head.mesh": str(template.resolve())})
    stop = None if until == "result" else until
    return Request(scan, folder, settings, properties.colour, stop, context.scene.name, worker_options(known))


def _start(request: Request) -> None:
    """Start a job, and note in its scene that it is under way: a file that is saved now offers to resume it."""
    job = scene.start_job(request.scan, request.folder, request.settings, until=request.until, **request.options)
    current.begin(job, request.folder, request)
    owner = bpy.data.scenes.get(request.scene)
    if owner is not None:
        owner.ct2hair.unfinished = str(request.folder.resolve())


def _forget_unfinished(request: Request) -> None:
    owner = bpy.data.scenes.get(request.scene)
    if owner is not None and owner.ct2hair.unfinished == str(request.folder.resolve()):
        owner.ct2hair.unfinished = ""


class CT2HAIR_OT_resume(bpy.types.Operator):
    """Go on with the job that this file was saved in the middle of, from its last finished stage"""

    bl_idname = "ct2hair.resume"
    bl_label = "Resume Job"
    bl_options = {"UNDO"}

    discard: BoolProperty(
        name="Forget it", description="Don't go on; the finished stages stay in the job's folder", options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context):
        if not context.scene.ct2hair.unfinished:
            cls.poll_message_set("This file has no unfinished job")
            return False
        if current.job is not None:
            cls.poll_message_set("A job is running: wait for it, or cancel it")
            return False
        return True

    @reported(CT2HairError)
    def execute(self, context):
        properties = context.scene.ct2hair
        if self.discard:
            properties.unfinished = ""
            return {"FINISHED"}
        scan, out, settings, _, _, until = JobFolder(Path(properties.unfinished) / "job").read()
        properties.scan, properties.folder = str(scan), str(out)
        set_settings(properties.settings, settings)
        return bpy.ops.ct2hair.reconstruct("EXEC_DEFAULT" if headless() else "INVOKE_DEFAULT", until=until or "result")


class CT2HAIR_OT_unqueue(bpy.types.Operator):
    """Take a waiting job out of the line"""

    bl_idname = "ct2hair.unqueue"
    bl_label = "Remove from Line"

    index: IntProperty(name="Place", description="Place in the line, from 0", min=0)

    @classmethod
    def poll(cls, context):
        if not current.waiting:
            cls.poll_message_set("No job waits in line")
            return False
        return True

    def execute(self, context):
        if self.index >= len(current.waiting):
            self.report({"ERROR"}, f"Only {len(current.waiting)} jobs wait in line")
            return {"CANCELLED"}
        gone = current.waiting.pop(self.index)
        self.report({"INFO"}, f"{gone.scan.name} is out of the line")
        redraw()
        return {"FINISHED"}


@bpy.app.handlers.persistent
def _before_loading(*_) -> None:
    """Another file is about to open: the worker ends with this one."""
    if current.job is not None or current.waiting:
        current.end_all("ended with the file; open it again to go on from the last finished stage")


@bpy.app.handlers.persistent
def _after_loading(*_) -> None:
    """Tell of a job that the file was saved in the middle of; the panel offers to resume it."""
    for owner in bpy.data.scenes:
        if owner.ct2hair.unfinished:
            print(f"CT2Hair: '{owner.name}' has an unfinished job in {owner.ct2hair.unfinished}; the sidebar can resume it")
            if not headless():
                bpy.app.timers.register(_offer_to_resume, first_interval=1.0)


def _offer_to_resume() -> None:
    def draw(self, context):
        self.layout.operator_context = "INVOKE_DEFAULT"
        self.layout.label(text=bpy.context.scene.ct2hair.unfinished)
        self.layout.operator("ct2hair.resume", icon="PLAY")
        self.layout.operator("ct2hair.resume", text="Forget It", icon="X").discard = True

    if bpy.context.window is not None and bpy.context.scene.ct2hair.unfinished:
        bpy.context.window_manager.popup_menu(draw, title="CT2Hair: this file has an unfinished job", icon="SORTTIME")


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

    @reported(CT2HairError, OSError)
    def execute(self, context):
        folder = Path(bpy.path.abspath(self.directory))
        result = scene.load_result(folder, colour=self.colour, diameter=self.diameter, context=context)
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


CLASSES = (CT2HAIR_OT_reconstruct, CT2HAIR_OT_resume, CT2HAIR_OT_unqueue, CT2HAIR_OT_cancel, CT2HAIR_OT_load_result)
_HANDLERS = ((bpy.app.handlers.load_pre, _before_loading), (bpy.app.handlers.load_post, _after_loading))


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for handlers, handler in _HANDLERS:
        handlers.append(handler)


def unregister() -> None:
    if current.job is not None:
        current.end_all("ended: the extension was switched off")
    for handlers, handler in _HANDLERS:
        handlers.remove(handler)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
