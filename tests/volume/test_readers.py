"""Readers: one asymmetric phantom written in every format by other programs' hands, and what must be refused."""

from __future__ import annotations

import gzip
import itertools
import re
import struct

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from ct2hair_addon.errors import ScanError
from ct2hair_addon.settings import ScanSettings
from ct2hair_addon.volume import open_scan, readers
from ct2hair_addon.volume.openvdb_module import openvdb

SPACING = (0.5, 0.75, 1.25)
ORIGIN = (10.0, -20.0, 30.0)
NOWHERE = (0.0, 0.0, 0.0)
CUBES = ScanSettings(spacing=0.4)


def image_of(array, direction=None, spacing=SPACING, origin=ORIGIN) -> sitk.Image:
    """A SimpleITK image of an [x, y, z] array."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    image.SetSpacing(spacing)
    image.SetOrigin(origin)
    if direction is not None:
        image.SetDirection(np.asarray(direction, float).ravel().tolist())
    return image


def write_vdb(folder, array, low=(0, 0, 0), matrix=None, name="density", kind="FloatGrid"):
    vdb = openvdb()
    grid = getattr(vdb, kind)()
    grid.name = name
    if matrix is None:
        matrix = np.diag([*SPACING, 1.0])
        matrix[3, :3] = ORIGIN
    grid.transform = vdb.createLinearTransform(matrix.tolist())
    grid.copyFromArray(array.astype(np.float32), ijk=low)
    vdb.write(str(folder / "scan.vdb"), grids=[grid])
    return folder / "scan.vdb"


def write_npy(folder, array, order="C"):
    np.save(folder / "scan.npy", np.asarray(array, order=order))
    return folder / "scan.npy"


def write_raw(folder, array, name="scan_5x4x6_int16.raw", dtype="<i2"):
    (folder / name).write_bytes(array.astype(dtype).tobytes(order="F"))
    return folder / name


def write_tiff(folder, array, **options):
    across = {"resolution": (1 / SPACING[0], 1 / SPACING[1])}
    metadata = {"axes": "ZYX", "unit": "mm", "spacing": SPACING[2]}
    pages = np.ascontiguousarray(array.transpose(2, 1, 0).astype(np.uint16))
    tifffile.imwrite(folder / "scan.tif", pages, **{"imagej": True, **across, "metadata": metadata, **options})
    return folder / "scan.tif"


def write_big_tiff(folder, array):
    ome = {"axes": "ZYX"} | {f"PhysicalSize{a}": s for a, s in zip("XYZ", SPACING, strict=True)}
    ome |= {f"PhysicalSize{axis}Unit": "mm" for axis in "XYZ"}
    return write_tiff(folder, array, bigtiff=True, imagej=False, ome=True, metadata=ome)


def write_pages(folder, array):
    """Slices whose names sort wrongly as plain text: s1, s2, ... s11."""
    for k in range(array.shape[2]):
        name = folder / f"s{2 * k + 1 if array.shape[2] < 6 else k + 6}.tif"
        tifffile.imwrite(name, array[:, :, k].T.astype(np.int16), resolution=(20.0, 40 / 3), resolutionunit=3)
    return folder


def write_itk(folder, array, name="scan.nrrd", compress=False, direction=None):
    sitk.WriteImage(image_of(array, direction), str(folder / name), compress)
    return folder / name


def write_msb(folder, array):
    """A big-endian MetaImage by hand: no library here writes one."""
    header = (
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = True\nCompressedData = False\n"
        "TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 10 -20 30\nElementSpacing = 0.5 0.75 1.25\nDimSize = 5 4 6\n"
        "ElementType = MET_SHORT\nElementDataFile = LOCAL\n"
    )
    (folder / "scan.mha").write_bytes(header.encode() + array.astype(">i2").tobytes(order="F"))
    return folder / "scan.mha"


def write_dicom(
    folder, array, names=None, slope=1.0, intercept=0.0, positions=None, series="1.2.3.4", across=(1, 0, 0, 0, 1, 0)
):
    """A CT series, a file a slice, the names in an order that says nothing about the slices'."""
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    count = array.shape[2]
    names = names or [f"{(3 * k) % 7:02d}.dcm" for k in range(count)]
    positions = positions or [(ORIGIN[0], ORIGIN[1], ORIGIN[2] + k * SPACING[2]) for k in range(count)]
    for k in range(count):
        image = sitk.GetImageFromArray(np.ascontiguousarray(array[:, :, k].T))
        image.SetSpacing(SPACING[:2])
        tags = {"0008|0060": "CT", "0020|000e": series, "0020|000d": "1.2.3", "0008|0018": f"{series}.{k}"}
        tags |= {"0020|0032": "\\".join(map(str, positions[k])), "0020|0037": "\\".join(map(str, across))}
        tags |= {"0028|1053": str(slope), "0028|1052": str(intercept), "0020|0013": str(99 - k)}
        for key, value in tags.items():
            image.SetMetaData(key, value)
        writer.SetFileName(str(folder / names[k]))
        writer.Execute(image)
    return folder


