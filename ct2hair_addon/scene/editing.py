"""What an artist does to a result: measure it by region, trim it, regrow a region, show how far the scan backs it.

Regions are parts of the scalp by where they lie on the head: front, crown, left, right and back.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ..errors import CT2HairError
from ..head import Head, HeadMesh
from ..head.mesh import face_areas
from ..interpolation import fill_scalp
from ..progress import Progress, silent
from ..settings import InterpolationSettings
from ..strands import Strands, concatenate, offsets_from_counts
from .hair import new_hair, set_width_factor, strands_of
from .head import head_mesh
from .materials import support_material
from .results import HairResult
from .staging import NewData

REGIONS = {"front": "Front", "crown": "Crown", "left": "Left", "right": "Right", "back": "Back"}
"""Names of the regions and what the panel calls them; left and right are the wearer's."""
CROWN = 35.0
"""Degrees from straight up, seen from the middle of the scalp, within which the scalp is crown."""
SHOWN_MATERIAL = "ct2hair_material"
"""Custom property of a hair object: the hair material's name while confidence is shown in its place."""


@dataclass(frozen=True)
class RegionMeasure:
    """One region: strands, area (cm^2), density (strands a cm^2), length (mean, mm), support (mean, 0 to 1)."""

    strands: int
    area: float
    density: float
    length: float
    support: float


def region_of(points: np.ndarray, mesh: HeadMesh) -> np.ndarray:
    """(M,) int: the region, as an index into `REGIONS`, of points (M, 3) on the scalp of `mesh`, mm, head frame."""
    scalp = mesh.vertices[mesh.scalp]
    # the middle of the scalp's box, brought down to where the scalp ends at the sides: as seen from within the skull
    middle = (scalp.min(axis=0) + scalp.max(axis=0)) / 2
    away = np.asarray(points, np.float64) - middle
    x, y, z = away.T
    crown = np.degrees(np.arctan2(np.hypot(x, y), z)) < CROWN
    sideways = np.abs(x) > np.abs(y)
    names = list(REGIONS)
    out = np.where(sideways, np.where(x > 0, names.index("left"), names.index("right")), 0)
    out = np.where(~sideways & (y > 0), names.index("back"), out)
    return np.where(crown, names.index("crown"), out)


def measure_regions(result: HairResult) -> dict[str, RegionMeasure]:
    """Strands, density, length and support of each region of the scalp, and of "all"; also kept on the collection."""
    mesh = head_mesh(result.head)
    strands = strands_of(result.hair)
    faces = mesh.faces[mesh.scalp_faces]
    areas = face_areas(mesh.vertices, faces) / 100.0
    of_face = region_of(mesh.vertices[faces].mean(axis=1), mesh)
    of_strand = region_of(strands.roots, mesh)
    lengths = strands.lengths()
    support = strands.strand_attributes.get("support", np.zeros(len(strands), np.float32))
    out = {}
    for number, name in enumerate([*REGIONS, "all"]):
        here = np.ones(len(strands), bool) if name == "all" else of_strand == number
        area = float(areas.sum() if name == "all" else areas[of_face == number].sum())
        count = int(np.count_nonzero(here))
        out[name] = RegionMeasure(
            count,
            area,
            count / area if area > 0 else 0.0,
            float(lengths[here].mean()) if count else 0.0,
            float(support[here].mean()) if count else 0.0,
        )
    result.collection["ct2hair_regions"] = {
        name: [m.strands, m.area, m.density, m.length, m.support] for name, m in out.items()
    }
    return out


def measured_regions(result: HairResult) -> dict[str, RegionMeasure]:
    """What `measure_regions` found last; empty where nothing was measured since the hair changed."""
    known = result.collection.get("ct2hair_regions", {})
    return {name: RegionMeasure(int(row[0]), *row[1:]) for name, row in known.items()}


