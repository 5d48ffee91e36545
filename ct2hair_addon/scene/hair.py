"""Hair in the scene: curves attached to the head, from Strands and back (frames: see `frames`).

Written in bulk: 100,000 strands of 64 points take well under three seconds. The curves follow the head's shape keys, armature
and other modifiers through `surface_uv_coordinate` and a Geometry Nodes modifier.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ..errors import HeadError, StrandFileError
from ..head import Head, HeadMesh
from ..strands import Strands, normalized
from .attributes import read_attribute, write_attribute
from .frames import MM
from .head import SCALP_UV, attach, head_mesh
from .staging import NewData

DIAMETER = 0.075
"""Mean diameter of a strand, mm: Caucasian hair's; measured hair runs from 0.04 to 0.12 mm."""
DIAMETER_RANGE = (0.04, 0.12)
DIAMETER_SPREAD = 0.014
"""Standard deviation of the diameter between the strands of one head, mm."""
TIP_SHARE = 0.12
"""The last part of a strand's points over which it thins to a point of `TIP_DIAMETER` of its width."""
TIP_DIAMETER = 0.35

FULL_HEAD = 100_000
"""Strands on a human head."""
WIDTH_LIMIT = 4.0
"""More than this many times its width, hair looks like string."""

FOLLOW_GROUP = "CT2Hair Follow Head"
WIDTH_INPUT = "Width"
"""Input of the modifier that all widths are multiplied by: 1 is true to life, see `set_width_factor`."""

INTERNAL = "ct2hair_"
"""Attributes of such names serve the scene's modifiers and are no part of the strands."""
_ATTACHED = "surface_uv_coordinate"
PER_STRAND = "strand_"
"""Before the name of a per-strand attribute where a per-point one has the same: the scene and exports know one of a name."""
_CURVE_ATTRIBUTES = {"FLOAT": (), "INT": (), "FLOAT2": (2,), "FLOAT_VECTOR": (3,)}


@dataclass(frozen=True)
class NewHair:
    """What `new_hair` made: the object, and what it left out or could not place."""

    object: bpy.types.Object
    tally: dict[str, int]


def strand_diameters(count: int, seed: int = 0, mean: float = DIAMETER) -> np.ndarray:
    """(count,) float32 diameters in mm, spread as on one head and within `DIAMETER_RANGE`; the same seed, the same hair."""
    spread = DIAMETER_SPREAD * mean / DIAMETER
    drawn = np.random.default_rng(seed).normal(mean, spread, count)
    return np.clip(drawn, *DIAMETER_RANGE).astype(np.float32)


def taper(strands: Strands) -> np.ndarray:
    """(M,) float32: width of each point as a share of its strand's: 1, and thinning to the tip over the last points."""
    widths = np.ones(len(strands.points), np.float32)
    thinning = np.ceil(TIP_SHARE * (strands.counts - 1)).astype(np.int64)  # points of each strand that are thinner than 1
    before_tip = np.repeat(np.cumsum(thinning) - 1, thinning) - np.arange(thinning.sum())
    share = (1 - before_tip / np.repeat(np.maximum(thinning, 1), thinning)).astype(np.float32)
    widths[np.repeat(strands.offsets[1:] - 1, thinning) - before_tip] -= np.float32(1 - TIP_DIAMETER) * share
    return widths


