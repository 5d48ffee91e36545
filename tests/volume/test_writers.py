"""Writers: what other programs read back from the asymmetric phantom, slab by slab, and that no half file is left."""

from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from ct2hair_addon.errors import ScanError
from ct2hair_addon.settings import ScanSettings
from ct2hair_addon.volume import ScanWriter, open_scan, write_scan, writers
from ct2hair_addon.volume.writers import FORMATS, scan_format

SPACING = (0.5, 0.75, 1.25)
ORIGIN = (10.0, -20.0, 30.0)
MEDICAL = (".nii", ".nii.gz", ".nrrd", ".mha", ".mhd")
WITHOUT_PLACE = (".npy", ".raw")


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.float32, np.uint8])
def test_what_is_written_is_read_again_in_its_place(ending, dtype, phantom, tmp_path):
    path = tmp_path / f"scan_5x4x6_{np.dtype(dtype).name}{ending}"
    with ScanWriter(path, phantom.shape, SPACING, ORIGIN, dtype) as writer:
        for low, high in ((0, 1), (1, 4), (4, 6)):
            writer.write_slab(low, phantom[:, :, low:high])
            assert not path.exists()
    placed = ending not in WITHOUT_PLACE
    with open_scan(path, ScanSettings() if placed else ScanSettings(spacing=0.4)) as reader:
        assert reader.shape == phantom.shape
        assert reader.dtype == (np.float32 if ending == ".vdb" else dtype)
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)
        np.testing.assert_allclose(reader.spacing, SPACING if placed else (0.4,) * 3, rtol=1e-6)
        np.testing.assert_allclose(reader.origin, ORIGIN if placed else (0, 0, 0), rtol=1e-5)
    beside = {path.name, path.with_suffix(".raw").name} if ending == ".mhd" else {path.name}
    assert {file.name for file in tmp_path.iterdir()} == beside


@pytest.mark.parametrize("ending", MEDICAL)
def test_simpleitk_reads_the_same_volume(ending, phantom, tmp_path):
    path = tmp_path / f"scan{ending}"
    write_scan(path, phantom, SPACING, ORIGIN, np.int16)
    image = sitk.ReadImage(str(path))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image).transpose(2, 1, 0), phantom)
    for corner in ([0, 0, 0], [4, 0, 0], [0, 3, 0], [4, 3, 5]):
        place = np.add(ORIGIN, np.multiply(corner, SPACING))
        # NIfTI's header is turned the other way round: index and place still belong together
        np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(corner), place, atol=1e-5)


def test_numpy_and_tifffile_read_the_same_volume(phantom, tmp_path):
    write_scan(tmp_path / "scan.npy", phantom, SPACING, ORIGIN)
    write_scan(tmp_path / "scan.raw", phantom, SPACING, ORIGIN)
    write_scan(tmp_path / "scan.tif", phantom, SPACING, ORIGIN)
    np.testing.assert_array_equal(np.load(tmp_path / "scan.npy"), phantom)
    raw = np.fromfile(tmp_path / "scan.raw", "<u2")
    np.testing.assert_array_equal(raw.reshape(6, 4, 5).transpose(2, 1, 0), phantom)
    with tifffile.TiffFile(tmp_path / "scan.tif") as file:
        np.testing.assert_array_equal(file.asarray().transpose(2, 1, 0), phantom)
        assert len(file.pages) == 6 and not file.is_bigtiff
        assert file.imagej_metadata["spacing"] == 1.25 and file.imagej_metadata["unit"] == "mm"


def test_a_large_tiff_is_a_bigtiff(phantom, tmp_path, monkeypatch):
    monkeypatch.setattr(writers, "BIG_TIFF", 200)
    write_scan(tmp_path / "scan.tif", phantom, 0.5)
    with tifffile.TiffFile(tmp_path / "scan.tif") as file:
        assert file.is_bigtiff
    with open_scan(tmp_path / "scan.tif") as reader:
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)


@pytest.mark.parametrize(("dtype", "expected"), [(np.uint8, [0, 0, 3, 255]), (np.int16, [-7, 0, 3, 300])])
def test_values_are_rounded_and_clipped_to_the_files_type(dtype, expected, tmp_path):
    values = np.array([-7.4, 0.4, 2.6, 300.0], np.float32).reshape(4, 1, 1)
    write_scan(tmp_path / "scan.npy", values, 0.5, dtype=dtype)
    np.testing.assert_array_equal(np.load(tmp_path / "scan.npy").ravel(), expected)


@pytest.mark.parametrize("ending", FORMATS)
def test_a_failure_in_the_middle_leaves_neither_the_file_nor_a_piece_of_it(ending, phantom, tmp_path):
    path = tmp_path / f"scan{ending}"
    with pytest.raises(RuntimeError, match="power"), ScanWriter(path, phantom.shape, 0.5) as writer:
        writer.write_slab(0, phantom[:, :, :2])
        raise RuntimeError("power")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ScanError, match="only 2 of 6 slices"), ScanWriter(path, phantom.shape, 0.5) as writer:
        writer.write_slab(0, phantom[:, :, :2])
    assert not list(tmp_path.iterdir())


def test_a_failure_keeps_the_file_that_was_there_before(phantom, tmp_path):
    write_scan(tmp_path / "scan.mha", phantom, 0.5)
    before = (tmp_path / "scan.mha").read_bytes()
    with pytest.raises(RuntimeError), ScanWriter(tmp_path / "scan.mha", phantom.shape, 0.5) as writer:
        writer.write_slab(0, phantom[:, :, :2])
        raise RuntimeError
    assert (tmp_path / "scan.mha").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("scan.xyz", {}, r"can't be written as '\.xyz'; choose one of \.vdb"),
        ("scan.npy", {"dtype": np.complex64}, "complex64 can't be written; choose uint8"),
        ("scan.npy", {"shape": (5, 4)}, "three sizes"),
        ("scan.npy", {"spacing": 0.0}, "spacing above 0"),
        ("absent/scan.npy", {}, "can't be written .*check the folder"),
    ],
)
def test_what_can_not_be_written_is_refused_by_name(name, more, message, tmp_path):
    with pytest.raises(ScanError, match=message) as caught:
        ScanWriter(tmp_path / name, **{"shape": (5, 4, 6), "spacing": 0.5, **more})
    assert name in str(caught.value)


def test_slabs_out_of_order_or_of_another_size_are_refused(phantom, tmp_path):
    writer = ScanWriter(tmp_path / "scan.npy", phantom.shape, 0.5)
    for start, slab in ((1, phantom[:, :, 1:2]), (0, phantom[:3]), (0, np.zeros((5, 4, 7)))):
        with pytest.raises(ValueError, match="expected a slab"):
            writer.write_slab(start, slab)
    writer.abort()


def test_the_ending_names_the_format():
    assert [scan_format(name) for name in ("a/b.NII.GZ", "x.tar.gz", "Y.Tif", "z")] == [".nii.gz", ".gz", ".tif", ""]
