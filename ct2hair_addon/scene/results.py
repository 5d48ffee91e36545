"""Results and imported scans as they stand in the scene: found again by what their objects say they are."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..errors import CT2HairError
from ..settings import Settings

ROLE = "ct2hair_role"
"""Custom property of an object: what it is in its result (root, scan, head, hair, guides, volume)."""
KIND = "ct2hair_kind"
"""Custom property of a collection: `scan` or `result`."""
ROLES = ("root", "scan", "head", "hair", "guides", "volume")


@dataclass(frozen=True)
class ScanResult:
    """An imported scan: its collection, the handle, the empty that carries scan -> scene, and the volume."""

    collection: bpy.types.Collection
    root: bpy.types.Object
    scan: bpy.types.Object
    volume: bpy.types.Object
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class HairResult:
    """A result in the scene. guides, scan and volume are None where the result has none (or the user deleted them)."""

    collection: bpy.types.Collection
    root: bpy.types.Object
    head: bpy.types.Object
    hair: bpy.types.Object
    guides: bpy.types.Object | None = None
    scan: bpy.types.Object | None = None
    volume: bpy.types.Object | None = None

    @property
    def folder(self) -> Path:
        """The job's folder that the result was read from."""
        return Path(self.collection.get("ct2hair_folder", ""))

    @property
    def report(self) -> dict[str, Any]:
        """The report of the run that made the result, as in report.json."""
        return json.loads(self.collection.get("ct2hair_report", "{}"))

    @property
    def settings(self) -> Settings:
        """The settings that the result was made with."""
        return Settings.from_dict(self.report.get("settings", {}))

    @property
    def tally(self) -> dict[str, int]:
        """What was left out or placed by guess on the way into the scene, by reason."""
        return {key: int(value) for key, value in self.collection.get("ct2hair_tally", {}).items()}


def results(kind: str = "result") -> list[bpy.types.Collection]:
    """The collections of all results (or `scan`s) in the file, oldest first."""
    return [collection for collection in bpy.data.collections if collection.get(KIND) == kind]


def result_of(collection: bpy.types.Collection) -> HairResult:
    """The result in a collection, found by what its objects say they are. Raises CT2HairError where head or hair are gone."""
    members = dict.fromkeys(ROLES)
    for ob in collection.all_objects:
        if ob.get(ROLE) in members:
            members[ob[ROLE]] = ob
    if collection.get(KIND) != "result" or members["head"] is None or members["hair"] is None:
        raise CT2HairError(f"the collection '{collection.name}' holds no result with head and hair; load the result again")
    return HairResult(collection, **members)


def active_result(context: bpy.types.Context | None = None) -> HairResult | None:
    """The result of the active object, else the newest one in the scene; None where there is none."""
    context = context or bpy.context
    in_scene = [c for c in context.scene.collection.children_recursive if c.get(KIND) == "result"]
    active = getattr(context, "active_object", None)
    chosen = [c for c in in_scene if active is not None and active.name in c.all_objects] or in_scene[-1:]
    for collection in chosen:
        try:
            return result_of(collection)
        except CT2HairError:
            continue
    return None
