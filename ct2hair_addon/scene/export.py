"""Results out of the scene: .blend, Alembic with groom attributes, USD, strand files; written beside their target and renamed.

Alembic is written by alembic3d, after Unreal's "Alembic for Grooms" conventions, since Blender's own exporter drops every
attribute. USD is Blender's exporter, which turns every attribute into a primvar.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ..errors import CT2HairError
from ..strand_files import write_strands
from ..strands import Strands
from .frames import MM
from .hair import named_apart, strands_of, usable
from .head import SCALP_UV
from .results import HairResult

GROOM_VERSION = (1, 5)
"""Version of the groom conventions that the Alembic file follows (major, minor)."""
_UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
"""Units that coordinates are written in, by how many of them make a metre."""
_RESERVED = {"root_uv", "group_id", "radius"}


@contextlib.contextmanager
def written_beside(path: str | os.PathLike) -> Iterator[Path]:
    """A path beside `path`, of the same suffix, to write to: renamed to `path` when the block is through, else removed."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".part-{path.name}")
    try:
        yield beside
        if not beside.is_file():
            raise CT2HairError(f"{path}: Blender wrote no file; see its console for the reason")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def write_blend(path: str | os.PathLike) -> Path:
    """Save a copy of the whole file at `path`; the session goes on with the file it had. Paths of volumes and motion are made
    relative."""
    path = Path(path).resolve()
    caches = [modifier for ob in bpy.data.objects for modifier in ob.modifiers if modifier.type == "MESH_CACHE"]
    users = [user for user in (*bpy.data.volumes, *caches) if user.filepath]
    absolute = [bpy.path.abspath(user.filepath) for user in users]
    before = [user.filepath for user in users]
    with written_beside(path) as beside:
        try:
            for user, filepath in zip(users, absolute, strict=True):
                with contextlib.suppress(ValueError):  # another drive: stays absolute
                    user.filepath = bpy.path.relpath(filepath, start=str(path.parent))
            bpy.ops.wm.save_as_mainfile(filepath=str(beside), copy=True, compress=True, relative_remap=False)
        finally:
            for user, filepath in zip(users, before, strict=True):
                user.filepath = filepath
    return path


def write_usd(result: HairResult, path: str | os.PathLike, *, frames: tuple[int, int] | None = None) -> Path:
    """Export head, hair and guides as USD (.usda, .usdc or .usd): metres, Z up, attributes as primvars, widths in metres.

    frames: (first, last) of an animation; None writes the hair as the scene shows it now.
    """
    path = Path(path)
    if path.suffix.lower() not in (".usd", ".usda", ".usdc"):
        raise CT2HairError(f"{path}: USD files end in .usda, .usdc or .usd")
    known = set(bpy.ops.wm.usd_export.get_rna_type().properties.keys())
    options = {
        "export_animation": frames is not None,
        "export_hair": False,  # particle hair; curves are exported by export_curves
        "export_curves": True,
        "export_volumes": False,
        "export_lights": False,
        "export_cameras": False,
        "export_materials": True,
        "evaluation_mode": "VIEWPORT",  # with RENDER the guides, which are not rendered, would be left out
        "export_custom_properties": False,
        "convert_world_material": False,
        "visible_objects_only": False,  # gone in 5.0
    }
    with written_beside(path) as beside, _export_collection(result) as collection, _frame_range(frames):
        options = {key: value for key, value in options.items() if key in known}
        bpy.ops.wm.usd_export(filepath=str(beside), check_existing=False, collection=collection.name, **options)
    return path


def write_strand_file(result: HairResult, path: str | os.PathLike, unit: str = "mm", up: str = "z") -> Path:
    """Write the hair, posed as the scene shows it, as CT2Hair .bin, USC-HairSalon .data, Cem Yuksel's .hair or our .npz.

    unit: "mm", "cm" or "m" of the coordinates, which are the scene's. up: "z", or "y" as in USC-HairSalon's own files.
    """
    if unit not in _UNITS:
        raise CT2HairError(f"unit '{unit}' is not known; strand files are written in {', '.join(_UNITS)}")
    strands = world_strands(result.hair)
    points = _turned_up(strands.points, up) * np.float32(_UNITS[unit])
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_strands(strands.with_points(points), path)
    return path


