"""The operators: thin faces of the scripting API (`ct2hair_addon.scene`) and of the background jobs."""

from . import command, output, properties, reconstruct, scan

_MODULES = (properties, scan, reconstruct, output, command)


def register() -> None:
    for module in _MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        module.unregister()
