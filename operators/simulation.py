"""Operators for hair in motion: simulate, and take the simulation away."""

import time
from concurrent.futures import ThreadPoolExecutor

import bpy

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from .output import OfResult
from .properties import simulation_settings_of
from .reporting import reported
from .running import headless, redraw, time_left

TICK = 0.02
"""Seconds between two looks at whether a step's work is done."""
NAVIGATION = {
    "MIDDLEMOUSE",
    "WHEELUPMOUSE",
    "WHEELDOWNMOUSE",
    "MOUSEMOVE",
    "INBETWEEN_MOUSEMOVE",
    "TRACKPADPAN",
    "TRACKPADZOOM",
}


class CT2HAIR_OT_simulate(OfResult, bpy.types.Operator):
    """Simulate the guides over the scene's frame range and let all hair follow them, kept out of the head, roots in place.
    Replaces the simulation that was there"""

    bl_idname = "ct2hair.simulate"
    bl_label = "Simulate Hair"
    bl_options = {"REGISTER", "UNDO"}

    cache: bpy.props.StringProperty(
        name="Cache", description="File that the motion is kept in; empty takes the job's folder", subtype="FILE_PATH"
    )

    _steps = _work = _timer = None

    @reported(CT2HairError, OSError)
    def execute(self, context):
        owner = context.scene
        cache = bpy.path.abspath(self.cache) if self.cache else None
        known = simulation_settings_of(owner.ct2hair.simulation)
        result, frames = scene.active_result(context), (owner.frame_start, owner.frame_end)
        if headless():
            return self._say(scene.simulate(result, known, frames=frames, cache=cache))
        self._steps = scene.simulation_steps(result, known, frames=frames, cache=cache)
        self._share, work = next(self._steps)
        self._begun, self._stopping = time.monotonic(), False
        self._threads = ThreadPoolExecutor(1)
        self._work = self._threads.submit(work)
        self._timer = context.window_manager.event_timer_add(TICK, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Between events a thread does the work of a step; it knows no Blender. Only the view can be moved meanwhile."""
        if event.type in NAVIGATION:
            return {"PASS_THROUGH"}
        if event.type == "ESC" and event.value == "PRESS":
            self._stopping = True  # the thread's step is short
        if event.type != "TIMER" or not self._work.done():
            return {"RUNNING_MODAL"}
        if self._stopping:
            self.report({"WARNING"}, "Simulation cancelled: the hair is as it was")
            return self._leave(context, {"CANCELLED"})
        try:
            outcome = self._go_on(context)
        except BaseException:  # a fault of ours leaves no timer and no half-done simulation either
            self._leave(context, {"CANCELLED"})
            raise
        return outcome if outcome == {"RUNNING_MODAL"} else self._leave(context, outcome)

    @reported(CT2HairError, OSError)
    def _go_on(self, context):
        """Take what the thread has worked out, and give it the next step."""
        try:
            self._share, work = self._steps.send(self._work.result())
        except StopIteration as end:
            return self._say(end.value)
        self._work = self._threads.submit(work)
        spent = time.monotonic() - self._begun
        left = time_left(spent / self._share - spent if self._share > 0.05 else None)
        context.workspace.status_text_set(f"CT2Hair: simulating {self._share:.0%} {left}   ESC: cancel")
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Blender ends the operator: the file or the window closes."""
        self._leave(context, {"CANCELLED"})

    def _say(self, done):
        self.report(
            {"INFO"},
            f"Simulated {done.guides} guides, frames {done.frames[0]} to {done.frames[1]}: tips moved {done.tip:.0f} mm, "
            f"{done.inside:.1%} of the points in the head. Play it, or export it animated",
        )
        return {"FINISHED"}

    def _leave(self, context, outcome):
        self._threads.shutdown(wait=True)
        self._steps.close()
        context.window_manager.event_timer_remove(self._timer)
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        redraw()
        return outcome


class CT2HAIR_OT_clear_simulation(OfResult, bpy.types.Operator):
    """Take the simulation off the hair: it stands as it was reconstructed. The cache file stays"""

    bl_idname = "ct2hair.clear_simulation"
    bl_label = "Remove Simulation"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if scene.simulated_frames(scene.active_result(context)) is None:
            cls.poll_message_set("The hair is not simulated")
            return False
        return True

    def execute(self, context):
        scene.clear_simulation(scene.active_result(context))
        return {"FINISHED"}


CLASSES = (CT2HAIR_OT_simulate, CT2HAIR_OT_clear_simulation)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
