"""What a worker says: one JSON object a line on its standard output."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

STATUS, PROGRESS, WARNING, ERROR, RESULT = "status", "progress", "warning", "error", "result"
KINDS = (STATUS, PROGRESS, WARNING, ERROR, RESULT)


@dataclass(frozen=True)
class Message:
    """One line from the worker.

    kind: status (data: stage, text), progress (stage, fraction of the stage, total fraction, remaining seconds or null),
    warning (text), error (text, log, cancelled) or result (out, strands, seconds).
    """

    kind: str
    data: Mapping[str, Any] = field(default_factory=dict)

    def to_line(self) -> str:
        """The message as one line of JSON, newline included."""
        return json.dumps({"kind": self.kind, **self.data}) + "\n"

    @classmethod
    def from_line(cls, line: str) -> Message:
        """The message of a line. Raises ValueError for anything that is not one."""
        values = json.loads(line)
        if not isinstance(values, dict) or values.get("kind") not in KINDS:
            raise ValueError(f"not a message of the worker: {line[:200]!r}")
        return cls(values.pop("kind"), values)
