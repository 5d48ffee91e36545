"""Synthesis: what the scanner's values mean, where things lie, and that slabs and threads change nothing."""

import json

import numpy as np
import pytest

from ct2hair_addon.errors import ScanError, SettingsError
from ct2hair_addon.evaluation import render_density, strand_peak, synthesis, synthesize
from ct2hair_addon.evaluation.hairnet import hairnet, knots
from ct2hair_addon.head import Head
from ct2hair_addon.settings import SynthesisSettings
from ct2hair_addon.strands import Strands

SPACING = 0.8


def made(strands, head, folder, name="scan.npy", **changes):
    result = synthesize(strands, head, folder / name, SPACING, **changes)
    return result, np.load(folder / name)


def test_a_clean_scan_is_the_blurred_count(ball, spikes, tmp_path):
    result, scan = made(spikes, ball, tmp_path, clean=True)
    expected = render_density(result.truth, SPACING, 0.85, (0.0, 0.0, 0.0), scan.shape)
    assert scan.dtype == np.float32
    np.testing.assert_allclose(scan, expected.block((0, 0, 0), scan.shape), atol=1e-6)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scan.head.obj", "scan.json", "scan.npy", "scan.strands.npz"]
    # an array file holds no origin, so the truth is moved into the array's frame
    moved = json.loads((tmp_path / "scan.json").read_text(encoding="utf-8"))["moved_by_mm"]
    np.testing.assert_allclose(Strands.load(tmp_path / "scan.strands.npz").points, spikes.points + np.float32(moved), atol=1e-4)


def test_air_noise_and_strands_have_the_values_asked_for(ball, spikes, tmp_path):
    result, scan = made(spikes, ball, tmp_path, snr=4.0, mannequin=False, net=False)
    clean = render_density(result.truth, SPACING, 0.85, (0.0, 0.0, 0.0), scan.shape).block((0, 0, 0), scan.shape)
    noise = scan.astype(np.float64) - 1000.0 - clean * (130.0 / strand_peak(0.85))
    assert scan.dtype == np.uint16
    assert abs(noise.mean()) < 0.1
    assert noise.std() == pytest.approx(130.0 / 4.0, rel=0.01)
    # normal, and neighbours know nothing of each other
    z = noise / noise.std()
    assert (z**4).mean() == pytest.approx(3.0, abs=0.05)
    for axis in range(3):
        assert abs((z * np.roll(z, 1, axis)).mean()) < 0.01


def test_slabs_and_seeds(ball, spikes, tmp_path, monkeypatch):
    _, whole = made(spikes, ball, tmp_path, seed=5)
    monkeypatch.setattr(synthesis, "_SLAB_BYTES", 1.0)
    _, by_slabs = made(spikes, ball, tmp_path, "again.npy", seed=5)
    _, other = made(spikes, ball, tmp_path, "other.npy", seed=6)
    np.testing.assert_array_equal(whole, by_slabs)
    assert (whole != other).mean() > 0.9


def test_the_mannequin_is_a_shell_below_the_surface(ball, spikes, tmp_path):
    result, scan = made(spikes, ball, tmp_path, snr=1000.0, net=False, mannequin_level=10.0, mannequin_thickness=3.0)
    centre = (result.head.vertices.min(axis=0) + result.head.vertices.max(axis=0)) / 2
    # down from the centre, where there is no hair
    below = np.rint((centre - [0, 0, 1] * np.array([[20.0], [38.5], [42.0]])) / SPACING).astype(int)
    np.testing.assert_allclose(scan[tuple(below.T)].astype(float), [1000.0, 2300.0, 1000.0], atol=80.0)
    _, solid = made(spikes, ball, tmp_path, "solid.npy", snr=1000.0, net=False, mannequin="solid", mannequin_level=10.0)
    assert solid[tuple(below[0])] == pytest.approx(2300.0, abs=5.0)


def test_the_net_covers_the_scalp_within_its_height(ball):
    head = Head(ball)
    threads = hairnet(head, cell=4.0, height=0.5, seed=1)
    radius = np.linalg.norm(threads.points, axis=1)
    assert radius.min() > 39.5 and radius.max() < 40.55
    assert (threads.points[:, 2] > -0.5).all()
    # hexagons of 4 mm between opposite sides: 2 sqrt(3) / width of thread an area
    expected = 2.0 / 4.0 * head.scalp_area
    assert threads.lengths().sum() == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("spacing", [0.2, 0.8])
def test_a_knot_peaks_at_its_level(spacing):
    roots = np.random.default_rng(2).uniform(0, 40 * spacing, size=(30, 3)).astype(np.float32)
    values = [render_density(knots(root[None], spacing, 4.0, 0.85, n), spacing).bricks.max() for n, root in enumerate(roots)]
    assert np.mean(values) == pytest.approx(4.0 * strand_peak(0.85), rel=0.15)


def test_formats_with_an_origin_leave_the_strands_where_they_are(ball, spikes, tmp_path):
    result = synthesize(spikes, ball, tmp_path / "scan.mha", 2.0, mannequin="none")
    np.testing.assert_array_equal(result.truth.points, spikes.points)
    assert result.files["strands"].name == "scan.strands.npz"


def test_bad_settings_are_named(ball, spikes, tmp_path):
    with pytest.raises(SettingsError, match="snr"):
        synthesize(spikes, ball, tmp_path / "scan.npy", 1.0, snr=0.0)
    with pytest.raises(SettingsError, match="unknown setting 'fog'"):
        SynthesisSettings().changed({"fog": 1})
    with pytest.raises(SettingsError, match="voxel size"):
        synthesize(spikes, ball, tmp_path / "scan.npy", 0.0)
    assert not list(tmp_path.iterdir())


def test_a_grid_that_no_memory_holds_is_refused_before_the_work(ball, spikes, tmp_path, monkeypatch):
    monkeypatch.setattr(synthesis, "allowed_memory", lambda: 0.015)
    with pytest.raises(ScanError, match=r"scan\.vdb.*GB.*\.nrrd"):
        synthesize(spikes, ball, tmp_path / "scan.vdb", 0.5)
    assert not list(tmp_path.iterdir())
    synthesize(spikes, ball, tmp_path / "scan.vdb", 0.5, clean=True)
    assert (tmp_path / "scan.vdb").is_file()


def test_rings_are_rings(ball, spikes, tmp_path):
    _, scan = made(spikes, ball, tmp_path, rings=5.0, net=False, mannequin="none", snr=40.0)
    slice_ = scan[:, :, 2].astype(float)
    x, y = np.meshgrid(*[np.arange(n) - 0.5 * (n - 1) for n in slice_.shape], indexing="ij")
    ring = np.floor(np.hypot(x, y) + 0.5) == 20
    assert slice_[ring].std() < 6.0
    assert slice_[5:-5, slice_.shape[1] // 2].std() > 8.0