def new_hair(
    new: NewData,
    name: str,
    strands: Strands,
    head: bpy.types.Object,
    *,
    material: bpy.types.Material | None = None,
    group_id: int = 0,
    diameter: float = DIAMETER,
    seed: int = 0,
    head_data: HeadMesh | None = None,
) -> NewHair:
    """Hair curves of `strands` (mm, the frame of the head object's mesh data), attached to `head`, not linked yet.

    Strands of fewer than two points, or with a point that is not finite, are left out and counted: importers of grooms break
    on them. Where the strands have no `root_uv`, the closest point of the scalp gives it (`head_data` saves reading the mesh).
    Attributes: radius (POINT, m), surface_uv_coordinate, group_id and every per-strand array of the strands (CURVE), every
    per-point one (POINT); where there are both of a name, `strand_support`, say, is the strand's. diameter: mean, mm.
    """
    strands, tally = usable(strands)
    if not len(strands):
        raise StrandFileError(f"'{name}' has no strand of two points or more: there is nothing to show")
    if head.data.uv_layers.get(SCALP_UV) is None:
        raise HeadError(f"'{head.name}' has no UV layer '{SCALP_UV}' to attach hair by; make one with add_scalp_uv")
    curves = _new_curves(new, name, strands)
    radius = strands.point_attributes.get("radius")
    if radius is None:
        drawn = np.float32(0.5 * MM) * strand_diameters(len(strands), seed, diameter)
        radius = taper(strands) * np.repeat(drawn, strands.counts)
    write_attribute(curves, "radius", "FLOAT", "POINT", radius)
    uv, missing = _root_uv(strands, head, head_data)
    tally["root placed by the closest point of the scalp"] = missing
    write_attribute(curves, _ATTACHED, "FLOAT2", "CURVE", uv)
    groups = strands.strand_attributes.get("group_id", np.full(len(strands), group_id))
    write_attribute(curves, "group_id", "INT", "CURVE", groups)
    for domain, attributes in (("CURVE", named_apart(strands)), ("POINT", strands.point_attributes)):
        for key, values in attributes.items():
            if key not in ("root_uv", "group_id", "radius", "position"):
                _write_array(curves, key, domain, np.asarray(values))
    if material is not None:
        curves.materials.append(material)

    ob = new.add(bpy.data.objects.new(name, curves))
    curves.surface = head
    curves.surface_uv_map = SCALP_UV
    head.add_rest_position_attribute = True  # without it the hair stays where it is, and nothing says so
    attach(ob, head)
    modifier = ob.modifiers.new("Follow Head", "NODES")
    modifier.node_group = _follow_group(new)
    set_width_factor(ob, 1.0)
    return NewHair(ob, tally)


def new_lines(new: NewData, name: str, lines: Strands, material: bpy.types.Material, diameter: float) -> bpy.types.Object:
    """A Curves object of straight `lines` (mm, two points each) as they are, on nothing, not linked yet.

    With every attribute of theirs and `direction` (CURVE), along which each runs. diameter: mm.
    """
    if not len(lines):
        raise StrandFileError(f"'{name}' has no line: there is nothing to show")
    curves = _new_curves(new, name, lines)
    write_attribute(curves, "radius", "FLOAT", "POINT", np.full(len(lines.points), 0.5 * MM * diameter))
    directions = normalized(lines.points[1::2] - lines.points[::2])
    for key, values in {**lines.strand_attributes, "direction": directions}.items():
        _write_array(curves, key, "CURVE", np.asarray(values))
    curves.materials.append(material)
    return new.add(bpy.data.objects.new(name, curves))


def _new_curves(new: NewData, name: str, strands: Strands) -> bpy.types.Curves:
    """Curves through the points of `strands` (mm), in metres, without an attribute yet."""
    curves = new.add(bpy.data.hair_curves.new(name))
    curves.add_curves(strands.counts.tolist())
    curves.set_types(type="POLY")  # at once: evaluation of the default type takes a hundred times as long
    curves.position_data.foreach_set("vector", (strands.points * np.float32(MM)).ravel())
    return curves


def strands_of(ob: bpy.types.Object, evaluated: bool = False) -> Strands:
    """The Strands (mm, in the object's own frame) of a hair curves object, with its attributes.

    `surface_uv_coordinate` comes back as `root_uv`, `radius` in metres as it is. evaluated: as the scene shows them, with
    the head's pose. Raises StrandFileError where the object is not hair curves.
    """
    if ob is None or ob.type != "CURVES":
        raise StrandFileError(f"'{ob.name if ob else None}' is not a hair curves object; choose one")
    curves = ob.evaluated_get(bpy.context.evaluated_depsgraph_get()).data if evaluated else ob.data
    points = np.empty(len(curves.points) * 3, np.float32)
    curves.position_data.foreach_get("vector", points)
    offsets = np.empty(len(curves.curve_offset_data), np.int32)
    curves.curve_offset_data.foreach_get("value", offsets)
    strand, point = {}, {}
    for attribute in curves.attributes:
        if attribute.name in ("position", "curve_type", "resolution") or attribute.name.startswith((".", INTERNAL)):
            continue
        values = read_attribute(curves, attribute.name)
        if values is not None:
            (strand if attribute.domain == "CURVE" else point)[attribute.name] = values
    if _ATTACHED in strand:
        strand["root_uv"] = strand.pop(_ATTACHED)
    for name in point:
        if PER_STRAND + name in strand:
            strand[name] = strand.pop(PER_STRAND + name)
    return Strands(points.reshape(-1, 3) / np.float32(MM), offsets, strand, point)


def named_apart(strands: Strands) -> dict[str, np.ndarray]:
    """The per-strand attributes, those that a per-point one has the name of under `PER_STRAND`."""
    points = strands.point_attributes
    return {PER_STRAND + name if name in points else name: values for name, values in strands.strand_attributes.items()}