def write_alembic(
    result: HairResult,
    path: str | os.PathLike,
    unit: str = "m",
    up: str = "y",
    *,
    frames: tuple[int, int] | None = None,
) -> Path:
    """Export head, hair and guides as one Alembic archive (Ogawa), posed as the scene shows them.

    unit: "m" (Houdini), "cm" (Unreal, Maya) or "mm". up: "y", or "z". frames: (first, last) of an animation; None writes
    the hair as the scene shows it now. Below `/groom`: `hair` and `guides` (curves, root first, with groom_guide,
    groom_group_id, groom_id, groom_root_uv, groom_width and the strands' own arrays) and `head` (polygons with the scalp's
    UV), each a transform with its shape. Widths are diameters in the same unit.
    """
    if unit not in _UNITS:
        raise CT2HairError(f"unit '{unit}' is not known; Alembic files are written in {', '.join(_UNITS)}")
    try:
        from alembic3d import Abc, AbcCoreAbstract, AbcGeom
    except ImportError:
        raise CT2HairError("Alembic needs the package alembic3d, which comes with the extension: install it again") from None
    path, layout = Path(path), _Layout(_UNITS[unit], up)
    with written_beside(path) as beside:
        archive = Abc.CreateArchiveWithInfo(str(beside), "CT2Hair for Blender", f"{up.upper()} up, {unit}")
        try:
            sampling = 0
            if frames is not None:
                render = bpy.context.scene.render
                seconds = render.fps_base / render.fps
                sampling = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(seconds, frames[0] * seconds))
            top = archive.getTop()
            groom = AbcGeom.OXform(top, "groom")
            # Unreal looks for the version on the top node; other readers take it from the groom's own node
            for node in (top.getProperties(), groom.getProperties()):
                for key, value in zip(("major", "minor"), GROOM_VERSION, strict=True):
                    Abc.OInt16Property(node, f"groom_version_{key}").setValue(value)
            Abc.OStringProperty(groom.getProperties(), "groom_tool").setValue("CT2Hair for Blender")
            writers = [
                _CurvesWriter(AbcGeom, groom, name, ob, guide, layout, sampling)
                for ob, name, guide in ((result.hair, "hair", 0), (result.guides, "guides", 1))
                if ob is not None
            ]
            writers.append(_HeadWriter(AbcGeom, groom, result.head, layout, sampling))
            for _ in _each_frame(frames):
                for writer in writers:
                    writer.write()
        finally:
            # closing is by reference count: every handle must go before the file is whole
            groom = top = node = archive = writer = None
            writers = []
    return path


@dataclass(frozen=True)
class _Layout:
    """How points of the scene (metres, Z up) are written: times `scale`, `up` being the axis up."""

    scale: float
    up: str

    def points(self, points: np.ndarray) -> np.ndarray:
        return _turned_up(points, self.up) * np.float32(self.scale)


def _turned_up(points: np.ndarray, up: str) -> np.ndarray:
    if up not in ("y", "z"):
        raise CT2HairError(f"up axis '{up}' is not known; choose y or z")
    return y_up(points) if up == "y" else np.ascontiguousarray(points, np.float32)


def _each_frame(frames: tuple[int, int] | None) -> Iterator[None]:
    """Once as the scene stands, or once at each of `frames`; the scene's frame is set back afterwards."""
    if frames is None:
        yield
        return
    scene = bpy.context.scene
    before = scene.frame_current
    try:
        for frame in range(frames[0], frames[1] + 1):
            scene.frame_set(frame)
            yield
    finally:
        scene.frame_set(before)