def cut_to(strands: Strands, length: np.ndarray | float) -> Strands:
    """`strands` cut at `length` mm (one for all, or one a strand); shorter ones stay. The cut end is a new, exact point."""
    most = np.broadcast_to(np.asarray(length, np.float64), (len(strands),))
    arc = strands.arc_lengths().astype(np.float64)
    strand = strands.strand_index
    first = np.zeros(len(arc), bool)
    first[strands.offsets[:-1]] = True
    inside = (arc < most[strand]) | first
    kept = np.add.reduceat(inside, strands.offsets[:-1])
    cut = kept < strands.counts
    offsets = offsets_from_counts(kept + cut)
    # each kept point, and after the last one of a cut strand the end between it and the first point left out
    source = np.repeat(strands.offsets[:-1] - offsets[:-1], kept + cut) + np.arange(offsets[-1])
    share = np.zeros(len(source))
    ends = offsets[1:][cut] - 1
    after = strands.offsets[:-1][cut] + kept[cut]
    share[ends] = (arc[after - 1] - most[cut]) / np.minimum(arc[after - 1] - arc[after], -1e-9)
    before = source.copy()
    before[ends] = after - 1

    def between(values: np.ndarray) -> np.ndarray:
        if values.dtype.kind != "f":
            return values[before]
        weight = share.reshape(-1, *([1] * (values.ndim - 1)))
        return ((1 - weight) * values[before] + weight * values[source]).astype(values.dtype)

    points = {name: between(values) for name, values in strands.point_attributes.items()}
    return Strands(between(strands.points), offsets, dict(strands.strand_attributes), points)


def trim(result: HairResult, length: float, region: str = "all") -> int:
    """Cut the hair of a region ("all", or one of `REGIONS`) to `length` mm from the root; returns how many strands changed.

    The simulation, if there is one, must be done again. Raises CT2HairError for a length under 1 mm or an unknown region.
    """
    if length < 1.0:
        raise CT2HairError(f"a length of {length:g} mm leaves no hair; choose 1 mm or more")
    strands = strands_of(result.hair)
    most = np.where(_in_region(result, strands, region), length, np.inf)
    longer = int(np.count_nonzero(strands.lengths() > most))
    if longer:
        _replace_hair(result, cut_to(strands, most))
    return longer


def regrow(result: HairResult, region: str = "all", count: int = 0, seed: int = 1, progress: Progress = silent) -> int:
    """Grow the hair of a region anew from the guides, `count` strands (0: as many as there are); returns how many grew.

    Another seed puts the roots elsewhere. What the scan did not show is blended from the guides, not fitted to the scan; by
    cosines where Blender's own Python has no torch for the learned prior (the worker may have another).
    Raises CT2HairError where the result has no guides.
    """
    if result.guides is None:
        raise CT2HairError("the result has no guides to grow hair from; load the job's result again")
    strands, guides = strands_of(result.hair), strands_of(result.guides)
    here = _in_region(result, strands, region)
    head = Head(head_mesh(result.head))
    wanted = count or int(np.count_nonzero(here))
    share = np.mean(_in_region(result, head.sample_scalp(4000, seed).position, region))
    if share <= 0:
        raise CT2HairError(f"the scalp has nothing in the region '{region}'")
    total = max(int(np.ceil(wanted / share * 1.1)), len(guides))
    plain = Strands(guides.points, guides.offsets, _only(guides.strand_attributes, ("root_uv", "support")))
    grown = fill_scalp(plain, head, total, InterpolationSettings(without_prior="linear"), seed, progress=progress).strands
    grown = grown.select(np.flatnonzero(_in_region(result, grown, region))[:wanted])
    if not len(grown):
        raise CT2HairError(f"no strand could be grown in the region '{region}': its guides are too few")
    shared = set(grown.strand_attributes) & set(strands.strand_attributes)
    old = strands.select(~here)
    support = grown.strand_attributes.get("support")
    backed = {} if support is None else {"support": np.repeat(support, grown.counts)}
    parts = [
        Strands(part.points, part.offsets, _only(part.strand_attributes, shared), _only(points, ("support",)))
        for part, points in ((old, old.point_attributes), (grown, backed))
    ]
    _replace_hair(result, concatenate(parts))
    return len(grown)


