"""How stages report progress: one callable, `progress(done, total)`, that may raise `Cancelled` to stop the work."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Progress = Callable[[float, float], None]
"""Called often (several times a second in long work) with the work done and the whole, in any unit. It may raise
`ct2hair_addon.errors.Cancelled`; a stage lets that pass and leaves nothing half-written behind."""

Item = TypeVar("Item")


def silent(done: float, total: float) -> None:
    """Report to nobody: the default `progress` of every stage."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Map the whole of a sub-step onto the share [start, end] (0 to 1) of `progress`."""

    def report(done: float, total: float) -> None:
        progress(start + (end - start) * done / max(total, 1e-12), 1.0)

    return report


def tracked(items: Iterable[Item], total: int, progress: Progress) -> Iterator[Item]:
    """Yield `items`, reporting after each one."""
    progress(0, total)
    for done, item in enumerate(items, start=1):
        yield item
        progress(done, total)
