"""The scan as a Volume object."""

import bpy
import numpy as np
import pytest

from ct2hair_addon.errors import ScanError
from ct2hair_addon.scene import NewData, new_volume, summarize
from ct2hair_addon.volume import BrickVolume, save_vdb

from .conftest import block_counts


@pytest.fixture
def grid(tmp_path):
    dense = np.zeros((40, 30, 20), np.float32)
    dense[3:9, 5:7, 7] = np.linspace(0.1, 2.0, 12).reshape(6, 2)
    path = tmp_path / "scan.vdb"
    save_vdb(BrickVolume.from_dense(dense, 0.5, (10.0, 20.0, 30.0)), path)
    return path


def test_a_grid_is_summarized_in_the_scan_frame(grid):
    summary = summarize(grid)
    assert summary.name == "density" and summary.spacing == pytest.approx(0.5)
    np.testing.assert_allclose(summary.low_corner, [11.5, 22.5, 33.5], atol=1e-6)
    np.testing.assert_allclose(summary.high_corner, [14.0, 23.0, 33.5], atol=1e-6)
    assert summary.high == pytest.approx(2.0, rel=0.1) and 0 < summary.low < summary.high
    assert summarize(grid, 0.3, 1.5).low == 0.3 and summarize(grid, 0.3, 1.5).high == 1.5


def test_the_material_windows_the_density(grid):
    with NewData() as new:
        ob = new_volume(new, "Scan", grid, summarize(grid, 0.3, 1.5))
    window = ob.active_material.node_tree.nodes["Window"]
    assert window.inputs["From Min"].default_value == pytest.approx(0.3)
    assert window.inputs["From Max"].default_value == pytest.approx(1.5)
    assert [g.name for g in ob.data.grids] == ["density"]


def test_what_is_no_grid_is_refused_in_words(tmp_path):
    with pytest.raises(ScanError, match="no such file"):
        summarize(tmp_path / "none.vdb")
    (tmp_path / "bad.vdb").write_bytes(b"not a grid at all" * 10)
    with pytest.raises(ScanError, match="not a readable OpenVDB file"):
        summarize(tmp_path / "bad.vdb")
    bpy.utils.expose_bundled_modules()
    import openvdb

    for other, message in ((openvdb.BoolGrid(), "expected a float grid"), (openvdb.FloatGrid(0.0), "no active voxel")):
        if message.startswith("expected"):
            other.fill((0, 0, 0), (3, 3, 3), True)
        other.name = "density"
        openvdb.write(str(tmp_path / "other.vdb"), [other])
        with pytest.raises(ScanError, match=message):
            summarize(tmp_path / "other.vdb")
    assert not any(block_counts()[kind] for kind in ("volumes", "objects", "materials"))