@contextlib.contextmanager
def _frame_range(frames: tuple[int, int] | None) -> Iterator[None]:
    """The scene's range of frames while the block runs."""
    scene = bpy.context.scene
    before = scene.frame_start, scene.frame_end
    try:
        if frames is not None:
            scene.frame_start, scene.frame_end = frames
        yield
    finally:
        scene.frame_start, scene.frame_end = before


def y_up(points: np.ndarray) -> np.ndarray:
    """(M, 3): Blender's Z up turned to Y up, (x, y, z) -> (x, z, -y)."""
    return np.ascontiguousarray(np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1), np.float32)


class _CurvesWriter:
    """One OCurves of a hair object as the scene shows it, in world space, with its groom attributes; a sample a frame."""

    def __init__(self, AbcGeom, parent, name: str, ob: bpy.types.Object, guide: int, layout: _Layout, sampling: int) -> None:
        self._geom, self._object, self._guide, self._layout = AbcGeom, ob, guide, layout
        curves = AbcGeom.OCurves(AbcGeom.OXform(parent, name), f"{name}Shape", sampling)
        self._schema = curves.getSchema()
        self._counts: np.ndarray | None = None

    def write(self) -> None:
        import imath

        strands = world_strands(self._object)
        sample = self._geom.OCurvesSchemaSample()
        sample.setPositions(imath.V3fArrayFromBuffer(self._layout.points(strands.points)))
        sample.setCurvesNumVertices(imath.IntArrayFromBuffer(strands.counts.astype(np.int32)))
        sample.setType(self._geom.CurveType.kLinear)
        sample.setBasis(self._geom.BasisType.kNoBasis)  # Blender reads linear curves of any other basis as Bezier
        sample.setWrap(self._geom.CurvePeriodicity.kNonPeriodic)
        widths = (2 * self._layout.scale * strands.point_attributes["radius"]).astype(np.float32)
        vertex = self._geom.GeometryScope.kVertexScope
        sample.setWidths(self._geom.OFloatGeomParamSample(imath.FloatArrayFromBuffer(widths), vertex))
        self._schema.set(sample)
        if self._counts is None:
            self._counts = strands.counts
            self._write_attributes(strands, widths)
        elif not np.array_equal(strands.counts, self._counts):
            raise CT2HairError(f"'{self._object.name}' has other strands in a later frame; all frames need the same")

    def _write_attributes(self, strands: Strands, widths: np.ndarray) -> None:
        """The groom attributes and the strands' own, once: they don't move."""
        import imath

        vertex, uniform = self._geom.GeometryScope.kVertexScope, self._geom.GeometryScope.kUniformScope
        arbitrary, count = self._schema.getArbGeomParams(), len(strands)
        param = self._geom.OInt16GeomParam(arbitrary, "groom_guide", False, uniform, 1)
        param.set(self._geom.OInt16GeomParamSample(imath.ShortArray(self._guide, count), uniform))
        self._put("groom_group_id", strands.strand_attributes.get("group_id", np.zeros(count, np.int32)), uniform)
        self._put("groom_id", np.arange(count, dtype=np.int32), uniform)
        if "root_uv" in strands.strand_attributes:
            self._put("groom_root_uv", strands.strand_attributes["root_uv"], uniform)
        self._put("groom_width", widths, vertex)
        for attributes, scope in ((named_apart(strands), uniform), (strands.point_attributes, vertex)):
            for key, values in attributes.items():
                if key not in _RESERVED:
                    self._put(key, values, scope)

    def _put(self, key: str, values: np.ndarray, scope) -> None:
        """An array as a geometry parameter of the type that fits; others are left out."""
        import imath

        kind = {("i", 1): "Int32", ("u", 1): "Int32", ("f", 1): "Float", ("f", 2): "V2f", ("f", 3): "V3f"}.get(
            (values.dtype.kind, values.shape[1] if values.ndim > 1 else 1)
        )
        if kind is None:
            return
        if kind == "Int32":
            array = imath.IntArrayFromBuffer(np.ascontiguousarray(values, np.int32))
        else:
            from_buffer = getattr(imath, {"Float": "FloatArray", "V2f": "V2fArray", "V3f": "V3fArray"}[kind] + "FromBuffer")
            array = from_buffer(np.ascontiguousarray(values, np.float32))
        param = getattr(self._geom, f"O{kind}GeomParam")(self._schema.getArbGeomParams(), key, False, scope, 1)
        param.set(getattr(self._geom, f"O{kind}GeomParamSample")(array, scope))


