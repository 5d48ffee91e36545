"""The extension's preferences: where things are kept, what the worker may use, and which Python runs it."""

import shutil
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..ct2hair_addon import jobs
from ..ct2hair_addon.cache import cache_folder
from ..ct2hair_addon.jobs.worker import LOG_LEVEL
from ..ct2hair_addon.settings import Settings
from .running import current

ROOT = __package__.rpartition(".")[0]
"""The extension's own name, by which Blender keeps its preferences."""
CACHED = ("jobs", "kernels")
"""What of the cache folder is ours: nothing else in a folder of the user's choice is touched."""


class CT2HAIR_preferences(bpy.types.AddonPreferences):
    bl_idname = ROOT

    cache: StringProperty(
        name="Cache folder",
        description="For compiled kernels and the jobs of unsaved files; empty takes the system's cache folder. "
        "A path that begins with // is beside the saved .blend",
        subtype="DIR_PATH",
    )
    beside_blend: BoolProperty(
        name="Jobs beside the .blend",
        description="Jobs of a saved file go to the folder ct2hair beside it; off, into the cache folder",
        default=True,
    )
    threads: IntProperty(
        name="Threads",
        description="Processor threads of the worker, where the scene's own setting is 0; 0 takes all",
        default=0,
        min=0,
        max=1024,
    )
    memory: FloatProperty(
        name="Memory (GB)",
        description="Memory the worker stays under, where the scene's own setting is 0; 0 takes three quarters of the "
        "machine's. Unit: GB",
        default=0.0,
        min=0.0,
        max=4096.0,
    )
    device: EnumProperty(
        name="Device",
        description="What strands are fitted to the scan on; the other stages run on the processor",
        items=[
            ("auto", "Automatic", "A CUDA card where the worker's torch has one, else the processor"),
            ("cpu", "Processor", "Never a card"),
        ],
    )
    python: StringProperty(
        name="Python of the worker",
        description="Another Python with numpy, scipy, numba, scikit-image, torch and openvdb, with CUDA, say; "
        "empty takes Blender's own",
        subtype="FILE_PATH",
    )
    log_level: EnumProperty(
        name="Log",
        description="What the worker writes into its job's log",
        items=[
            ("quiet", "Warnings and errors", "The least"),
            ("normal", "Stages too", "What began when"),
            ("verbose", "All progress too", "For hunting a fault"),
        ],
        default="normal",
    )
    found: StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.prop(self, "cache")
        column.prop(self, "beside_blend")
        column.operator("ct2hair.clear_cache", icon="TRASH")
        column = layout.column()
        column.prop(self, "threads")
        column.prop(self, "memory")
        column.prop(self, "device")
        row = column.row(align=True)
        row.prop(self, "python")
        row.operator("ct2hair.check_python", text="", icon="CHECKMARK")
        if self.found:
            column.label(text=self.found, icon="INFO")
        column.prop(self, "log_level")


def preferences(context=None):
    """The preferences; None where the extension runs without being installed (its tests do)."""
    addon = (context or bpy.context).preferences.addons.get(ROOT)
    return None if addon is None else addon.preferences


def chosen_cache(known) -> Path:
    """The cache folder that the preferences name, or the system's."""
    if known is None or not known.cache:
        return cache_folder()
    return Path(bpy.path.abspath(known.cache))


def worker_options(known) -> dict:
    """What `scene.start_job` needs to know of the preferences: python and environment."""
    if known is None:
        return {}
    environment = {LOG_LEVEL: known.log_level}
    if known.cache:
        environment["CT2HAIR_CACHE"] = str(chosen_cache(known))
    options = {"environment": environment}
    if known.python:
        options["python"] = bpy.path.abspath(known.python)
    return options


def with_machine(settings: Settings, known) -> Settings:
    """The settings with threads, memory and device of the preferences where they leave them open."""
    if known is None:
        return settings
    run = {}
    if not settings.run.threads and known.threads:
        run["run.threads"] = known.threads
    if not settings.run.memory and known.memory:
        run["run.memory"] = known.memory
    if settings.run.device == "auto":
        run["run.device"] = known.device
    return settings.changed(run)


class CT2HAIR_OT_check_python(bpy.types.Operator):
    """Say whether the chosen Python can run the worker: its version, what it lacks, its card. Takes some seconds"""

    bl_idname = "ct2hair.check_python"
    bl_label = "Check Python"

    python: StringProperty(name="Python", description="Empty takes the preferences' one", subtype="FILE_PATH")

    def execute(self, context):
        known = preferences(context)
        python = bpy.path.abspath(self.python or (known.python if known is not None else "")) or None
        bpy.utils.expose_bundled_modules()
        found = jobs.check_python(python)
        if found.problem:
            text = found.problem
        elif found.missing:
            text = f"Python {found.version} lacks {', '.join(found.missing)}: install them there"
        else:
            text = f"Python {found.version} can run the worker, on {found.device}"
        if known is not None:
            known.found = text
        self.report({"INFO"} if found.usable else {"ERROR"}, text)
        return {"FINISHED"} if found.usable else {"CANCELLED"}


class CT2HAIR_OT_clear_cache(bpy.types.Operator):
    """Delete compiled kernels and the jobs of unsaved files from the cache folder. Jobs beside a saved .blend stay"""

    bl_idname = "ct2hair.clear_cache"
    bl_label = "Clear Cache"

    @classmethod
    def poll(cls, context):
        if current.job is not None:
            cls.poll_message_set("A job is running and uses the cache: wait for it, or cancel it")
            return False
        return True

    def invoke(self, context, event):
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, context):
        folder = chosen_cache(preferences(context))
        size = 0
        for name in CACHED:
            path = folder / name
            if path.is_dir():
                size += sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
                shutil.rmtree(path, ignore_errors=True)
        self.report({"INFO"}, f"{size / 1e6:.1f} MB cleared from {folder}")
        return {"FINISHED"}


CLASSES = (CT2HAIR_preferences, CT2HAIR_OT_check_python, CT2HAIR_OT_clear_cache)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
