"""How operators tell of errors."""

from __future__ import annotations

import functools
from collections.abc import Callable


def reported(*kinds: type[Exception]) -> Callable:
    """For an operator's `execute`: errors of these kinds are reported in their own words, and the operator is cancelled."""

    def decorate(execute: Callable) -> Callable:
        @functools.wraps(execute)
        def run(self, context):
            try:
                return execute(self, context)
            except kinds as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}

        return run

    return decorate
