"""A Cycles picture of a result: a studio of its own (camera, three lights, backdrop), so that the user's scene stays."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..errors import CT2HairError
from .export import world_strands, written_beside
from .hair import full_width_factor, set_width_factor
from .results import HairResult

LENS = 85.0
"""Focal length, mm on a 36 mm sensor: a portrait's."""
MARGIN = 0.9
"""Share of the picture that head and hair fill."""
EYE = {"front": 0.0, "three_quarter": -35.0, "side": -90.0, "back": 180.0}
"""Views by name: degrees round the head, 0 before the face, negative to the wearer's right."""


@dataclass(frozen=True)
class Light:
    """A light of the studio: direction from the head (degrees round and up), power at a distance of 1 m, edge, colour."""

    around: float
    above: float
    power: float
    edge: float
    colour: tuple[float, float, float]


STUDIO = (
    Light(35.0, 38.0, 13.0, 0.5, (1.0, 0.96, 0.9)),  # key
    Light(-60.0, 12.0, 3.0, 0.9, (0.86, 0.92, 1.0)),  # fill
    Light(160.0, 45.0, 20.0, 0.4, (1.0, 0.98, 0.95)),  # rim, which makes single strands shine
    Light(-140.0, 35.0, 10.0, 0.4, (0.92, 0.95, 1.0)),  # second rim
)


def render_picture(
    result: HairResult,
    path: str | Path,
    *,
    view: str | float = "three_quarter",
    elevation: float = 6.0,
    samples: int = 64,
    size: int = 800,
    width_factor: float | None = None,
) -> Path:
    """Render head and hair with Cycles into a PNG at `path`, framed whole, in a scene that is removed again.

    view: one of `EYE`, or degrees round the head. elevation: degrees above it. size: pixels of an edge. width_factor: widths
    times this; None makes up for strands that are missing from a full head of hair (`full_width_factor`). Blocks.
    """
    if isinstance(view, str) and view not in EYE:
        raise CT2HairError(f"view '{view}' is not known; choose {', '.join(EYE)} or give degrees")
    around = EYE[view] if isinstance(view, str) else float(view)
    with _studio(result, around, elevation, width_factor) as scene, written_beside(Path(path).resolve()) as beside:
        _set_up_render(scene, samples, size)
        scene.render.filepath = str(beside)
        bpy.ops.render.render(write_still=True, scene=scene.name)
    return Path(path)


def render_turntable(
    result: HairResult, folder: str | Path, *, frames: int = 24, samples: int = 48, size: int = 600, elevation: float = 6.0
) -> list[Path]:
    """Render `frames` pictures round the head into `folder`/turntable_0000.png and on; the lights turn with the camera."""
    width = full_width_factor(result.hair)
    return [
        render_picture(
            result,
            Path(folder) / f"turntable_{frame:04d}.png",
            view=EYE["three_quarter"] - 360.0 * frame / frames,
            elevation=elevation,
            samples=samples,
            size=size,
            width_factor=width,
        )
        for frame in range(frames)
    ]


@contextlib.contextmanager
def _studio(result: HairResult, around: float, elevation: float, width_factor: float | None) -> Iterator[bpy.types.Scene]:
    """A scene with head, hair, camera, lights and backdrop; removed, and the hair's width set back, when the block ends."""
    scene = bpy.data.scenes.new("CT2Hair Picture")
    made = []
    try:
        for ob in (result.root, result.head, result.hair):
            if ob is not None:
                scene.collection.objects.link(ob)
        set_width_factor(result.hair, full_width_factor(result.hair) if width_factor is None else width_factor)
        frame = np.array(result.head.matrix_world.to_3x3().normalized())
        points = _framed_points(result)
        made += _add_camera(scene, points, frame @ _axes(around, elevation))
        centre, radius = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0).max() / 2
        for light in STUDIO:
            made += _add_light(scene, light, centre, radius, frame, around)
        made.append(_add_backdrop(scene))
        yield scene
    finally:
        set_width_factor(result.hair, 1.0)
        bpy.data.scenes.remove(scene)
        bpy.data.batch_remove(made)


