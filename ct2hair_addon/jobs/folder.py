"""The job folder: what the worker is to do (job.json) and its log, beside the result that it makes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from ..errors import CT2HairError
from ..settings import Settings


@dataclass(frozen=True)
class JobFolder:
    """`<out>/job`: job.json says which scan, where to and with which settings; log.txt is what the worker printed."""

    path: Path

    @property
    def description(self) -> Path:
        return self.path / "job.json"

    @property
    def log(self) -> Path:
        return self.path / "log.txt"

    @classmethod
    def create(cls, scan: Path, out: Path, settings: Settings, raw_shape=None, raw_type=None, until=None) -> JobFolder:
        """Describe a job in `<out>/job`, written aside and renamed."""
        folder = cls(Path(out) / "job")
        folder.path.mkdir(parents=True, exist_ok=True)
        values = {
            "scan": str(Path(scan).resolve()),
            "out": str(Path(out).resolve()),
            "raw_shape": None if raw_shape is None else [int(n) for n in raw_shape],
            "raw_type": raw_type,
            "until": until,
            "settings": settings.to_dict(),
        }
        beside = folder.path / ".job.json.part"
        beside.write_text(json.dumps(values, indent=2), encoding="utf-8")
        beside.replace(folder.description)
        return folder

    def read(self) -> tuple[Path, Path, Settings, tuple[int, ...] | None, str | None, str | None]:
        """(scan, out, settings, shape and type of a raw scan, stage to stop after). CT2HairError where job.json is bad."""
        try:
            values = json.loads(self.description.read_text(encoding="utf-8"))
            shape = values["raw_shape"]
            return (
                Path(values["scan"]),
                Path(values["out"]),
                Settings.from_dict(values["settings"]),
                None if shape is None else tuple(shape),
                values["raw_type"],
                values.get("until"),
            )
        except (OSError, KeyError, TypeError, json.JSONDecodeError) as error:
            raise CT2HairError(f"{self.description}: not a job description ({error}); start the job again") from error
