"""The sidebar tab 'CT2Hair' in the order of the work: layout only."""

from . import sidebar


def register() -> None:
    sidebar.register()


def unregister() -> None:
    sidebar.unregister()
