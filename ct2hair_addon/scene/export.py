"""Results out of the scene: .blend, Alembic with groom attributes, USD; each file written beside its target and renamed.

Alembic is written by alembic3d, after Unreal's "Alembic for Grooms" conventions, since Blender's own exporter drops every
attribute. USD is Blender's exporter, which turns every attribute into a primvar.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ..errors import CT2HairError
from ..strands import Strands
from .frames import MM
from .hair import strands_of, usable
from .head import SCALP_UV
from .results import HairResult

GROOM_VERSION = (1, 5)
"""Version of the groom conventions that the Alembic file follows (major, minor)."""
_UNITS = {"m": 1.0, "cm": 100.0}
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
    """Save a copy of the whole file at `path`; the session goes on with the file it had. Volume paths are made relative."""
    path = Path(path).resolve()
    absolute = {volume: bpy.path.abspath(volume.filepath) for volume in bpy.data.volumes if volume.filepath}
    before = {volume: volume.filepath for volume in absolute}
    with written_beside(path) as beside:
        try:
            for volume, filepath in absolute.items():
                with contextlib.suppress(ValueError):  # another drive: stays absolute
                    volume.filepath = bpy.path.relpath(filepath, start=str(path.parent))
            bpy.ops.wm.save_as_mainfile(filepath=str(beside), copy=True, compress=True, relative_remap=False)
        finally:
            for volume, filepath in before.items():
                volume.filepath = filepath
    return path


def write_usd(result: HairResult, path: str | os.PathLike) -> Path:
    """Export head, hair and guides as USD (.usda, .usdc or .usd): metres, Z up, attributes as primvars, widths in metres."""
    path = Path(path)
    if path.suffix.lower() not in (".usd", ".usda", ".usdc"):
        raise CT2HairError(f"{path}: USD files end in .usda, .usdc or .usd")
    known = set(bpy.ops.wm.usd_export.get_rna_type().properties.keys())
    options = {
        "export_animation": False,
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
    with written_beside(path) as beside, _export_collection(result) as collection:
        options = {key: value for key, value in options.items() if key in known}
        bpy.ops.wm.usd_export(filepath=str(beside), check_existing=False, collection=collection.name, **options)
    return path


def write_alembic(result: HairResult, path: str | os.PathLike, unit: str = "m") -> Path:
    """Export head, hair and guides as one Alembic archive (Ogawa, Y up), posed as the scene shows them.

    unit: "m", or "cm" as Unreal wants. Below `/groom`: `hair` and `guides` (curves, root first, with groom_guide,
    groom_group_id, groom_id, groom_root_uv, groom_width and the strands' own arrays) and `head` (polygons with the scalp's
    UV), each a transform with its shape. Widths are diameters in the same unit.
    """
    if unit not in _UNITS:
        raise CT2HairError(f"unit '{unit}' is not known; Alembic files are written in {' or '.join(_UNITS)}")
    try:
        import imath
        from alembic3d import Abc, AbcGeom
    except ImportError:
        raise CT2HairError("Alembic needs the package alembic3d, which comes with the extension: install it again") from None
    path, scale = Path(path), _UNITS[unit]
    with written_beside(path) as beside:
        archive = Abc.CreateArchiveWithInfo(str(beside), "CT2Hair for Blender", f"Y up, {unit}")
        try:
            top = archive.getTop()
            groom = AbcGeom.OXform(top, "groom")
            # Unreal looks for the version on the top node; other readers take it from the groom's own node
            for node in (top.getProperties(), groom.getProperties()):
                for key, value in zip(("major", "minor"), GROOM_VERSION, strict=True):
                    Abc.OInt16Property(node, f"groom_version_{key}").setValue(value)
            Abc.OStringProperty(groom.getProperties(), "groom_tool").setValue("CT2Hair for Blender")
            for ob, name, guide in ((result.hair, "hair", 0), (result.guides, "guides", 1)):
                if ob is not None:
                    _write_curves(AbcGeom, imath, groom, name, ob, guide, scale)
            _write_head(AbcGeom, imath, groom, result.head, scale)
        finally:
            # closing is by reference count: every handle must go before the file is whole
            groom = top = node = archive = None
    return path


def y_up(points: np.ndarray) -> np.ndarray:
    """(M, 3): Blender's Z up turned to Y up, (x, y, z) -> (x, z, -y)."""
    return np.ascontiguousarray(np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1), np.float32)