def usable(strands: Strands) -> tuple[Strands, dict[str, int]]:
    """The strands that can be shown and exported, and how many were dropped, by reason."""
    short = strands.counts < 2
    broken = np.zeros(len(strands), bool)
    finite = np.isfinite(strands.points)
    if not finite.all():
        broken[strands.strand_index[~finite.all(axis=1)]] = True
    broken &= ~short
    kept = strands if not (short.any() or broken.any()) else strands.select(~(short | broken))
    return kept, {
        "dropped: fewer than two points": int(np.count_nonzero(short)),
        "dropped: a point that is not finite": int(np.count_nonzero(broken)),
    }


def set_width_factor(ob: bpy.types.Object, factor: float) -> None:
    """Show the hair `factor` times as wide as it is; the attribute `radius` stays true.

    `full_width_factor` is the factor that makes up for strands that are missing from a head.
    """
    for modifier in ob.modifiers:
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith(FOLLOW_GROUP):
            set_modifier_input(modifier, WIDTH_INPUT, factor)
    ob.data.update_tag()


def full_width_factor(ob: bpy.types.Object) -> float:
    """The factor of `set_width_factor` by which this many strands cover a head as a full head of hair does."""
    return float(np.clip(np.sqrt(FULL_HEAD / max(len(ob.data.curves), 1)), 1.0, WIDTH_LIMIT))


def set_modifier_input(modifier: bpy.types.NodesModifier, name: str, value) -> None:
    """Set an input of a Geometry Nodes modifier by the name of its socket, in any Blender from 4.5 on."""
    socket = next(
        item
        for item in modifier.node_group.interface.items_tree
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name
    )
    if bpy.app.version >= (5, 2, 0):
        getattr(modifier.properties.inputs, socket.identifier).value = value
    else:
        modifier[socket.identifier] = value


def _root_uv(strands: Strands, head: bpy.types.Object, head_data: HeadMesh | None) -> tuple[np.ndarray, int]:
    """(N, 2) float32 scalp coordinates of the roots, and how many had to be looked up."""
    uv = np.array(strands.strand_attributes.get("root_uv", np.full((len(strands), 2), np.nan)), np.float32)
    missing = ~np.isfinite(uv).all(axis=1)
    if missing.any():
        scalp = Head(head_data if head_data is not None else head_mesh(head))
        uv[missing] = scalp.closest_scalp(strands.roots[missing]).uv
    return uv, int(np.count_nonzero(missing))


def _write_array(curves, name: str, domain: str, values: np.ndarray) -> None:
    """Write a per-strand or per-point array as an attribute of the type that fits; others are left out."""
    if values.dtype.kind == "b":
        values = values.astype(np.int32)
    kinds = {"i": ("INT",), "u": ("INT",), "f": ("FLOAT", "FLOAT2", "FLOAT_VECTOR")}.get(values.dtype.kind, ())
    for kind in kinds:
        if values.shape[1:] == _CURVE_ATTRIBUTES[kind]:
            write_attribute(curves, name, kind, domain, values)


def _follow_group(new: NewData) -> bpy.types.NodeTree:
    """The node group that makes curves follow the head: shared, made where the file has none."""
    group = bpy.data.node_groups.get(FOLLOW_GROUP)
    if group is not None and group.bl_idname == "GeometryNodeTree":
        return group
    group = new.add(bpy.data.node_groups.new(FOLLOW_GROUP, "GeometryNodeTree"))
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    width = group.interface.new_socket(WIDTH_INPUT, in_out="INPUT", socket_type="NodeSocketFloat")
    width.default_value, width.min_value = 1.0, 0.0
    width.description = "All widths times this: 1 is true to life; more stands in for strands that are missing"
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    nodes, links = group.nodes, group.links
    entry, leave = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    follow = nodes.new("GeometryNodeDeformCurvesOnSurface")
    wider = nodes.new("GeometryNodeSetCurveRadius")
    radius = nodes.new("GeometryNodeInputRadius")
    scaled = nodes.new("ShaderNodeMath")
    scaled.operation = "MULTIPLY"
    links.new(entry.outputs["Geometry"], follow.inputs["Curves"])
    links.new(follow.outputs["Curves"], wider.inputs["Curve"])
    links.new(radius.outputs["Radius"], scaled.inputs[0])
    links.new(entry.outputs[WIDTH_INPUT], scaled.inputs[1])
    links.new(scaled.outputs["Value"], wider.inputs["Radius"])
    links.new(wider.outputs["Curve"], leave.inputs["Geometry"])
    for node, x, y in ((entry, -600, 0), (follow, -300, 0), (radius, -300, -150), (scaled, 0, -150), (wider, 200, 0)):
        node.location = (x, y)
    leave.location = (450, 0)
    return group