def _framed_points(result: HairResult) -> np.ndarray:
    """(M, 3) m: hair and head in world space, without what of the neck and bust hangs below the hair and chin."""
    hair = world_strands(result.hair).points
    vertices = np.empty(len(result.head.data.vertices) * 3, np.float32)
    result.head.data.vertices.foreach_get("co", vertices)
    matrix = np.array(result.head.matrix_world)
    head = vertices.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    up = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    height = head @ up
    face = height.max() - 0.26  # a head is 22 to 25 cm from crown to chin
    lowest = min(face, np.quantile(hair @ up, 0.002))
    return np.concatenate([hair[:: max(1, len(hair) // 200_000)], head[height >= lowest]])


def _axes(around: float, elevation: float) -> np.ndarray:
    """(3, 3) columns right, up, back of a camera that looks at the head's middle from there, in the head's frame."""
    a, e = math.radians(around), math.radians(elevation)
    back = np.array([math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e)])
    right = np.array([math.cos(a), math.sin(a), 0.0])
    return np.stack([right, np.cross(back, right), back], axis=1)


def _add_camera(scene: bpy.types.Scene, points: np.ndarray, axes: np.ndarray) -> list[bpy.types.ID]:
    """A camera along -back that just holds all points: the planes of its frustum are moved onto the outermost ones."""
    slope = 18.0 / LENS * MARGIN
    right, up, depth = points @ axes[:, 0], points @ axes[:, 1], -(points @ axes[:, 2])
    position, near = np.zeros(3), []
    for axis, along in ((0, right), (1, up)):
        high, low = (along - slope * depth).max(), (-along - slope * depth).max()
        position[axis] = (high - low) / 2
        near.append(-(high + low) / (2 * slope))
    position[2] = -min(near)
    data = bpy.data.cameras.new("CT2Hair Camera")
    data.lens, data.sensor_width, data.clip_start = LENS, 36.0, 0.01
    camera = bpy.data.objects.new("CT2Hair Camera", data)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, axes @ position
    camera.matrix_world = Matrix(matrix.tolist())
    scene.collection.objects.link(camera)
    scene.camera = camera
    return [camera, data]


def _add_light(scene, light: Light, centre: np.ndarray, radius: float, frame: np.ndarray, around: float) -> list[bpy.types.ID]:
    """An area light that looks at the head; power grows with the distance, so that any head is lit alike."""
    distance = 6.0 * radius
    direction = frame @ _axes(around + light.around, light.above)[:, 2]
    data = bpy.data.lights.new("CT2Hair Light", "AREA")
    data.shape, data.size = "DISK", light.edge * distance
    data.energy, data.color = light.power * distance**2, light.colour
    ob = bpy.data.objects.new("CT2Hair Light", data)
    ob.location = centre + distance * direction
    ob.rotation_euler = Vector(direction).to_track_quat("Z", "Y").to_euler()
    ob.visible_camera = False
    scene.collection.objects.link(ob)
    return [ob, data]


def _add_backdrop(scene: bpy.types.Scene) -> bpy.types.World:
    """A neutral grey behind everything, lighter in the middle of the picture, and a faint even light from all sides."""
    world = bpy.data.worlds.new("CT2Hair Backdrop")
    if world.node_tree is None:  # always there from 5.0 on
        world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    out, seen, lit = nodes.new("ShaderNodeOutputWorld"), nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeBackground")
    lit.inputs["Color"].default_value, lit.inputs["Strength"].default_value = (0.9, 0.95, 1.0, 1.0), 0.15
    path, mix = nodes.new("ShaderNodeLightPath"), nodes.new("ShaderNodeMixShader")
    window, offset = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeVectorMath")
    offset.operation = "DISTANCE"
    offset.inputs[1].default_value = (0.5, 0.55, 0.0)
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.interpolation = "EASE"
    ramp.color_ramp.elements[0].color = (0.30, 0.30, 0.305, 1.0)
    ramp.color_ramp.elements[1].color = (0.075, 0.075, 0.08, 1.0)
    ramp.color_ramp.elements[1].position = 0.8
    links.new(window.outputs["Window"], offset.inputs[0])
    links.new(offset.outputs["Value"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], seen.inputs["Color"])
    links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    links.new(lit.outputs["Background"], mix.inputs[1])
    links.new(seen.outputs["Background"], mix.inputs[2])
    links.new(mix.outputs["Shader"], out.inputs["Surface"])
    scene.world = world
    return world


def _set_up_render(scene: bpy.types.Scene, samples: int, size: int) -> None:
    """Cycles for hair: enough bounces for light to cross a head of hair, denoised where this Blender can."""
    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.film_transparent = False
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.cycles_curves.shape = "RIBBONS"
    scene.cycles_curves.subdivisions = 2
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = samples
    cycles.seed = 0
    cycles.use_adaptive_sampling = True
    cycles.adaptive_threshold = 0.02
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces, cycles.transmission_bounces = 12, 3, 8, 12
    cycles.use_denoising = False
    with contextlib.suppress(TypeError):  # a Blender without OpenImageDenoise does not know the name
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.use_denoising = True