FORMATS = {
    # how it is written, the spacing, the origin and the order (slowest first) that it is to come back with
    "vdb": (write_vdb, SPACING, ORIGIN, (0, 1, 2)),
    "npy, C order": (write_npy, None, NOWHERE, (0, 1, 2)),
    "npy, Fortran order": (lambda f, a: write_npy(f, a, "F"), None, NOWHERE, (2, 1, 0)),
    "raw": (write_raw, None, NOWHERE, (2, 1, 0)),
    "TIFF": (write_tiff, SPACING, NOWHERE, (2, 1, 0)),
    "TIFF, big-endian": (lambda f, a: write_tiff(f, a, byteorder=">"), SPACING, NOWHERE, (2, 1, 0)),
    "TIFF, deflated": (lambda f, a: write_tiff(f, a, compression="zlib"), SPACING, NOWHERE, (2, 1, 0)),
    "BigTIFF": (write_big_tiff, SPACING, NOWHERE, (2, 1, 0)),
    "folder of TIFF slices": (write_pages, (0.5, 0.75, 0.5), NOWHERE, (2, 1, 0)),
    "NIfTI": (lambda f, a: write_itk(f, a, "scan.nii"), SPACING, ORIGIN, (2, 1, 0)),
    "NIfTI, gzip": (lambda f, a: write_itk(f, a, "scan.nii.gz"), SPACING, ORIGIN, (2, 1, 0)),
    "NRRD": (write_itk, SPACING, ORIGIN, (2, 1, 0)),
    "NRRD, gzip": (lambda f, a: write_itk(f, a, compress=True), SPACING, ORIGIN, (2, 1, 0)),
    "NRRD, detached": (lambda f, a: write_itk(f, a, "scan.nhdr"), SPACING, ORIGIN, (2, 1, 0)),
    "MetaImage": (lambda f, a: write_itk(f, a, "scan.mha"), SPACING, ORIGIN, (2, 1, 0)),
    "MetaImage, detached": (lambda f, a: write_itk(f, a, "scan.mhd"), SPACING, ORIGIN, (2, 1, 0)),
    "MetaImage, deflated": (lambda f, a: write_itk(f, a, "scan.mha", compress=True), SPACING, ORIGIN, (2, 1, 0)),
    "MetaImage, big-endian": (write_msb, SPACING, ORIGIN, (2, 1, 0)),
    "DICOM": (write_dicom, SPACING, ORIGIN, (2, 1, 0)),
}


@pytest.mark.parametrize("name", FORMATS)
def test_the_phantom_comes_back_with_its_axes_its_spacing_and_its_place(name, phantom, tmp_path):
    write, spacing, origin, order = FORMATS[name]
    with open_scan(write(tmp_path, phantom), ScanSettings() if spacing else CUBES) as reader:
        assert reader.shape == phantom.shape
        np.testing.assert_allclose(reader.spacing, spacing or (0.4,) * 3, rtol=1e-6)
        # the centre of voxel (0, 0, 0), so that half a voxel off shows
        np.testing.assert_allclose(reader.origin, origin, atol=1e-5)
        assert reader.order == order
        whole = reader.slab(0, phantom.shape[2])
        assert whole.dtype == np.float32
        np.testing.assert_array_equal(whole, phantom)


