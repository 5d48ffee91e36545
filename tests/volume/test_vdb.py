"""BrickVolume through OpenVDB: the same volume back, its table and frame kept, and what OpenVDB itself sees of it."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from ct2hair_addon.errors import ScanError
from ct2hair_addon.volume import BrickVolume, load_vdb, openvdb_module, save_vdb
from ct2hair_addon.volume.openvdb_module import openvdb

ORIGIN = (5.0, -7.0, 11.0)


@pytest.fixture
def volume() -> BrickVolume:
    """A dense corner of 40 x 20 x 70 voxels far from the low corner, so that whole bricks are empty on all sides."""
    array = np.zeros((80, 60, 100), np.float32)
    generator = np.random.default_rng(4)
    array[40:57, 20:30, 33:60] = generator.normal(size=(17, 10, 27)).astype(np.float32)
    array[64, 45, 70] = 9.0
    return BrickVolume.from_dense(array, 0.4, ORIGIN)


def test_a_volume_comes_back_bit_for_bit_with_its_table_and_its_frame(volume, tmp_path):
    save_vdb(volume, tmp_path / "wig.vdb")
    back = load_vdb(tmp_path / "wig.vdb")
    assert back.table.shape == volume.table.shape
    np.testing.assert_array_equal(back.table >= 0, volume.table >= 0)
    np.testing.assert_array_equal(back.block((0, 0, 0), volume.shape), volume.block((0, 0, 0), volume.shape))
    np.testing.assert_allclose(back.origin, volume.origin, atol=1e-9)
    assert back.spacing == pytest.approx(0.4, rel=1e-9) and back.background == 0.0
    assert [file.name for file in tmp_path.iterdir()] == ["wig.vdb"]


def test_openvdb_sees_each_voxel_at_its_place(volume, tmp_path):
    save_vdb(volume, tmp_path / "wig.vdb", "hair")
    grid = openvdb().read(str(tmp_path / "wig.vdb"), "hair")
    accessor = grid.getConstAccessor()
    assert accessor.getValue((64, 45, 70)) == 9.0 and not accessor.isValueOn((63, 45, 70))
    np.testing.assert_allclose(grid.transform.indexToWorld((64, 45, 70)), np.add(ORIGIN, np.multiply(0.4, (64, 45, 70))))
    assert grid.activeVoxelCount() == np.count_nonzero(volume.bricks)


def test_a_background_that_is_not_0_is_kept(tmp_path):
    array = np.full((20, 20, 40), -5.0, np.float32)
    array[3, 4, 30] = 0.0
    volume = BrickVolume.from_dense(array, 1.0, background=-5.0)
    save_vdb(volume, tmp_path / "wig.vdb")
    back = load_vdb(tmp_path / "wig.vdb")
    assert back.background == -5.0
    np.testing.assert_array_equal(back.block((0, 0, 0), (32, 32, 48)), volume.block((0, 0, 0), (32, 32, 48)))


def test_an_empty_volume_comes_back_empty_and_of_its_size(tmp_path):
    save_vdb(BrickVolume.from_dense(np.zeros((20, 40, 60), np.float32), 0.5, ORIGIN), tmp_path / "wig.vdb")
    back = load_vdb(tmp_path / "wig.vdb")
    assert back.table.shape == (2, 3, 4) and not len(back.bricks) and (back.table == -1).all()


def test_another_programs_grid_is_laid_round_its_voxels_in_the_same_frame(tmp_path):
    vdb = openvdb()
    grid = vdb.FloatGrid()
    grid.name = "density"
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    matrix[3, :3] = ORIGIN
    grid.transform = vdb.createLinearTransform(matrix.tolist())
    values = np.arange(1, 61, dtype=np.float32).reshape(3, 4, 5)
    grid.copyFromArray(values, ijk=(-20, 33, 7))
    vdb.write(str(tmp_path / "wig.vdb"), grids=[grid])
    volume = load_vdb(tmp_path / "wig.vdb")
    at = np.argwhere(values > 0)
    places = np.add(ORIGIN, 0.5 * (at + [-20, 33, 7]))
    np.testing.assert_allclose(volume.sample(places), values[tuple(at.T)], atol=1e-4)
    assert np.count_nonzero(volume.bricks) == values.size


def test_what_is_no_plain_volume_is_refused(volume, tmp_path):
    with pytest.raises(ValueError, match="only numbers and vectors of three"):
        save_vdb(volume.like(np.float32, (2,)), tmp_path / "wig.vdb")
    with pytest.raises(ScanError, match=r"absent/wig\.vdb: the grid can't be written .*check the folder"):
        save_vdb(volume, tmp_path / "absent" / "wig.vdb")
    with pytest.raises(ScanError, match=r"wig\.vdb: there is no such file"):
        load_vdb(tmp_path / "wig.vdb")
    save_vdb(volume, tmp_path / "wig.vdb", "hair")
    with pytest.raises(ScanError, match="no grid 'density'; it holds hair"):
        load_vdb(tmp_path / "wig.vdb", "density")
    vdb = openvdb()
    grid = vdb.FloatGrid()
    grid.transform = vdb.createLinearTransform(np.diag([0.5, 0.5, 0.7, 1.0]).tolist())
    grid.copyFromArray(np.ones((3, 3, 3), np.float32))
    vdb.write(str(tmp_path / "flat.vdb"), grids=[grid])
    with pytest.raises(ScanError, match=r"flat\.vdb: the grid's voxels measure .*open it as a scan"):
        load_vdb(tmp_path / "flat.vdb")


def test_openvdb_of_the_bpy_wheel_is_found_behind_another_bpy(tmp_path, monkeypatch):
    # what a process sees that one which has imported bpy spawned: Blender's scripts first, and in them a bpy of Python alone
    (tmp_path / "scripts" / "bpy").mkdir(parents=True)
    (tmp_path / "scripts" / "bpy" / "__init__.py").touch()
    bundled = tmp_path / "wheel" / "bpy" / "4.5" / "python" / "lib" / "python3.11" / "site-packages"
    bundled.mkdir(parents=True)
    (tmp_path / "wheel" / "bpy" / "__init__.py").touch()
    (bundled / "openvdb.py").write_text("here = True")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "scripts"), str(tmp_path / "wheel")])
    monkeypatch.delitem(sys.modules, "openvdb", raising=False)
    assert openvdb_module.openvdb.__wrapped__().here and sys.path == [str(tmp_path / "scripts"), str(tmp_path / "wheel")]
    (bundled / "openvdb.py").unlink()
    sys.modules.pop("openvdb")
    with pytest.raises(ScanError, match="name the folder that holds openvdb in PYTHONPATH"):
        openvdb_module.openvdb.__wrapped__()
