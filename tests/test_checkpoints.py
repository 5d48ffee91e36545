"""Checkpoints: results come back bit for bit, keys tell inputs and settings apart, damage is no result."""

from dataclasses import dataclass

import numpy as np
import pytest

from ct2hair_addon.checkpoints import Checkpoints, chained_key, fingerprint
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume


@dataclass(frozen=True)
class Result:
    strands: Strands
    volume: BrickVolume
    level: float
    tally: dict[str, int]
    warnings: tuple[str, ...]
    nothing: None = None


def make() -> Result:
    rng = np.random.default_rng(0)
    strands = Strands(rng.normal(size=(5, 3)), np.array([0, 2, 5]), {"support": rng.random(2, np.float32)})
    volume = BrickVolume.from_dense(rng.random((20, 20, 20), np.float32), 0.4, (1, 2, 3))
    return Result(strands, volume, 0.1 + 0.2, {"dropped: too short": 3}, ("a", "b"))


def store(tmp_path) -> Checkpoints:
    return Checkpoints(tmp_path / "checkpoints", (Result, Strands, BrickVolume))


def test_a_result_comes_back_bit_for_bit(tmp_path):
    result, checkpoints = make(), store(tmp_path)
    checkpoints.save("guides", "key", result)
    back = checkpoints.load("guides", "key")
    assert back.strands.points.tobytes() == result.strands.points.tobytes()
    assert back.strands.strand_attributes["support"].tobytes() == result.strands.strand_attributes["support"].tobytes()
    assert back.volume.bricks.tobytes() == result.volume.bricks.tobytes()
    assert back.volume.origin.tolist() == [1, 2, 3] and back.volume.spacing == 0.4
    assert (back.level, back.tally, back.warnings, back.nothing) == (0.1 + 0.2, {"dropped: too short": 3}, ("a", "b"), None)


def test_shared_arrays_are_written_once(tmp_path):
    checkpoints, array = store(tmp_path), np.zeros(100_000)
    checkpoints.save("a", "key", [array, array])
    assert checkpoints.path("a").stat().st_size < 1_000_000
    first, second = checkpoints.load("a", "key")
    np.testing.assert_array_equal(first, second)


def test_another_key_a_missing_and_a_truncated_file_are_no_result(tmp_path):
    checkpoints = store(tmp_path)
    assert checkpoints.load("guides", "key") is None
    checkpoints.save("guides", "key", make())
    assert checkpoints.load("guides", "other") is None
    path = checkpoints.path("guides")
    for size in (path.stat().st_size // 2, 10, 0):
        path.write_bytes(path.read_bytes()[:size])
        assert checkpoints.load("guides", "key") is None


def test_keys_depend_on_everything_named():
    keys = {
        chained_key("", settings={"step": 1.0}),
        chained_key("", settings={"step": 2.0}),
        chained_key("x", settings={"step": 1.0}),
        chained_key("", settings={"step": 1.0}, seed=1),
    }
    assert len(keys) == 4


def test_fingerprints_tell_files_and_folders_apart(tmp_path):
    for name, text in (("a", "one"), ("b", "two")):
        (tmp_path / name).write_text(text)
    whole = fingerprint(tmp_path)
    assert fingerprint(tmp_path / "a") != fingerprint(tmp_path / "b")
    assert fingerprint(tmp_path) == whole
    (tmp_path / "b").write_text("tow")
    assert fingerprint(tmp_path) != whole


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", (Strands, BrickVolume))
    with pytest.raises(TypeError, match="Result"):
        checkpoints.save("guides", "key", make())
    assert not list(tmp_path.rglob("*.npz"))