@pytest.mark.parametrize("name", FORMATS)
def test_slabs_equal_the_whole_along_z_and_along_the_files_own_order(name, phantom, tmp_path, monkeypatch):
    write, spacing, _, _ = FORMATS[name]
    monkeypatch.setattr(readers, "READ_BYTES", 1)
    with open_scan(write(tmp_path, phantom), ScanSettings() if spacing else CUBES) as reader:
        np.testing.assert_array_equal(np.concatenate([reader.slab(k, k + 2) for k in range(0, 6, 2)], axis=2), phantom)
        native = phantom.transpose(reader.order)
        slow = native.shape[0]
        slices = [reader.native(n, n + 1) for n in range(slow)]
        assert all(piece.flags.c_contiguous and piece.dtype == np.float32 for piece in slices)
        np.testing.assert_array_equal(np.concatenate(slices), native)
        np.testing.assert_array_equal(reader.native(1, slow), native[1:])
        assert reader.native(2, 2).shape == (0, *native.shape[1:])
        with pytest.raises(ValueError, match="not within"):
            reader.native(0, slow + 1)
        with pytest.raises(ValueError, match="not within"):
            reader.slab(-1, 2)


TURNS = [
    np.eye(3)[:, list(order)] * signs
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
]


@pytest.mark.parametrize("name", ["scan.nrrd", "scan.mha", "scan.nii"])
def test_every_voxel_stays_at_its_place_in_the_world_under_all_48_orientations(name, phantom, tmp_path):
    index = np.argwhere(phantom > 0)
    for direction in TURNS:
        path = write_itk(tmp_path, phantom, name, direction=direction)
        image = image_of(phantom, direction)
        with open_scan(path) as reader:
            assert (reader.spacing > 0).all()
            values = reader.slab(0, reader.shape[2])
            world = np.array([image.TransformIndexToPhysicalPoint(row) for row in index.tolist()])
            place = (world - reader.origin) / reader.spacing
            np.testing.assert_allclose(place, np.rint(place), atol=1e-4)
            np.testing.assert_array_equal(values[tuple(np.rint(place).astype(int).T)], phantom[tuple(index.T)])
            assert not reader.warnings
            rows = reader.native(1, 3)
            np.testing.assert_array_equal(rows, values.transpose(reader.order)[1:3])


