"""CT2Hair as a Blender extension: registers the operators and panels."""


def register() -> None:
    from . import operators, panels  # late: they import bpy, and pytest looks at this file without Blender around it

    operators.register()
    panels.register()


def unregister() -> None:
    from . import operators, panels

    panels.unregister()
    operators.unregister()
