"""Voxels that are no cubes made into cubes: a linear ramp stays exact, at its place, along every order of the file."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import SimpleITK as sitk

from ct2hair_addon.settings import ScanSettings
from ct2hair_addon.volume import open_scan, write_scan
from ct2hair_addon.volume.resampling import CubicScan, cubic

SLOPE = np.array([3.0, -5.0, 7.0])
ORIGIN = np.array([10.0, -20.0, 30.0])


def ramp(shape, spacing, origin=ORIGIN) -> np.ndarray:
    """float32 [x, y, z]: a density that is linear in the world, `1000 + SLOPE . p`."""
    axes = [o + s * np.arange(n) for n, s, o in zip(shape, spacing, origin, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    return (1000.0 + SLOPE[0] * x + SLOPE[1] * y + SLOPE[2] * z).astype(np.float32)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("spacing", [(0.5, 0.75, 1.25), (1.25, 0.5, 0.5), (0.9, 0.9, 0.4)])
def test_a_ramp_stays_exact_and_in_its_place(order, spacing, tmp_path):
    shape = (9, 8, 7)
    # the file's axis n lies along the world's axis order[n]
    stored = ramp(shape, spacing).transpose(order)
    image = sitk.GetImageFromArray(np.ascontiguousarray(stored.transpose(2, 1, 0)))
    image.SetSpacing([spacing[axis] for axis in order])
    image.SetOrigin(ORIGIN.tolist())
    image.SetDirection(np.eye(3)[:, list(order)].ravel().tolist())
    sitk.WriteImage(image, str(tmp_path / "scan.nrrd"))
    with open_scan(tmp_path / "scan.nrrd") as reader:
        scan = cubic(reader)
        edge = min(spacing)
        assert isinstance(scan, CubicScan) and scan.order == reader.order == order[::-1]
        np.testing.assert_allclose(scan.spacing, edge)
        np.testing.assert_allclose(scan.origin, ORIGIN)
        # the last cube is the last that lies within the scan
        assert scan.shape == tuple(int((n - 1) * s / edge + 1e-6) + 1 for n, s in zip(shape, spacing, strict=True))
        expected = ramp(scan.shape, (edge,) * 3).transpose(scan.order)
        slow = scan.shape[scan.order[0]]
        whole = scan.native(0, slow)
        assert whole.dtype == np.float32 and whole.flags.c_contiguous
        np.testing.assert_allclose(whole, expected, atol=1e-3)
        pieces = [scan.native(low, min(low + 3, slow)) for low in range(0, slow, 3)]
        np.testing.assert_array_equal(np.concatenate(pieces), whole)
        assert any("resampled to cubes" in text for text in scan.warnings)


def test_between_two_voxels_is_their_mean_and_on_a_voxel_its_value(tmp_path):
    values = np.random.default_rng(1).integers(0, 1000, (6, 5, 4)).astype(np.uint16)
    write_scan(tmp_path / "scan.nrrd", values, (0.5, 0.5, 1.0))
    with open_scan(tmp_path / "scan.nrrd") as reader:
        fine = cubic(reader).native(0, 7).transpose(2, 1, 0)
    np.testing.assert_array_equal(fine[:, :, ::2], values)
    np.testing.assert_array_equal(fine[:, :, 1::2], 0.5 * (values[:, :, 1:].astype(np.float32) + values[:, :, :-1]))


def test_cubes_are_left_alone(phantom, tmp_path):
    np.save(tmp_path / "scan.npy", phantom)
    with open_scan(tmp_path / "scan.npy", ScanSettings(spacing=0.4)) as reader:
        assert cubic(reader) is reader
    write_scan(tmp_path / "scan.nrrd", phantom, (0.4, 0.4001, 0.4))
    with open_scan(tmp_path / "scan.nrrd") as reader:
        assert cubic(reader) is reader
    write_scan(tmp_path / "scan.nrrd", phantom, (0.4, 0.41, 0.4))
    with open_scan(tmp_path / "scan.nrrd") as reader:
        scan = cubic(reader)
        assert scan is not reader and cubic(scan) is scan
