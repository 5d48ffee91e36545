"""The look at a scan: started in the background, its histogram and slices drawn for the panel; thresholds by hand."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import bpy.utils.previews
import numpy as np

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from ..ct2hair_addon.measure import estimated_cost
from ..ct2hair_addon.volume import Inspection
from .preferences import preferences, with_machine, worker_options
from .properties import settings_of
from .reconstruct import INTERVAL, job_folder
from .reporting import reported
from .running import headless, looking, redraw

THRESHOLDS = ("air", "hair", "knots", "solid")


@dataclass
class _Pictures:
    """The last look, and the previews drawn of it; a preview is drawn again when what it shows has changed."""

    inspection: Inspection | None = None
    scan: str = ""
    previews: bpy.utils.previews.ImagePreviewCollection | None = None
    shown: dict[str, tuple] = field(default_factory=dict)

    def clear(self) -> None:
        if self.previews is not None:
            bpy.utils.previews.remove(self.previews)
        self.inspection, self.scan, self.previews, self.shown = None, "", None, {}

    def icon(self, name: str, key: tuple, draw) -> int:
        """The icon of the picture `name`, drawn by `draw()` where `key` is another than when it was drawn last."""
        if self.previews is None:
            self.previews = bpy.utils.previews.new()
        known = self.shown.get(name)
        if known is None or known[0] != key:
            # a new name each time: Blender keeps what it drew of an old one
            title = f"{name} {len(self.shown)} {time.monotonic_ns()}"
            preview = self.previews.new(title)
            picture = draw()
            preview.image_size = picture.shape[1], picture.shape[0]
            preview.image_pixels_float.foreach_set(np.ascontiguousarray(picture, np.float32).ravel())
            if known is not None:
                del self.previews[known[1]]
            self.shown[name] = known = (key, title)
        return self.previews[known[1]].icon_id


_pictures = _Pictures()


def inspection_of(context) -> Inspection | None:
    """The look at the scene's scan; None where it was not looked at."""
    return _pictures.inspection if _pictures.scan == context.scene.ct2hair.scan else None


def histogram_icon(context) -> int:
    """The icon of the scan's histogram with its thresholds."""
    inspection, chosen = _pictures.inspection, settings_of(context.scene.ct2hair.settings).scan
    key = (id(inspection), *(getattr(chosen, name) for name in THRESHOLDS))
    return _pictures.icon("histogram", key, lambda: scene.histogram_picture(inspection, chosen))


def slice_icon(context) -> int:
    """The icon of the slice that the scene asks for."""
    inspection, properties = _pictures.inspection, context.scene.ct2hair
    chosen = settings_of(properties.settings).scan
    axis, at = "xyz".index(properties.slice_axis), round(properties.slice_at, 3)
    key = (id(inspection), axis, at, *(getattr(chosen, name) for name in THRESHOLDS))
    return _pictures.icon("slice", key, lambda: scene.slice_picture(inspection, axis, at, chosen))


def cost(context) -> tuple[float, float] | None:
    """(minutes, GB) that the reconstruction of the scene's scan takes; None where it was not looked at."""
    inspection = inspection_of(context)
    if inspection is None or not inspection.hair_voxels:
        return None
    settings = with_machine(settings_of(context.scene.ct2hair.settings), preferences(context))
    return estimated_cost(inspection.hair_voxels, settings.refinement.iterations, settings.run.threads or os.cpu_count() or 1)


class CT2HAIR_OT_look(bpy.types.Operator):
    """Look at the scan in the background: find the thresholds of air, hair, knots and mannequin, draw histogram and slices,
    estimate time and memory"""

    bl_idname = "ct2hair.look"
    bl_label = "Look at Scan"

    _timer = None

    @classmethod
    def poll(cls, context):
        if not context.scene.ct2hair.scan:
            cls.poll_message_set("No scan is chosen: import one, or set its path in the panel")
            return False
        if looking.process is not None:
            cls.poll_message_set("A look at a scan is under way")
            return False
        return True

    @reported(CT2HairError, OSError)
    def execute(self, context):
        properties = context.scene.ct2hair
        self._scan = properties.scan
        path = Path(bpy.path.abspath(self._scan))
        folder = Path(bpy.path.abspath(properties.folder)) if properties.folder else job_folder(path, context)
        settings = settings_of(properties.settings)
        automatic = settings.changed({f"scan.{name}": 0.0 for name in THRESHOLDS})
        looking.process = scene.start_inspection(path, folder, automatic, **worker_options(preferences(context)))
        looking.folder = folder
        if headless():
            looking.process.wait()
            return self._finish()
        self._timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        redraw()
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if looking.process is None:
            return self._leave(context, {"CANCELLED"})
        if event.type == "ESC" and event.value == "PRESS":
            looking.end()
            return self._leave(context, {"CANCELLED"})
        if event.type != "TIMER" or looking.process.poll() is None:
            return {"PASS_THROUGH"}
        return self._leave(context, self._finish())

    def cancel(self, context):
        looking.end()
        self._leave(context, {"CANCELLED"})

    def _finish(self):
        looking.process = None
        path = looking.folder / "inspection.npz"
        said = (looking.folder / "inspection.txt").read_text(encoding="utf-8").strip().splitlines()
        try:
            if not path.is_file():
                raise CT2HairError(said[-1].removeprefix("ct2hair: error: ") if said else "the look ended without a word")
            _pictures.clear()
            _pictures.inspection, _pictures.scan = Inspection.load(path), self._scan
        except CT2HairError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            redraw()
        found = _pictures.inspection
        if found.thresholds is None:
            self.report({"WARNING"}, found.problem)
        else:
            self.report(
                {"INFO"}, f"About {found.hair_voxels / 1e6:.1f} million voxels of hair. Next: check the head, reconstruct"
            )
        return {"FINISHED"}

    def _leave(self, context, outcome):
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        redraw()
        return outcome


class CT2HAIR_OT_thresholds(bpy.types.Operator):
    """Overrule all thresholds by the values that were found, to change them from there; or find them automatically again"""

    bl_idname = "ct2hair.thresholds"
    bl_label = "Set Thresholds"
    bl_options = {"REGISTER", "UNDO"}

    automatic: bpy.props.BoolProperty(
        name="Automatic", description="Find the thresholds anew in each scan", default=False, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context):
        inspection = inspection_of(context)
        if inspection is None or inspection.thresholds is None:
            cls.poll_message_set("No thresholds were found: look at the scan first")
            return False
        return True

    def execute(self, context):
        chosen, found = context.scene.ct2hair.settings.scan, inspection_of(context).thresholds
        for name in THRESHOLDS:
            setattr(chosen, name, 0.0 if self.automatic else float(getattr(found, name) or 0.0))
        redraw()
        return {"FINISHED"}


CLASSES = (CT2HAIR_OT_look, CT2HAIR_OT_thresholds)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    looking.end()
    _pictures.clear()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
