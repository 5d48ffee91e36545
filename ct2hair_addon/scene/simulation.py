"""Hair in motion in the scene: guides simulated frame by frame, kept in a point cache, the dense hair following them.

The motion of the guides is a Blender-readable cache (PC2) that a mesh of the guides' points plays; Geometry Nodes give each
point of the hair the motion of the three nearest guides at its height, and lift what lies in the head out of it. So it plays,
renders and exports in any Blender without this extension. The solver is in `dynamics`.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import struct
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from scipy.spatial import cKDTree

from .. import __version__
from ..errors import CT2HairError
from ..head import Head, HeadMesh
from ..progress import Progress, silent
from ..settings import SimulationSettings
from ..strands import Strands
from .attributes import write_attribute
from .dynamics import Obstacle, Simulation
from .export import written_beside
from .frames import MM
from .hair import set_modifier_input, strands_of
from .head import attach, head_mesh
from .results import ROLE, HairResult
from .staging import NewData

GROUP = "CT2Hair Follow Guides"
MODIFIER = "Follow Guides"
CACHE_MODIFIER = "Motion"
MOTION = "motion"
"""Role of the object that plays the guides' motion."""
NEAREST = 3
"""Guides that a point of the hair follows."""
WEIGHTS, PLACE, HEIGHT = "ct2hair_weights", "ct2hair_place_{}", "ct2hair_height"
"""Attributes of the hair: weights of its guides (CURVE), where on each of them a point is, and its distance from the head at
rest, m (both POINT)."""
REACHED = 0.003
"""m; only points that have moved by their distance from the head less this can be in it, and are looked up there: by far the
costliest of what is done to each in every frame."""
OBSTACLE_STEPS = 16
"""Steps that the head is measured in, so that a step is short."""
REST = "rest"
"""Attribute of the motion's mesh: the points without any motion."""
PC2 = struct.Struct("<12siiffi")
"""Header of a PC2 file: signature, version, points, first frame, frames a sample, samples."""


@dataclass(frozen=True)
class SimulationResult:
    """What `simulate` did: cache is the file, frames the first and last one; tip and inside are measured at the last frame.

    tip: mean distance of the guides' tips from where they would rest, mm. inside: share of the guides' points in the head.
    """

    cache: Path
    frames: tuple[int, int]
    guides: int
    tip: float
    inside: float


Work = Callable[[], Any]
Steps = Generator[tuple[float, Work], Any, SimulationResult]
"""A simulation under way: gives (share done, work) and takes what the work returned. The work knows no Blender, so it may run
in a thread of its own."""


def simulate(
    result: HairResult,
    settings: SimulationSettings | None = None,
    *,
    frames: tuple[int, int] | None = None,
    cache: str | Path | None = None,
    progress: Progress = silent,
) -> SimulationResult:
    """Simulate the hair of `result` over `frames` (first, last; the scene's by default), and let all of it follow.

    The head may move, and deform by shape keys, an armature or other modifiers. cache: the file of the motion, the job's
    folder by default. A simulation that was there is replaced once the new one is whole. Blocks; progress may raise
    `Cancelled`, and the scene is then as it was. Raises CT2HairError where frames, hair or folder are of no use.
    """
    with contextlib.closing(simulation_steps(result, settings, frames=frames, cache=cache)) as steps:
        outcome = None
        while True:
            try:
                share, work = steps.send(outcome)
            except StopIteration as end:
                progress(1.0, 1.0)
                return end.value
            progress(share, 1.0)
            outcome = work()