@pytest.mark.parametrize("kind", ["u1", "i1", "<u2", "<i2", ">u2", ">i2", "<i4", ">f4", "<f4", "<f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_type_of_number(kind, order, phantom, tmp_path):
    signed = phantom - 60 if np.dtype(kind).kind in "if" else phantom
    np.save(tmp_path / "scan.npy", np.asarray(signed.astype(kind), order=order))
    with open_scan(tmp_path / "scan.npy", CUBES) as reader:
        assert reader.dtype == np.dtype(kind)
        np.testing.assert_array_equal(reader.slab(0, 6), signed)


@pytest.mark.parametrize(
    ("name", "kind", "call"),
    [
        ("scan_5x4x6_uint16be.raw", ">u2", {}),
        ("scan_5x4x6_i16.raw", "<i2", {}),
        ("wig.raw", ">i2", {"settings": ScanSettings(spacing=0.4, raw_shape="5x4x6", raw_type="int16be")}),
        ("wig.dat", "<f4", {"settings": ScanSettings(spacing=0.4, raw_shape="5 4 6", raw_type="float")}),
        ("wig.bin", "<u2", {"shape": (5, 4, 6), "dtype": np.uint16}),
        ("wig.scan", "<u2", {"shape": (5, 4, 6), "dtype": "uint16"}),
        # the call's own shape and type come before the settings', those before the name's
        ("wig_9x9x9_uint8.raw", ">f4", {"shape": (5, 4, 6), "dtype": "float32be"}),
        ("wig_9x9x9_uint8.raw", "<f8", {"settings": ScanSettings(spacing=0.4, raw_shape="5,4,6", raw_type="float64")}),
    ],
)
def test_a_raw_file_by_its_name_by_setting_and_by_argument(name, kind, call, phantom, tmp_path):
    path = write_raw(tmp_path, phantom, name, kind)
    with open_scan(path, **{"settings": CUBES, **call}) as reader:
        assert reader.dtype == np.dtype(kind) and not reader.warnings
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)


def test_a_raw_type_that_only_the_size_tells_is_a_warning(phantom, tmp_path):
    with open_scan(write_raw(tmp_path, phantom, "scan_5x4x6.raw", "<u2"), CUBES) as reader:
        assert reader.dtype == np.uint16
        assert any("uint16, which is taken" in text for text in reader.warnings)


def test_slope_and_intercept_are_applied(phantom, tmp_path):
    image = image_of(phantom)
    sitk.WriteImage(image, str(tmp_path / "scan.nii"))
    data = bytearray((tmp_path / "scan.nii").read_bytes())
    for slope, intercept, expected in ((2.0, -1000.0, 2.0 * phantom - 1000.0), (0.0, 5.0, phantom), (1.0, 3.0, phantom + 3.0)):
        struct.pack_into("<ff", data, 112, slope, intercept)
        (tmp_path / "scan.nii").write_bytes(data)
        (tmp_path / "scan.nii.gz").write_bytes(gzip.compress(bytes(data)))
        for name in ("scan.nii", "scan.nii.gz"):
            with open_scan(tmp_path / name) as reader:
                np.testing.assert_array_equal(reader.slab(0, 6), expected)


def test_dicom_slices_are_ordered_by_position_and_rescaled(phantom, tmp_path):
    densities = 2 * phantom - 1024
    write_dicom(tmp_path, densities.astype(np.int16), slope=2.0, intercept=-1024.0)
    # what is stored are the values before slope and intercept, at the end of each file
    stored = np.frombuffer((tmp_path / "03.dcm").read_bytes()[-40:], "<i2")
    np.testing.assert_array_equal(stored.reshape(4, 5).T, phantom[:, :, 1])
    with open_scan(tmp_path) as reader, open_scan(tmp_path / "03.dcm") as from_one_slice:
        np.testing.assert_array_equal(reader.slab(0, 6), densities)
        np.testing.assert_array_equal(from_one_slice.slab(0, 6), densities)


def test_dicom_slices_that_run_downwards_come_out_upwards(phantom, tmp_path):
    """Head first or feet first: y of the slices along -y of the world, so the normal points down."""
    positions = [(ORIGIN[0], ORIGIN[1], ORIGIN[2] - k * SPACING[2]) for k in range(6)]
    write_dicom(tmp_path, phantom, positions=positions, across=(1, 0, 0, 0, -1, 0))
    with open_scan(tmp_path) as reader:
        np.testing.assert_allclose(reader.origin, (10.0, -20.0 - 3 * 0.75, 30.0 - 5 * 1.25), atol=1e-5)
        np.testing.assert_array_equal(reader.slab(0, 6), phantom[:, ::-1, ::-1])


def test_of_two_dicom_series_the_longer_is_taken_and_said(phantom, tmp_path):
    write_dicom(tmp_path, phantom)
    write_dicom(tmp_path, phantom[:, :, :2] + 100, names=["z1.dcm", "z2.dcm"], series="1.2.9.9")
    with open_scan(tmp_path) as reader:
        assert any("2 series" in text and "most slices, 6" in text for text in reader.warnings)
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)


def test_a_vdb_is_the_box_of_its_active_voxels_wherever_that_lies(phantom, tmp_path):
    with open_scan(write_vdb(tmp_path, phantom, low=(3, -2, 17))) as reader:
        assert reader.shape == phantom.shape
        np.testing.assert_allclose(reader.origin, np.add(ORIGIN, np.multiply((3, -2, 17), SPACING)), atol=1e-5)
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)


