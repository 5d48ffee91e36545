"""Operators for hair in motion: simulate, and take the simulation away."""

import bpy

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from .output import OfResult
from .properties import simulation_settings_of
from .reporting import reported


class CT2HAIR_OT_simulate(OfResult, bpy.types.Operator):
    """Simulate the guides over the scene's frame range and let all hair follow them, kept out of the head, roots in place.
    Replaces the simulation that was there"""

    bl_idname = "ct2hair.simulate"
    bl_label = "Simulate Hair"
    bl_options = {"REGISTER", "UNDO"}

    cache: bpy.props.StringProperty(
        name="Cache", description="File that the motion is kept in; empty takes the job's folder", subtype="FILE_PATH"
    )

    @reported(CT2HairError, OSError)
    def execute(self, context):
        owner = context.scene
        result = scene.active_result(context)
        known = simulation_settings_of(owner.ct2hair.simulation)
        cache = bpy.path.abspath(self.cache) if self.cache else None
        window_manager = context.window_manager
        window_manager.progress_begin(0, 100)
        try:
            done = scene.simulate(
                result,
                known,
                frames=(owner.frame_start, owner.frame_end),
                cache=cache,
                progress=lambda done, total: window_manager.progress_update(100 * done / total),
            )
        finally:
            window_manager.progress_end()
        self.report(
            {"INFO"},
            f"Simulated {done.guides} guides, frames {done.frames[0]} to {done.frames[1]}: tips moved {done.tip:.0f} mm, "
            f"{done.inside:.1%} of the points in the head. Play it, or export it animated",
        )
        return {"FINISHED"}


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