def simulation_steps(
    result: HairResult,
    settings: SimulationSettings | None = None,
    *,
    frames: tuple[int, int] | None = None,
    cache: str | Path | None = None,
) -> Steps:
    """As `simulate`, step by step (`Steps`), for a window that must not wait. Closed early, it leaves the scene as it was."""
    settings = settings or SimulationSettings()
    scene = bpy.context.scene
    first, last = frames or (scene.frame_start, scene.frame_end)
    if last <= first:
        raise CT2HairError(f"frames {first} to {last}: a simulation needs two frames or more; set the last one higher")
    cache = Path(cache) if cache else _default_cache(result)
    guides = _guides(result, settings)
    obstacle = yield from _obstacle(head_mesh(result.head), 0.0, 0.1)
    before = scene.frame_current
    shown = _set_following(result, False)
    try:
        samples = yield from _run(result, guides, settings, obstacle, first, last)
        head, points = head_mesh(result.head, evaluated=True), samples[-1][0]
        inside = yield 0.9, lambda: float(np.mean(Head(head).signed_distance(points) < -0.01))
    finally:
        scene.frame_set(before)
        _set_following(result, shown)
    motion = np.stack([moved for _, moved in samples])
    rest = guides.points.reshape(-1, settings.points, 3)
    tip = float(np.linalg.norm(motion[-1].reshape(rest.shape)[:, -1] - rest[:, -1], axis=1).mean())
    hair = {ob: strands_of(ob) for ob in (result.hair, result.guides) if ob is not None}
    following = yield 0.95, lambda: [_followed(strands, guides, settings.points, obstacle) for strands in hair.values()]
    # the last step is behind: from here on nothing can leave a new file with the old simulation
    _write_pc2(cache, motion.reshape(len(motion), -1, 3) * MM, first)
    with NewData() as new:
        playing = _new_motion(new, result, guides, cache, first)
        group = _follow_group(new)
        clear_simulation(result)
        result.collection.objects.link(playing)
        attach(playing, result.head)
        for ob, attributes in zip(hair, following, strict=True):
            for name, kind, domain, values in attributes:
                write_attribute(ob.data, name, kind, domain, values)
            modifier = ob.modifiers.new(MODIFIER, "NODES")
            modifier.node_group = group
            set_modifier_input(modifier, "Guides", playing)
            set_modifier_input(modifier, "Head", result.head)
    playing.hide_viewport = playing.hide_render = True
    result.collection["ct2hair_simulation"] = {
        "version": __version__,
        "cache": str(cache),
        "first": first,
        "last": last,
        **{name: getattr(settings, name) for name in settings.__dataclass_fields__},
    }
    bpy.context.view_layer.update()
    return SimulationResult(cache, (first, last), len(guides), tip, inside)


def clear_simulation(result: HairResult) -> bool:
    """Take the simulation of a result out of the scene again; its cache file stays. Returns whether there was one."""
    playing = [ob for ob in result.collection.all_objects if ob.get(ROLE) == MOTION]
    for ob in (result.hair, result.guides):
        for modifier in [m for m in ob.modifiers if _follows(m)] if ob is not None else []:
            ob.modifiers.remove(modifier)
        for name in (WEIGHTS, HEIGHT, *(PLACE.format(k) for k in range(NEAREST))) if ob is not None else ():
            if (attribute := ob.data.attributes.get(name)) is not None:
                ob.data.attributes.remove(attribute)
    meshes = [ob.data for ob in playing]
    bpy.data.batch_remove([*playing, *meshes])
    if "ct2hair_simulation" in result.collection:
        del result.collection["ct2hair_simulation"]
    return bool(playing)


def simulated_frames(result: HairResult) -> tuple[int, int] | None:
    """The first and last frame of a result's simulation; None where it has none."""
    known = result.collection.get("ct2hair_simulation")
    return None if known is None else (int(known["first"]), int(known["last"]))


def _default_cache(result: HairResult) -> Path:
    folder = result.folder
    if not folder.is_absolute() or not folder.is_dir():
        raise CT2HairError("the result has no job folder for the motion's cache: name a file for it")
    return folder / "simulation.pc2"


def _guides(result: HairResult, settings: SimulationSettings) -> Strands:
    """The strands to simulate, mm in the head's frame: the guides, or hair where there are none, of equally many points."""
    strands = strands_of(result.guides if result.guides is not None else result.hair)
    usable = strands.lengths() > 2.0  # a stubble of 2 mm does not swing
    if not usable.any():
        raise CT2HairError("no strand of the result is longer than 2 mm: there is nothing to simulate")
    chosen = np.flatnonzero(usable)
    if len(chosen) > settings.guides:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, settings.guides, replace=False))
    strands = strands.select(chosen)
    uv = {"surface_uv": strands.strand_attributes["root_uv"]} if "root_uv" in strands.strand_attributes else {}
    return Strands.from_array(strands.resampled(settings.points), **uv)