def show_confidence(result: HairResult, on: bool) -> None:
    """Show the hair by how far the scan backs each strand (red none, green all), or in its own material again."""
    materials = result.hair.data.materials
    shown = bpy.data.materials.get(result.hair.get(SHOWN_MATERIAL, ""))
    if on and SHOWN_MATERIAL not in result.hair:
        if result.hair.data.attributes.get("support") is None:
            raise CT2HairError("the hair does not say how far the scan backs it (attribute 'support'); reconstruct it again")
        with NewData() as new:
            material = support_material(new, f"{result.hair.name} Confidence")
        own = materials[0] if materials else None
        result.hair[SHOWN_MATERIAL] = own.name if own is not None else ""
        if own is not None:
            own.use_fake_user = True  # nobody else uses it meanwhile
        materials.clear()
        materials.append(material)
    elif not on and SHOWN_MATERIAL in result.hair:
        confidence = materials[0] if materials else None
        materials.clear()
        if shown is not None:
            materials.append(shown)
            shown.use_fake_user = False
        del result.hair[SHOWN_MATERIAL]
        if confidence is not None and not confidence.users:
            bpy.data.materials.remove(confidence)


def confidence_shown(result: HairResult) -> bool:
    return SHOWN_MATERIAL in result.hair


def mark_scalp_by_selection(ob: bpy.types.Object) -> int:
    """Make the selected vertices of a mesh its scalp (vertex group 'scalp'); returns how many they are."""
    from .head import SCALP_GROUP

    if ob is None or ob.type != "MESH":
        raise CT2HairError("choose the head's mesh object, and select the vertices where hair grows in edit mode")
    editing = ob.mode == "EDIT"
    if editing:
        ob.update_from_editmode()
    selected = np.empty(len(ob.data.vertices), bool)
    ob.data.vertices.foreach_get("select", selected)
    chosen = np.flatnonzero(selected)
    if not len(chosen):
        raise CT2HairError(f"'{ob.name}' has no selected vertex; select the vertices where hair grows in edit mode")
    mode = ob.mode
    if editing:
        bpy.ops.object.mode_set(mode="OBJECT")
    try:
        group = ob.vertex_groups.get(SCALP_GROUP) or ob.vertex_groups.new(name=SCALP_GROUP)
        group.remove(range(len(selected)))
        group.add(chosen.tolist(), 1.0, "REPLACE")
        ob.vertex_groups.active_index = group.index
    finally:
        if editing:
            bpy.ops.object.mode_set(mode=mode)
    return len(chosen)


def _in_region(result: HairResult, where: Strands | np.ndarray, region: str) -> np.ndarray:
    """(N,) bool of strands by their roots, or of points (N, 3)."""
    points = where.roots if isinstance(where, Strands) else where
    if region == "all":
        return np.ones(len(points), bool)
    if region not in REGIONS:
        raise CT2HairError(f"region '{region}' is not known; there are all, {', '.join(REGIONS)}")
    return region_of(points, head_mesh(result.head)) == list(REGIONS).index(region)


def _replace_hair(result: HairResult, strands: Strands) -> None:
    """Give the hair object other strands: same material, attachment and place; what was measured of the old ones goes."""
    from .simulation import clear_simulation

    clear_simulation(result)
    ob = result.hair
    old = ob.data
    with NewData() as new:
        made = new_hair(new, old.name, strands, result.head, material=old.materials[0] if old.materials else None)
    name = old.name
    ob.data, made.object.data = made.object.data, old
    bpy.data.objects.remove(made.object)
    bpy.data.hair_curves.remove(old)
    ob.data.name = name
    set_width_factor(ob, 1.0)
    if "ct2hair_regions" in result.collection:
        del result.collection["ct2hair_regions"]


def _only(attributes: dict[str, np.ndarray], names) -> dict[str, np.ndarray]:
    return {name: values for name, values in attributes.items() if name in names}
