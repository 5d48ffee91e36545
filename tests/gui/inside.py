"""Runs inside the Blender under test: a timer that does what the test writes into a folder, and answers beside it.

Each request is a file NUMBER.py of Python; its variable `answer` comes back as NUMBER.json. `state` is kept between them.
"""

import contextlib
import json
import os
import traceback
from pathlib import Path

import bpy

FOLDER = Path(os.environ["CT2HAIR_GUI"])
TICK = 0.02
state = {}


def sidebar():
    """The 3D viewport's sidebar: (window, area, region)."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == "UI")


def serve():
    for request in sorted(FOLDER.glob("*.py")):
        done = request.with_suffix(".json")
        names = {"bpy": bpy, "sidebar": sidebar, "state": state, "answer": None}
        try:
            window = bpy.context.window_manager.windows[0]
            with bpy.context.temp_override(window=window):
                exec(request.read_text(encoding="utf-8"), names)
            said = {"answer": names["answer"]}
        except Exception:
            said = {"error": traceback.format_exc()}
        beside = done.with_suffix(".part")
        beside.write_text(json.dumps(said))
        request.unlink()
        beside.replace(done)
    return TICK


preferences = bpy.context.preferences
preferences.view.show_splash = False
preferences.view.ui_scale = 1.0
with contextlib.suppress(TypeError, AttributeError):
    preferences.view.filebrowser_display_type = "SCREEN"
bpy.app.timers.register(serve, persistent=True)