def _run(
    result, guides: Strands, settings, obstacle: Obstacle, first: int, last: int
) -> Generator[tuple[float, Work], Any, list[tuple[np.ndarray, np.ndarray]]]:
    """Steps to (points in the head's frame, rest plus motion) of each frame, (N * P, 3) float32 mm both.

    obstacle: the head at rest.
    """
    scene = bpy.context.scene
    rest = guides.points.reshape(-1, settings.points, 3).astype(np.float64)
    seconds = scene.render.fps_base / scene.render.fps
    gravity = np.array(scene.gravity) if scene.use_gravity else np.zeros(3)
    shape, simulation = _vertices(result.head.data), None
    samples = []
    follower = _Follower(result, guides)
    try:
        for frame in range(first, last + 1):
            share = 0.1 + 0.8 * (frame - first) / (last - first + 1)
            scene.frame_set(frame)
            place = np.array(result.head.matrix_world, np.float64)
            place[:3, 3] /= MM
            if not np.allclose(place[:3, :3] @ place[:3, :3].T, np.eye(3), atol=1e-3):
                raise CT2HairError("the head is scaled: apply its scale (Ctrl A) before a simulation")
            vertices = _shown_vertices(result.head)
            if not np.array_equal(vertices, shape):
                shape = vertices
                obstacle = yield from _obstacle(head_mesh(result.head, evaluated=True), share, share)
            local = follower.points().reshape(rest.shape)
            world = local @ place[:3, :3].T + place[:3, 3]
            if simulation is None:
                simulation = Simulation(world, settings)
            else:
                yield share, functools.partial(simulation.step, world, obstacle, place, seconds, gravity)
            now = (simulation.points - place[:3, 3]) @ place[:3, :3]
            samples.append((now.reshape(-1, 3).astype(np.float32), (rest + (now - local)).reshape(-1, 3).astype(np.float32)))
    finally:
        follower.remove()
    return samples


def _obstacle(mesh: HeadMesh, low: float, high: float) -> Generator[tuple[float, Work], Any, Obstacle]:
    """Steps, from the share done `low` to `high`, to the head as an obstacle."""
    table = Obstacle.around(mesh)
    head = yield low, lambda: Head(mesh)
    ends = np.linspace(0, len(table.distance), OBSTACLE_STEPS + 1).astype(int)
    for number, (first, last) in enumerate(itertools.pairwise(ends.tolist())):
        yield low + (high - low) * number / OBSTACLE_STEPS, functools.partial(table.fill, head, first, last)
    return table


def _shown_vertices(ob: bpy.types.Object) -> np.ndarray:
    """(V * 3,) float32: the vertices of a mesh object as the scene shows it, in its own frame."""
    source = ob.evaluated_get(bpy.context.evaluated_depsgraph_get())
    try:
        return _vertices(source.to_mesh())
    finally:
        source.to_mesh_clear()


def _vertices(mesh: bpy.types.Mesh) -> np.ndarray:
    vertices = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", vertices)
    return vertices


class _Follower:
    """The guides at rest on a head that deforms: curves of their own with the modifier that hair follows the head by."""

    def __init__(self, result: HairResult, guides: Strands) -> None:
        self._rest = guides.points.astype(np.float64)
        self._object = None
        if "surface_uv" not in guides.strand_attributes:
            return
        curves = bpy.data.hair_curves.new("CT2Hair Rest")
        curves.add_curves(guides.counts.tolist())
        curves.set_types(type="POLY")
        curves.position_data.foreach_set("vector", (guides.points * np.float32(MM)).ravel())
        write_attribute(curves, "surface_uv_coordinate", "FLOAT2", "CURVE", guides.strand_attributes["surface_uv"])
        curves.surface, curves.surface_uv_map = result.head, result.hair.data.surface_uv_map
        self._object = bpy.data.objects.new("CT2Hair Rest", curves)
        attach(self._object, result.head)
        for modifier in result.hair.modifiers:
            if modifier.type == "NODES" and not _follows(modifier):
                self._object.modifiers.new(modifier.name, "NODES").node_group = modifier.node_group
        bpy.context.scene.collection.objects.link(self._object)
        bpy.context.view_layer.update()

    def points(self) -> np.ndarray:
        """(M, 3) float64 mm in the head's frame, now."""
        if self._object is None:
            return self._rest
        return strands_of(self._object, evaluated=True).points.astype(np.float64)

    def remove(self) -> None:
        if self._object is not None:
            curves = self._object.data
            bpy.data.objects.remove(self._object)
            bpy.data.hair_curves.remove(curves)


def _write_pc2(path: Path, samples: np.ndarray, first: int) -> None:
    """Write (F, M, 3) positions in metres, a sample a frame from `first` on."""
    with written_beside(path) as beside, beside.open("wb") as file:
        file.write(PC2.pack(b"POINTCACHE2\0", 1, samples.shape[1], float(first), 1.0, len(samples)))
        file.write(np.ascontiguousarray(samples, "<f4").tobytes())


