"""Files out of the scene, read back by others: alembic3d, Pixar's USD, and Blender itself."""

import bpy
import numpy as np
import pytest

from ct2hair_addon import scene
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.scene.export import written_beside, y_up

from .conftest import block_counts

MICROMETRE = 1e-6


@pytest.fixture
def result(job_folder):
    """A result whose head is moved and bent: what is written must be what is seen."""
    result = scene.load_result(job_folder)
    result.root.location = 0.1, 0.2, 0.3
    result.root.rotation_euler = 0, 0, 0.7
    result.head.shape_key_add(name="Basis")
    key = result.head.shape_key_add(name="Grow")
    for point in key.data:
        point.co.x *= 1.1
    key.value = 1.0
    bpy.context.view_layer.update()
    return result


def world_points(ob) -> np.ndarray:
    points = scene.strands_of(ob, evaluated=True).points / 1000
    matrix = np.array(ob.matrix_world)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def imported() -> dict[str, list]:
    bpy.context.view_layer.update()
    kinds = {"CURVES": [], "MESH": []}
    for ob in bpy.context.scene.objects:
        if ob.type in kinds:
            kinds[ob.type].append(ob)
    return {
        kind: sorted(obs, key=lambda ob: -len(ob.data.points if kind == "CURVES" else ob.data.vertices))
        for kind, obs in kinds.items()
    }


def new_scene():
    bpy.context.window.scene = bpy.data.scenes.new("Import")


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 100.0)])
def test_alembic_holds_the_groom_attributes_that_unreal_reads(result, tmp_path, unit, scale):
    Abc = pytest.importorskip("alembic3d").Abc
    from alembic3d import AbcGeom

    archive = Abc.IArchive(str(scene.write_alembic(result, tmp_path / "hair.abc", unit)))
    top = archive.getTop()
    version = [Abc.IInt16Property(top.getProperties(), f"groom_version_{key}").getValue() for key in ("major", "minor")]
    assert version == [1, 5]
    groom = top.children[0]
    wanted = {"hair": (result.hair, 0), "guides": (result.guides, 1)}
    for node in groom.children:
        if node.getName() == "head":
            mesh = AbcGeom.IPolyMesh(node, "headShape").getSchema().getValue()
            assert len(mesh.getPositions()) == len(result.head.data.vertices)
            continue
        ob, guide = wanted.pop(node.getName())
        schema = AbcGeom.ICurves(node, f"{node.getName()}Shape").getSchema()
        sample = schema.getValue()
        positions = np.asarray(memoryview(sample.getPositions()))
        np.testing.assert_allclose(positions, scale * y_up(world_points(ob)), atol=scale * MICROMETRE)
        strands = scene.strands_of(ob)
        assert list(sample.getCurvesNumVertices()) == strands.counts.tolist()
        arbitrary = schema.getArbGeomParams()

        def values(kind, name, arbitrary=arbitrary):
            param = getattr(AbcGeom, f"I{kind}GeomParam")(arbitrary, name)
            sample = param.getExpandedValue()
            return list(sample.getVals()), sample.getScope()

        uniform, vertex = AbcGeom.GeometryScope.kUniformScope, AbcGeom.GeometryScope.kVertexScope
        assert values("Int16", "groom_guide") == ([guide] * len(strands), uniform)
        assert values("Int32", "groom_id") == (list(range(len(strands))), uniform)
        assert values("Int32", "groom_group_id") == ([0] * len(strands), uniform)
        uv, scope = values("V2f", "groom_root_uv")
        np.testing.assert_allclose([(v.x, v.y) for v in uv], strands.strand_attributes["root_uv"], atol=1e-7)
        width, scope = values("Float", "groom_width")
        assert scope == vertex
        np.testing.assert_allclose(width, 2 * scale * strands.point_attributes["radius"], rtol=1e-5)
        support, scope = values("Float", "support" if guide else "strand_support")
        assert scope == uniform
        np.testing.assert_allclose(support, strands.strand_attributes["support"])
        if not guide:
            support, scope = values("Float", "support")
            assert scope == vertex
            np.testing.assert_allclose(support, strands.point_attributes["support"])
    assert not wanted


def test_alembic_comes_back_into_blender(result, tmp_path):
    pytest.importorskip("alembic3d")
    if not bpy.app.build_options.alembic:
        pytest.skip("this Blender was built without Alembic")
    hair, guides = world_points(result.hair), world_points(result.guides)
    head = result.head.evaluated_get(bpy.context.evaluated_depsgraph_get())
    corners = [head.matrix_world @ v.co for v in head.data.vertices]
    path = scene.write_alembic(result, tmp_path / "hair.abc")
    new_scene()
    bpy.ops.wm.alembic_import(filepath=str(path), as_background_job=False)
    back = imported()
    assert [len(ob.data.curves) for ob in back["CURVES"]] == [200, 20]
    for ob, points in zip(back["CURVES"], (hair, guides), strict=True):
        np.testing.assert_allclose(world_points(ob), points, atol=MICROMETRE)
    mesh = back["MESH"][0]
    np.testing.assert_allclose([mesh.matrix_world @ v.co for v in mesh.data.vertices], corners, atol=MICROMETRE)
    assert all(p.normal.dot(p.center - mesh.data.vertices[0].co) is not None for p in mesh.data.polygons)
    outward = np.array([p.normal for p in mesh.data.polygons])
    middle = np.mean([v.co for v in mesh.data.vertices], axis=0)
    assert (np.einsum("px,px->p", outward, np.array([p.center for p in mesh.data.polygons]) - middle) > 0).all()