class _HeadWriter:
    """The head as the scene shows it, in world space, with its scalp UV; a sample a frame."""

    def __init__(self, AbcGeom, parent, ob: bpy.types.Object, layout: _Layout, sampling: int) -> None:
        self._geom, self._object, self._layout = AbcGeom, ob, layout
        self._schema = AbcGeom.OPolyMesh(AbcGeom.OXform(parent, "head"), "headShape", sampling).getSchema()

    def write(self) -> None:
        import imath

        source = self._object.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = source.to_mesh()
        try:
            vertices = np.empty(len(mesh.vertices) * 3, np.float32)
            mesh.vertices.foreach_get("co", vertices)
            corners = np.empty(len(mesh.loops), np.int32)
            mesh.loops.foreach_get("vertex_index", corners)
            counts = np.empty(len(mesh.polygons), np.int32)
            mesh.polygons.foreach_get("loop_total", counts)
            layer = mesh.uv_layers.get(SCALP_UV)
            uv = np.empty(len(mesh.loops) * 2, np.float32)
            if layer is not None:
                layer.uv.foreach_get("vector", uv)
        finally:
            source.to_mesh_clear()
        points = self._layout.points(_moved(vertices.reshape(-1, 3), self._object.matrix_world))
        # Alembic's polygons run clockwise seen from outside: turn each round, and its UV with it
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        turned = np.repeat(starts + starts + counts - 1, counts) - np.arange(len(corners))
        sample = self._geom.OPolyMeshSchemaSample(
            imath.V3fArrayFromBuffer(points),
            imath.IntArrayFromBuffer(np.ascontiguousarray(corners[turned])),
            imath.IntArrayFromBuffer(counts),
        )
        if layer is not None:
            face_varying = self._geom.GeometryScope.kFacevaryingScope
            array = imath.V2fArrayFromBuffer(np.ascontiguousarray(uv.reshape(-1, 2)[turned]))
            sample.setUVs(self._geom.OV2fGeomParamSample(array, face_varying))
        self._schema.set(sample)


def world_strands(ob: bpy.types.Object) -> Strands:
    """The strands of a hair object as the scene shows them, in world space and metres; unusable ones left out."""
    strands, _ = usable(strands_of(ob, evaluated=True))
    return strands.with_points(_moved(strands.points * np.float32(MM), ob.matrix_world))


def _moved(points: np.ndarray, matrix) -> np.ndarray:
    matrix = np.array(matrix, np.float64)
    if np.array_equal(matrix, np.eye(4)):
        return points
    return (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


@contextlib.contextmanager
def _export_collection(result: HairResult) -> Iterator[bpy.types.Collection]:
    """A collection of what is to be exported, in the scene and shown while the block runs."""
    collection = bpy.data.collections.new(f"{result.collection.name} Export")
    objects = [ob for ob in (result.root, result.head, result.hair, result.guides) if ob is not None]
    for ob in objects:
        collection.objects.link(ob)
    bpy.context.scene.collection.children.link(collection)
    hidden = [(ob, ob.hide_viewport) for ob in objects]
    try:
        for ob in objects:
            ob.hide_viewport = False
        yield collection
    finally:
        for ob, value in hidden:
            ob.hide_viewport = value
        bpy.data.collections.remove(collection)