def _new_motion(new: NewData, result: HairResult, guides: Strands, cache: Path, first: int) -> bpy.types.Object:
    """The mesh of the guides' points that plays the cache, not linked yet."""
    name = f"{result.hair.name} Motion"
    mesh = new.add(bpy.data.meshes.new(name))
    points = (guides.points * np.float32(MM)).astype(np.float32)
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", points.ravel())
    write_attribute(mesh, REST, "FLOAT_VECTOR", "POINT", points)
    ob = new.add(bpy.data.objects.new(name, mesh))
    ob[ROLE] = MOTION
    modifier = ob.modifiers.new(CACHE_MODIFIER, "MESH_CACHE")
    modifier.cache_format = "PC2"
    modifier.filepath = str(cache.resolve())
    modifier.frame_start = first
    return ob


def _followed(strands: Strands, guides: Strands, points: int, head: Obstacle) -> list[tuple[str, str, str, np.ndarray]]:
    """The attributes (name, type, domain, values) that say which guides each strand follows, how much, and where along them
    each point is; and how far from the head.

    A point follows its guide at its own distance from the root, its end where the guide is shorter; what stands on a guide's
    root follows that guide alone.
    """
    roots, lengths = guides.points[::points], np.maximum(guides.lengths(), 1e-6)
    nearest = min(NEAREST, len(guides))
    distance, index = cKDTree(roots).query(strands.roots, k=nearest)
    distance, index = distance.reshape(len(strands), nearest), index.reshape(len(strands), nearest)
    weights = np.zeros((len(strands), NEAREST))
    weights[:, :nearest] = 1.0 / (distance + 1e-3) ** 2  # 1 micrometre: on the root itself
    weights /= weights.sum(axis=1, keepdims=True)
    arc, strand = strands.arc_lengths(), strands.strand_index
    attributes = [
        (WEIGHTS, "FLOAT_VECTOR", "CURVE", weights),
        (HEIGHT, "FLOAT", "POINT", MM * head.distances(strands.points)),
    ]
    for k in range(NEAREST):
        guide = index[:, min(k, nearest - 1)][strand]
        place = guide * points + np.minimum(arc / lengths[guide], 1.0) * (points - 1)
        attributes.append((PLACE.format(k), "FLOAT", "POINT", place))
    return attributes


def _follows(modifier: bpy.types.Modifier) -> bool:
    return modifier.type == "NODES" and modifier.node_group is not None and modifier.node_group.name.startswith(GROUP)


def _set_following(result: HairResult, on: bool) -> bool:
    """Switch the hair's motion on or off; returns whether it was on."""
    was = False
    for ob in (result.hair, result.guides):
        for modifier in ob.modifiers if ob is not None else ():
            if _follows(modifier):
                was = was or modifier.show_viewport
                modifier.show_viewport = on
    return was


def _follow_group(new: NewData) -> bpy.types.NodeTree:
    """The node group that moves hair with its guides and lifts it out of the head: shared, made where the file has none."""
    group = bpy.data.node_groups.get(GROUP)
    if group is not None and group.bl_idname == "GeometryNodeTree":
        return group
    group = new.add(bpy.data.node_groups.new(GROUP, "GeometryNodeTree"))
    group.is_modifier = True
    socket = group.interface.new_socket
    socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    socket("Guides", in_out="INPUT", socket_type="NodeSocketObject").description = "The mesh that plays the guides' motion"
    socket("Head", in_out="INPUT", socket_type="NodeSocketObject").description = "The head that hair is kept out of"
    clearance = socket("Clearance", in_out="INPUT", socket_type="NodeSocketFloat")
    clearance.default_value, clearance.min_value, clearance.subtype = 0.0001, 0.0, "DISTANCE"
    clearance.description = "Hair is lifted this far off the skin, but for its roots"
    socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    build = _Nodes(group)
    entry, leave = build.node("NodeGroupInput"), build.node("NodeGroupOutput")
    moved, motion = _add_motion(build, entry)
    lifted = _add_lift(build, entry, moved, motion)
    build.link(lifted, leave.inputs["Geometry"])
    return group