def test_usd_comes_back_into_blender(result, tmp_path):
    if not bpy.app.build_options.usd:
        pytest.skip("this Blender was built without USD")
    before = block_counts()
    hair, guides = world_points(result.hair), world_points(result.guides)
    strands = scene.strands_of(result.hair)
    path = scene.write_usd(result, tmp_path / "hair.usda")
    assert block_counts() == before
    new_scene()
    bpy.ops.wm.usd_import(filepath=str(path))
    back = imported()
    assert [len(ob.data.curves) for ob in back["CURVES"]] == [200, 20]
    for ob, points in zip(back["CURVES"], (hair, guides), strict=True):
        np.testing.assert_allclose(world_points(ob), points, atol=MICROMETRE)
    again = scene.strands_of(back["CURVES"][0])
    np.testing.assert_allclose(again.strand_attributes["support"], strands.strand_attributes["support"], atol=1e-6)
    np.testing.assert_array_equal(again.strand_attributes["group_id"], strands.strand_attributes["group_id"])
    np.testing.assert_allclose(again.strand_attributes["root_uv"], strands.strand_attributes["root_uv"], atol=1e-6)
    np.testing.assert_allclose(again.point_attributes["radius"], strands.point_attributes["radius"], rtol=1e-4)


def test_usd_holds_widths_and_primvars(result, tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    from pxr import UsdGeom

    stage = Usd.Stage.Open(str(scene.write_usd(result, tmp_path / "hair.usdc")))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    curves = {len(p.GetCurveVertexCountsAttr().Get()): p for p in map(UsdGeom.BasisCurves, stage.Traverse()) if p}
    assert sorted(curves) == [20, 200]
    hair = curves[200]
    radius = scene.strands_of(result.hair).point_attributes["radius"]
    np.testing.assert_allclose(hair.GetWidthsAttr().Get(), 2 * radius, rtol=1e-4)
    assert hair.GetTypeAttr().Get() == "linear"
    primvars = UsdGeom.PrimvarsAPI(hair)
    assert primvars.GetPrimvar("support").GetInterpolation() == "vertex"
    for name in ("strand_support", "group_id", "surface_uv_coordinate"):
        assert primvars.GetPrimvar(name).GetInterpolation() == "uniform", name
        assert len(primvars.GetPrimvar(name).Get()) == 200


def test_the_blend_file_opens_with_everything_in_it(result, tmp_path):
    path = scene.write_blend(tmp_path / "out" / "hair.blend")
    assert result.volume.data.filepath.startswith("/")  # the session's own path is as it was
    bpy.ops.wm.open_mainfile(filepath=str(path))
    again = scene.active_result()
    assert len(again.hair.data.curves) == 200 and again.guides and again.settings.run.seed == 3
    assert again.volume.data.filepath == "//../job/volume.vdb"
    assert again.volume.data.grids.load() and len(again.volume.data.grids) == 1


def test_bad_requests_are_refused_and_leave_nothing(result, tmp_path):
    with pytest.raises(CT2HairError, match="USD files end in"):
        scene.write_usd(result, tmp_path / "hair.txt")
    with pytest.raises(CT2HairError, match="unit 'inch'"):
        scene.write_alembic(result, tmp_path / "hair.abc", "inch")
    with pytest.raises(CT2HairError, match="unknown format fbx"):
        scene.export_all(result, tmp_path, formats=("fbx",))
    with pytest.raises(CT2HairError, match="wrote no file"), written_beside(tmp_path / "a.abc"):
        pass
    with pytest.raises(ZeroDivisionError), written_beside(tmp_path / "a.abc") as beside:
        beside.write_text("half a file")
        raise ZeroDivisionError
    assert not [path for path in tmp_path.iterdir() if path.is_file()]


def test_export_all_brings_the_report_along(result, tmp_path):
    written = scene.export_all(result, tmp_path / "out", formats=("blend", "usd"))
    assert set(written) == {"blend", "usd", "report.html", "report.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"hair.blend", "hair.usda", "report.html", "report.json"}


def test_usd_hair_has_a_preview_surface_of_its_colour(result, tmp_path):
    UsdShade = pytest.importorskip("pxr.UsdShade", reason="usd-core is not installed")
    from pxr import Usd

    stage = Usd.Stage.Open(str(scene.write_usd(result, tmp_path / "hair.usda")))
    shaders = [
        UsdShade.Shader(prim) for prim in stage.Traverse() if prim.IsA(UsdShade.Shader) and "Hair" in str(prim.GetPath())
    ]
    surface = next(shader for shader in shaders if shader.GetIdAttr().Get() == "UsdPreviewSurface")
    colour = result.hair.active_material.diffuse_color[:3]
    np.testing.assert_allclose(surface.GetInput("diffuseColor").Get(), colour, atol=1e-6)


def test_usd_passes_the_validators(result, tmp_path):
    """All validators of usd-core, without an error; materials bound to head, hair and guides."""
    UsdValidation = pytest.importorskip("pxr.UsdValidation", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(scene.write_usd(result, tmp_path / "hair.usda")))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 15
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert not errors, [error.GetMessage() for error in errors]
    shapes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)]
    assert len(shapes) == 3
    for prim in shapes:
        assert UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0], prim.GetPath()