def test_what_is_no_number_becomes_air_and_is_counted(phantom, tmp_path):
    values = np.full((8, 9, 10), 7.0, np.float32)
    values[:5, :4, :6] = phantom
    values[1, 2, 3], values[4, 0, 5], values[7, 7, 7] = np.nan, np.inf, -np.inf
    np.save(tmp_path / "scan.npy", values)
    with open_scan(tmp_path / "scan.npy", CUBES) as reader:
        whole = reader.slab(0, 10)
        assert reader.not_numbers == 3
        np.testing.assert_allclose(whole[[1, 4, 7], [2, 0, 7], [3, 5, 7]], 7.0, atol=0.3)
        assert np.isfinite(whole).all() and whole[2, 2, 2] == phantom[2, 2, 2]
        assert any("no number" in text for text in reader.warnings)


def test_the_spacing_of_the_settings_overrules_the_files_and_says_so(phantom, tmp_path):
    with open_scan(write_itk(tmp_path, phantom), CUBES) as reader:
        np.testing.assert_array_equal(reader.spacing, 0.4)
        assert any("0.5 x 0.75 x 1.25" in text and "0.4 mm is taken" in text for text in reader.warnings)


@pytest.mark.parametrize("unit", ["cm", "m", "um"])
def test_nrrd_units_are_read(unit, phantom, tmp_path):
    path = write_itk(tmp_path, phantom)
    head, _, data = path.read_bytes().partition(b"\n\n")
    path.write_bytes(head + f'\nspace units: "{unit}" "{unit}" "{unit}"\n\n'.encode() + data)
    factor = {"cm": 10.0, "m": 1000.0, "um": 0.001}[unit]
    with open_scan(path) as reader:
        np.testing.assert_allclose(reader.spacing, np.array(SPACING) * factor, rtol=1e-6)
        np.testing.assert_allclose(reader.origin, np.array(ORIGIN) * factor, rtol=1e-6)
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)


