"""Checkpoints: a stage's result in one file, keyed by all that it depends on, never half-written."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

KEY = "checkpoint"
"""Name of the entry that holds the key and the structure, as JSON."""


def fingerprint(path: Path) -> str:
    """What tells one input from another: names, sizes, times and both ends of each file (of a folder, all its files)."""
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if not file.is_file():
            continue
        status = file.stat()
        digest.update(f"{file.relative_to(path)}|{status.st_size}|{status.st_mtime_ns}|".encode())
        with file.open("rb") as stream:
            digest.update(stream.read(1 << 16))
            stream.seek(max(status.st_size - (1 << 16), 0))
            digest.update(stream.read(1 << 16))
    return digest.hexdigest()


def chained_key(previous: str, **depends: Any) -> str:
    """The key of a stage from the key of the one before and what the stage itself depends on (plain values)."""
    text = json.dumps({"previous": previous, **depends}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class Checkpoints:
    """A folder with one file a stage. `types` are the dataclasses that results are made of."""

    def __init__(self, folder: Path, types: tuple[type, ...]) -> None:
        self.folder = folder
        self._types = {known.__name__: known for known in types}

    def path(self, stage: str) -> Path:
        return self.folder / f"{stage}.npz"

    def save(self, stage: str, key: str, result: Any) -> None:
        """Write a result beside the stage's file and rename it. Raises TypeError for a dataclass that isn't in `types`."""
        arrays: dict[str, np.ndarray] = {}
        structure = self._frozen(result, arrays)
        arrays[KEY] = np.array(json.dumps({"key": key, "result": structure}))
        self.folder.mkdir(parents=True, exist_ok=True)
        beside = self.folder / f".{stage}.part.npz"
        try:
            np.savez(beside, **arrays)
            beside.replace(self.path(stage))
        finally:
            beside.unlink(missing_ok=True)

    def load(self, stage: str, key: str) -> Any | None:
        """The result with this key; None where there is none, an older one, or a damaged file."""
        try:
            with np.load(self.path(stage)) as file:
                saved = json.loads(str(file[KEY]))
                if saved["key"] != key:
                    return None
                return self._thawed(saved["result"], file)
        except (OSError, KeyError, ValueError, TypeError, EOFError, BadZipFile):
            return None

    def drop(self, stage: str) -> None:
        """Delete the stage's file, if there is one."""
        self.path(stage).unlink(missing_ok=True)

    def _thawed(self, structure: Any, arrays) -> Any:
        if isinstance(structure, list):
            return [self._thawed(item, arrays) for item in structure]
        if not isinstance(structure, dict):
            return structure
        if "array" in structure:
            return arrays[structure["array"]]
        if "tuple" in structure:
            return tuple(self._thawed(item, arrays) for item in structure["tuple"])
        if "dict" in structure:
            return {name: self._thawed(item, arrays) for name, item in structure["dict"].items()}
        fields = {name: self._thawed(item, arrays) for name, item in structure["fields"].items()}
        return self._types[structure["type"]](**fields)

    def _frozen(self, value: Any, arrays: dict[str, np.ndarray]) -> Any:
        """`value` as JSON, its arrays moved into `arrays`; an array that several fields share is written once."""
        if isinstance(value, np.ndarray):
            for name, known in arrays.items():
                if known is value:
                    return {"array": name}
            name = f"a{len(arrays)}"
            arrays[name] = value
            return {"array": name}
        if dataclasses.is_dataclass(value):
            if self._types.get(type(value).__name__) is not type(value):
                raise TypeError(f"a checkpoint of {type(value).__qualname__} could not be read again: name it in `types`")
            fields = {f.name: self._frozen(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
            return {"type": type(value).__name__, "fields": fields}
        if isinstance(value, dict):
            return {"dict": {str(name): self._frozen(item, arrays) for name, item in value.items()}}
        if isinstance(value, tuple):
            return {"tuple": [self._frozen(item, arrays) for item in value]}
        if isinstance(value, list):
            return [self._frozen(item, arrays) for item in value]
        if isinstance(value, np.generic):
            return value.item()
        return value
