"""The operators: thin faces of the scripting API (`ct2hair_addon.scene`) and of the background jobs."""

from . import (
    command,
    exchange,
    head,
    look,
    output,
    preferences,
    presets,
    properties,
    reconstruct,
    result,
    scan,
    simulation,
    translations,
)

_MODULES = (
    preferences,
    properties,
    scan,
    look,
    head,
    reconstruct,
    result,
    simulation,
    exchange,
    output,
    presets,
    command,
    translations,
)


def register() -> None:
    for module in _MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        module.unregister()
