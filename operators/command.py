"""`blender --command ct2hair ...`: the command line in Blender's own environment."""

import bpy

_handle = None


def run(arguments: list[str]) -> int:
    """Run one command of the command line; returns the exit code."""
    from ..ct2hair_addon.cli import main  # late: it is wanted once in a blue moon, and Blender starts quicker without
    from ..ct2hair_addon.groom import add_groom

    try:
        return main(arguments, [add_groom])
    except SystemExit as stop:  # argparse leaves this way after --help or wrong usage
        return stop.code if isinstance(stop.code, int) else 2


def register() -> None:
    global _handle
    _handle = bpy.utils.register_cli_command("ct2hair", run)


def unregister() -> None:
    bpy.utils.unregister_cli_command(_handle)