def _write_curves(AbcGeom, imath, parent, name: str, ob: bpy.types.Object, guide: int, scale: float) -> None:
    """One OCurves of a hair object as the scene shows it, in world space, with its groom attributes."""
    strands = world_strands(ob)
    count = len(strands)
    points = y_up(strands.points) * np.float32(scale)
    curves = AbcGeom.OCurves(AbcGeom.OXform(parent, name), f"{name}Shape")
    schema = curves.getSchema()
    sample = AbcGeom.OCurvesSchemaSample()
    sample.setPositions(imath.V3fArrayFromBuffer(points))
    sample.setCurvesNumVertices(imath.IntArrayFromBuffer(strands.counts.astype(np.int32)))
    sample.setType(AbcGeom.CurveType.kLinear)
    sample.setBasis(AbcGeom.BasisType.kNoBasis)  # Blender reads linear curves of any other basis as Bezier
    sample.setWrap(AbcGeom.CurvePeriodicity.kNonPeriodic)
    widths = (2 * scale * strands.point_attributes["radius"]).astype(np.float32)
    vertex, uniform = AbcGeom.GeometryScope.kVertexScope, AbcGeom.GeometryScope.kUniformScope
    sample.setWidths(AbcGeom.OFloatGeomParamSample(imath.FloatArrayFromBuffer(widths), vertex))
    schema.set(sample)

    arbitrary = schema.getArbGeomParams()

    def put(key: str, values: np.ndarray, scope) -> None:
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
        param = getattr(AbcGeom, f"O{kind}GeomParam")(arbitrary, key, False, scope, 1)
        param.set(getattr(AbcGeom, f"O{kind}GeomParamSample")(array, scope))

    param = AbcGeom.OInt16GeomParam(arbitrary, "groom_guide", False, uniform, 1)
    param.set(AbcGeom.OInt16GeomParamSample(imath.ShortArray(guide, count), uniform))
    put("groom_group_id", strands.strand_attributes.get("group_id", np.zeros(count, np.int32)), uniform)
    put("groom_id", np.arange(count, dtype=np.int32), uniform)
    if "root_uv" in strands.strand_attributes:
        put("groom_root_uv", strands.strand_attributes["root_uv"], uniform)
    put("groom_width", widths, vertex)
    for attributes, scope in ((strands.strand_attributes, uniform), (strands.point_attributes, vertex)):
        for key, values in attributes.items():
            if key not in _RESERVED:
                put(key, values, scope)


def _write_head(AbcGeom, imath, parent, ob: bpy.types.Object, scale: float) -> None:
    """The head as the scene shows it, in world space, with its scalp UV."""
    source = ob.evaluated_get(bpy.context.evaluated_depsgraph_get())
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
    points = y_up(_moved(vertices.reshape(-1, 3), ob.matrix_world)) * np.float32(scale)
    # Alembic's polygons run clockwise seen from outside: turn each round, and its UV with it
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    turned = np.repeat(starts + starts + counts - 1, counts) - np.arange(len(corners))
    sample = AbcGeom.OPolyMeshSchemaSample(
        imath.V3fArrayFromBuffer(points),
        imath.IntArrayFromBuffer(np.ascontiguousarray(corners[turned])),
        imath.IntArrayFromBuffer(counts),
    )
    if layer is not None:
        face_varying = AbcGeom.GeometryScope.kFacevaryingScope
        array = imath.V2fArrayFromBuffer(np.ascontiguousarray(uv.reshape(-1, 2)[turned]))
        sample.setUVs(AbcGeom.OV2fGeomParamSample(array, face_varying))
    AbcGeom.OPolyMesh(AbcGeom.OXform(parent, "head"), "headShape").getSchema().set(sample)


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
