"""Strand files: each format comes back equal, its bytes are the published layout, damage is refused."""

import struct

import numpy as np
import pytest

from ct2hair_addon.errors import StrandFileError
from ct2hair_addon.strand_files import FORMATS, read_strands, write_strands
from ct2hair_addon.strands import Strands


def strands() -> Strands:
    return Strands.from_polylines(
        [np.array([[1, 2, 3], [1, 2, 5]], np.float32), np.array([[0, 0, 0], [4, 0, 0], [8, 0.5, 0]], np.float32)]
    )


@pytest.mark.parametrize("ending", FORMATS)
def test_each_format_comes_back_equal(ending, tmp_path):
    write_strands(strands(), tmp_path / f"hair{ending}")
    back = read_strands(tmp_path / f"hair{ending}")
    np.testing.assert_array_equal(back.points, strands().points)
    np.testing.assert_array_equal(back.offsets, strands().offsets)
    assert [p.name for p in tmp_path.iterdir()] == [f"hair{ending}"]


def test_layouts_are_the_published_ones(tmp_path):
    for ending in (".data", ".bin", ".hair"):
        write_strands(strands(), tmp_path / f"hair{ending}")
    data = (tmp_path / "hair.data").read_bytes()
    assert struct.unpack_from("<ii6fi", data) == (2, 2, 1, 2, 3, 1, 2, 5, 3)
    binary = (tmp_path / "hair.bin").read_bytes()
    assert struct.unpack_from("<ii7f", binary) == (2, 2, 1, 2, 3, 0, 0, 1, 0)
    hair = (tmp_path / "hair.hair").read_bytes()
    assert hair[:4] == b"HAIR" and struct.unpack_from("<3I", hair, 4) == (2, 5, 3)
    assert struct.unpack_from("<2H3f", hair, 128) == (1, 2, 1, 2, 3)
    assert len(hair) == 128 + 4 + 60


def test_hair_files_with_a_default_segment_count_are_read(tmp_path):
    header = struct.pack("<4s4I5f88s", b"HAIR", 2, 4, 2, 1, 0, 0, 0, 0, 0, b"")
    points = np.arange(12, dtype="<f4")
    (tmp_path / "a.hair").write_bytes(header + points.tobytes())
    np.testing.assert_array_equal(read_strands(tmp_path / "a.hair").counts, [2, 2])


@pytest.mark.parametrize("ending", FORMATS)
def test_truncated_files_are_refused(ending, tmp_path):
    path = tmp_path / f"hair{ending}"
    write_strands(strands(), path)
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(StrandFileError, match=rf"hair\{ending}"):
        read_strands(path)


def test_one_format_under_anothers_name_is_refused(tmp_path):
    write_strands(strands(), tmp_path / "a.data")
    (tmp_path / "a.data").rename(tmp_path / "a.bin")
    with pytest.raises(StrandFileError):
        read_strands(tmp_path / "a.bin")


def test_unknown_endings_missing_files_and_nan_are_named(tmp_path):
    with pytest.raises(StrandFileError, match=r"known are \.npz"):
        read_strands(tmp_path / "a.xyz")
    with pytest.raises(StrandFileError, match="no such file"):
        read_strands(tmp_path / "a.data")
    write_strands(Strands(np.full((2, 3), np.nan), np.array([0, 2])), tmp_path / "nan.data")
    with pytest.raises(StrandFileError, match="2 of 2 points are not finite"):
        read_strands(tmp_path / "nan.data")


def test_the_real_groom_is_read(shared_data):
    groom = read_strands(shared_data / "sintel" / "strands.data")
    assert len(groom) == 11_400 and set(groom.counts) == {16}