def test_a_slight_tilt_is_a_warning_and_keeps_the_middle_where_it_is(phantom, tmp_path):
    a = np.radians(2.0)
    tilt = [[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
    path = write_itk(tmp_path, phantom, direction=tilt)
    middle = image_of(phantom, tilt).TransformContinuousIndexToPhysicalPoint([2.0, 1.5, 2.5])
    with open_scan(path) as reader:
        assert any("2.0 degrees off" in text for text in reader.warnings)
        np.testing.assert_allclose(reader.origin + reader.spacing * [2.0, 1.5, 2.5], middle, atol=1e-4)
        np.testing.assert_array_equal(reader.slab(0, 6), phantom)


def test_slices_missing_from_a_folder_of_tiffs_are_a_warning(phantom, tmp_path):
    write_pages(tmp_path, phantom)
    (tmp_path / "s8.tif").unlink()
    with open_scan(tmp_path) as reader:
        assert any("jump after s7.tif" in text for text in reader.warnings)


def test_a_packed_files_temporary_copy_goes_with_the_reader(phantom, tmp_path, monkeypatch):
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(place))
    reader = open_scan(write_itk(tmp_path, phantom, "scan.nii.gz"))
    calls = []
    reader.prepare(lambda done, total: calls.append((done, total)))
    assert calls and len(list(place.iterdir())) == 1
    np.testing.assert_array_equal(reader.slab(0, 6), phantom)
    reader.close()
    assert not list(place.iterdir())


def cut(path, keep=0.7):
    """The file with its end cut off."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    return path


def written(folder, name, data: bytes):
    (folder / name).write_bytes(data)
    return folder / name


def oblique():
    a = np.radians(20.0)
    return [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]


def vector_image(folder, array, name):
    values = np.stack([array.transpose(2, 1, 0)] * 3, axis=-1)
    sitk.WriteImage(sitk.GetImageFromArray(np.ascontiguousarray(values), isVector=True), str(folder / name))
    return folder / name


def mixed_folder(folder, array):
    write_pages(folder, array)
    tifffile.imwrite(folder / "s8.tif", np.zeros((3, 3), np.int16))
    return folder


def mixed_pages(folder, array):
    with tifffile.TiffWriter(folder / "scan.tif") as file:
        file.write(np.zeros((4, 5), np.uint16), photometric="minisblack")
        file.write(np.zeros((7, 5), np.uint16), photometric="minisblack")
    return folder / "scan.tif"


def mixed_dicom(folder, array):
    write_dicom(folder, array)
    write_dicom(folder, array[:3, :, :1], names=["zz.dcm"], positions=[(10, -20, 60)])
    return folder


def missing_dicom(folder, array):
    write_dicom(folder, array)
    (folder / "06.dcm").unlink()
    return folder


def twice_dicom(folder, array):
    positions = [(10, -20, 30), (10, -20, 31), (10, -20, 32), (10, -20, 32), (10, -20, 33), (10, -20, 34)]
    return write_dicom(folder, array, positions=positions)


def leaning_dicom(folder, array):
    """A gantry tilted by 20 degrees: each slice is shifted against the last."""
    return write_dicom(folder, array, positions=[(10, -20 + 0.455 * k, 30 + 1.25 * k) for k in range(6)])


def cut_dicom(folder, array):
    write_dicom(folder, array)
    cut(folder / "06.dcm", 0.95)
    return folder


def turned_vdb(folder, array):
    matrix = np.eye(4)
    matrix[:2, :2] = [[0.8, 0.6], [-0.6, 0.8]]
    return write_vdb(folder, array, matrix=matrix)


def two_grids(folder, array):
    vdb = openvdb()
    grids = [vdb.FloatGrid(), vdb.FloatGrid()]
    for grid, name in zip(grids, ("left", "right"), strict=True):
        grid.name = name
        grid.copyFromArray(array.astype(np.float32))
    vdb.write(str(folder / "scan.vdb"), grids=grids)
    return folder / "scan.vdb"


def without(folder, array, name, data_name):
    path = write_itk(folder, array, name)
    (folder / data_name).unlink()
    return path


def many_times(folder, array):
    path = write_itk(folder, array, "scan.nii")
    data = bytearray(path.read_bytes())
    struct.pack_into("<8h", data, 40, 4, 5, 4, 3, 2, 1, 1, 1)
    path.write_bytes(data)
    return path


def colour_nifti(folder, array):
    path = write_itk(folder, array, "scan.nii")
    data = bytearray(path.read_bytes())
    struct.pack_into("<hh", data, 70, 128, 24)
    path.write_bytes(data)
    return path


def nan_only(folder, array):
    np.save(folder / "scan.npy", np.full((5, 4, 6), np.nan, np.float32))
    return folder / "scan.npy"


REFUSED = {
    # what is wrong: how it is made, and what the message must say beside the name
    "absent": (lambda f, a: f / "absent.nii", "no such file or folder"),
    "empty file": (lambda f, a: written(f, "scan.nii", b""), "is empty; export or copy it again"),
    "unknown ending": (lambda f, a: written(f, "scan.xyz", b"1234"), r"'\.xyz' is not a format.*there are \.vdb, \.npy"),
    "a folder of nothing": (lambda f, a: f, "holds no series of DICOM or TIFF slices"),
    "npy cut short": (lambda f, a: cut(write_npy(f, a)), "cut short: 257 bytes, expected 368; copy or export it again"),
    "npy of four axes": (lambda f, a: write_npy(f, np.stack([a, a], -1)), r"4 axes .*channels.*expected three, \[x, y, z\]"),
    "npy of two axes": (lambda f, a: write_npy(f, a[0]), "2 axes .*expected three"),
    "npy of complex numbers": (lambda f, a: write_npy(f, a + 1j), "complex128 are no densities; save it as uint16"),
    "npy of nothing": (lambda f, a: write_npy(f, a[:0]), "sizes .*expected three above 0; export it again"),
    "npy of garbage": (lambda f, a: written(f, "scan.npy", b"garbage" * 9), "not a .npy array.*save it with numpy.save"),
    "NaN only": (nan_only, "holds no numbers.*export it again"),
    "raw without a size": (lambda f, a: write_raw(f, a, "wig.raw"), "doesn't say its size; give the voxels"),
    "raw too short": (lambda f, a: write_raw(f, a, "w_5x4x7_int16.raw"), "240 bytes, but 5 x 4 x 7.*280.*cut short"),
    "raw too long": (lambda f, a: write_raw(f, a, "w_5x4x5_int16.raw"), "longer than that: has it a header"),
    "raw of a broken size": (lambda f, a: write_raw(f, a, "w_5x4x7.raw"), "no whole number of bytes.*check the shape"),
    "TIFF cut short": (
        lambda f, a: cut(write_tiff(f, a, imagej=False, metadata=None), 0.75),
        "damaged or cut short|past the file's end",
    ),
    "TIFF of garbage": (lambda f, a: written(f, "scan.tif", b"garbage" * 9), "not a readable TIFF.*export it again"),
    "TIFF of one page": (lambda f, a: write_tiff(f, a[:, :, :1]), "a single page 5 x 4; open the folder"),
    "TIFF in colour": (
        lambda f, a: (tifffile.imwrite(f / "scan.tif", np.zeros((6, 4, 5, 3), np.uint8), photometric="rgb"), f / "scan.tif")[1],
        "several channels.*export it in greys",
    ),
    "TIFF of mixed pages": (mixed_pages, "pages of different sizes.*one size"),
    "TIFF folder of mixed sizes": (mixed_folder, r"s8\.tif: a slice of 3 x 3 .*s6\.tif has 5 x 4.*one scan only"),
    "NIfTI cut short": (lambda f, a: cut(write_itk(f, a, "scan.nii")), "cut short.*copy or export it again"),
    "NIfTI.gz cut short": (lambda f, a: cut(write_itk(f, a, "scan.nii.gz"), 0.8), "cut short|end too early|not a whole gzip"),
    "NIfTI of several times": (many_times, "5 x 4 x 3 x 2 values, expected one volume.*times"),
    "NIfTI in colour": (colour_nifti, "type 128 .*no densities; export it as int16"),
    "NIfTI of garbage": (lambda f, a: written(f, "scan.nii", b"garbage" * 99), "not a NIfTI file"),
    "NRRD cut short": (lambda f, a: cut(write_itk(f, a), 0.9), "cut short.*copy or export"),
    "NRRD.gz cut short": (lambda f, a: cut(write_itk(f, a, compress=True), 0.95), "cut short; copy it again"),
    "NRRD without its data": (lambda f, a: without(f, a, "scan.nhdr", "scan.raw"), r"scan\.raw is missing; put it beside"),
    "NRRD of garbage": (lambda f, a: written(f, "scan.nrrd", b"garbage" * 99), "not an NRRD file"),
    "NRRD of vectors": (lambda f, a: vector_image(f, a, "scan.nrrd"), "3 channels.*export a single density volume"),
    "NRRD oblique": (lambda f, a: write_itk(f, a, direction=oblique()), "20.0 degrees off.*resample it along the axes"),
    "MetaImage cut short": (lambda f, a: cut(write_itk(f, a, "scan.mha"), 0.9), "cut short.*copy or export"),
    "MetaImage.z cut short": (lambda f, a: cut(write_itk(f, a, "scan.mha", True), 0.95), "cut short; copy it again"),
    "MetaImage without its data": (lambda f, a: without(f, a, "scan.mhd", "scan.raw"), r"scan\.raw is missing; put it"),
    "MetaImage of vectors": (lambda f, a: vector_image(f, a, "scan.mha"), "3 channels.*single density"),
    "MetaImage of garbage": (lambda f, a: written(f, "scan.mha", b"garbage" * 9), "not a MetaImage header"),
    "MetaImage oblique": (lambda f, a: write_itk(f, a, "scan.mha", direction=oblique()), "20.0 degrees off"),
    "DICOM of mixed sizes": (mixed_dicom, r"\.dcm: its size, spacing or direction.*one series only"),
    "DICOM with a gap": (missing_dicom, r"slices are missing after 03\.dcm.*copy all of them"),
    "DICOM with a slice twice": (twice_dicom, "several slices at one position.*one acquisition"),
    "DICOM of one slice": (lambda f, a: write_dicom(f, a[:, :, :1]), "a single DICOM slice is no volume"),
    "DICOM with a tilted gantry": (leaning_dicom, "20.0 degrees off"),
    "DICOM cut short": (cut_dicom, "06.dcm.*(cut short|damaged|can't be read)"),
    "VDB of garbage": (lambda f, a: written(f, "scan.vdb", b"garbage" * 99), "not a readable OpenVDB file"),
    "VDB cut short": (lambda f, a: cut(write_vdb(f, a), 0.6), "not a readable OpenVDB file|empty"),
    "VDB of nothing": (lambda f, a: write_vdb(f, 0 * a), "is empty; export it again"),
    "VDB turned": (turned_vdb, "rotates or mirrors it; resample it"),
    "VDB of two grids": (two_grids, "no grid 'density'; it holds left, right"),
    "VDB of truth values": (
        lambda f, a: write_vdb(f, a > 0, kind="BoolGrid"),
        "no grid of numbers.*export the density as a float grid",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_can_not_be_read_is_refused_by_name_with_what_to_do(name, phantom, tmp_path):
    make, message = REFUSED[name]
    path = make(tmp_path, phantom)
    with pytest.raises(ScanError) as caught, open_scan(path, CUBES) as reader:
        reader.prepare()
        reader.slab(0, reader.shape[2])
    assert path.name in str(caught.value)
    assert re.search(message, str(caught.value)), str(caught.value)


@pytest.mark.parametrize("name", ["npy, C order", "raw"])
def test_a_file_without_a_spacing_asks_for_one(name, phantom, tmp_path):
    path = FORMATS[name][0](tmp_path, phantom)
    with pytest.raises(ScanError, match=r"doesn't say how large a voxel is; give the spacing in mm \(setting scan\.spacing\)"):
        open_scan(path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (ScanSettings(spacing=0.4, raw_shape="five by four"), "'five by four', expected voxels as 512x512x300"),
        (ScanSettings(spacing=0.4, raw_shape="5x4x6", raw_type="uint12"), "'uint12' is no type of number; choose one of uint8"),
    ],
)
def test_raw_settings_that_make_no_sense_are_named(settings, message, phantom, tmp_path):
    with pytest.raises(ScanError, match=message):
        open_scan(write_raw(tmp_path, phantom), settings)


def test_a_real_head_ct(shared_data):
    path = shared_data / "ct" / "CT_AVM.nii.gz"
    image = sitk.ReadImage(str(path))
    with open_scan(path) as reader:
        assert sorted(reader.shape) == sorted(image.GetSize()) == [154, 242, 256]
        np.testing.assert_allclose(sorted(reader.spacing), sorted(image.GetSpacing()), rtol=1e-5)
        values = reader.slab(60, 63)
        for index in np.random.default_rng(0).integers(0, [256, 242, 154], (3000, 3)).tolist():
            place = (np.array(image.TransformIndexToPhysicalPoint(index)) - reader.origin) / reader.spacing
            i, j, k = np.rint(place).astype(int)
            assert np.abs(place - (i, j, k)).max() < 1e-2
            if 60 <= k < 63:
                assert values[i, j, k - 60] == image[index]


def test_a_real_micro_ct(shared_data):
    path = shared_data / "ct" / "shell_225x128x128.tif"
    pages = tifffile.imread(path)
    with open_scan(path, ScanSettings(spacing=0.1)) as reader:
        assert reader.shape == pages.shape[::-1]
        np.testing.assert_array_equal(reader.slab(100, 120), pages[100:120].transpose(2, 1, 0))