class _Nodes:
    """Builds a node tree: nodes from left to right, links from sockets."""

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self._group = group

    def node(self, kind: str, **values) -> bpy.types.Node:
        node = self._group.nodes.new(kind)
        for key, value in values.items():
            setattr(node, key, value)
        count = len(self._group.nodes)
        node.location = (240 * (count // 4), -200 * (count % 4))
        return node

    def link(self, out: bpy.types.NodeSocket, into: bpy.types.NodeSocket) -> None:
        self._group.links.new(out, into)

    def math(self, operation: str, a, b=None, kind: str = "ShaderNodeMath"):
        """The result socket of an operation on sockets or constants."""
        node = self.node(kind, operation=operation)
        for socket, value in zip(node.inputs, (a, b), strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.link(value, socket)
            elif value is not None:
                socket.default_value = value
        return node.outputs["Value"] if operation in ("DOT_PRODUCT", "LENGTH") else node.outputs[0]

    def vector(self, operation: str, a, b=None):
        return self.math(operation, a, b, "ShaderNodeVectorMath")

    def scaled(self, vector, factor):
        node = self.node("ShaderNodeVectorMath", operation="SCALE")
        self.link(vector, node.inputs[0])
        self.link(factor, node.inputs["Scale"])
        return node.outputs[0]

    def attribute(self, name: str, kind: str):
        node = self.node("GeometryNodeInputNamedAttribute", data_type=kind)
        node.inputs["Name"].default_value = name
        return node.outputs["Attribute"]


def _add_motion(build: _Nodes, entry):
    """Nodes that move each point by the motion of its guides; the sockets of the geometry and of the motion."""
    guides = build.node("GeometryNodeObjectInfo", transform_space="RELATIVE")
    build.link(entry.outputs["Guides"], guides.inputs["Object"])
    position = build.node("GeometryNodeInputPosition")
    motion = build.vector("SUBTRACT", position.outputs[0], build.attribute(REST, "FLOAT_VECTOR"))
    weights = build.node("ShaderNodeSeparateXYZ")
    build.link(build.attribute(WEIGHTS, "FLOAT_VECTOR"), weights.inputs[0])
    total = None
    for k in range(NEAREST):
        place = build.attribute(PLACE.format(k), "FLOAT")
        below = build.math("FLOOR", place)
        part = build.math("SUBTRACT", place, below)
        ends = []
        for step, share in ((0.0, build.math("SUBTRACT", 1.0, part)), (1.0, part)):
            sample = build.node("GeometryNodeSampleIndex", data_type="FLOAT_VECTOR", domain="POINT", clamp=True)
            build.link(guides.outputs["Geometry"], sample.inputs["Geometry"])
            build.link(motion, sample.inputs["Value"])
            build.link(build.math("ADD", below, step), sample.inputs["Index"])
            ends.append(build.scaled(sample.outputs[0], build.math("MULTIPLY", share, weights.outputs[k])))
        own = build.vector("ADD", *ends)
        total = own if total is None else build.vector("ADD", total, own)
    move = build.node("GeometryNodeSetPosition")
    build.link(entry.outputs["Geometry"], move.inputs["Geometry"])
    build.link(total, move.inputs["Offset"])
    return move.outputs["Geometry"], total


def _add_lift(build: _Nodes, entry, geometry, motion):
    """Nodes that move points in the head, roots left alone, to the closest skin; the geometry's socket.

    A node looks up values only for points that it moves: so all that could be in the head are moved, most to where they are.
    """
    head = build.node("GeometryNodeObjectInfo", transform_space="RELATIVE")
    build.link(entry.outputs["Head"], head.inputs["Object"])
    near = build.node("GeometryNodeProximity", target_element="FACES")
    build.link(head.outputs["Geometry"], near.inputs[0])
    surface = build.node("GeometryNodeSampleNearestSurface", data_type="FLOAT_VECTOR")
    build.link(head.outputs["Geometry"], surface.inputs[0])
    normal = build.node("GeometryNodeInputNormal")
    build.link(normal.outputs[0], surface.inputs["Value"])
    outward = surface.outputs["Value"]
    position = build.node("GeometryNodeInputPosition").outputs[0]
    skin = near.outputs["Position"]
    height = build.math("DOT_PRODUCT", build.vector("SUBTRACT", position, skin), outward, "ShaderNodeVectorMath")
    low = build.math("LESS_THAN", height, entry.outputs["Clearance"])
    # beyond the mesh's open end at the neck the nearest face says nothing of inside and outside
    close = build.math("LESS_THAN", near.outputs["Distance"], 0.03)
    along = build.node("GeometryNodeSplineParameter")
    no_root = build.math("GREATER_THAN", along.outputs["Factor"], 0.0)
    reach = build.math("ADD", build.vector("LENGTH", motion), REACHED)
    might = build.math("MULTIPLY", build.math("LESS_THAN", build.attribute(HEIGHT, "FLOAT"), reach), no_root)
    wanted = build.vector("ADD", skin, build.scaled(outward, entry.outputs["Clearance"]))
    way = build.scaled(build.vector("SUBTRACT", wanted, position), build.math("MULTIPLY", low, close))
    lift = build.node("GeometryNodeSetPosition")
    build.link(geometry, lift.inputs["Geometry"])
    build.link(might, lift.inputs["Selection"])
    build.link(way, lift.inputs["Offset"])
    return lift.outputs["Geometry"]
