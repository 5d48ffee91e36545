"""What a graphics card works out is what the processor does: the same torch code, run here by the processor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.evaluation import render_density
from ct2hair_addon.refinement import card, device, fit
from ct2hair_addon.refinement.binning import bin_segments
from ct2hair_addon.refinement.blur import blurred
from ct2hair_addon.refinement.curves import control_points
from ct2hair_addon.refinement.fit import Potential
from ct2hair_addon.refinement.splat import misfit
from ct2hair_addon.settings import Settings
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume

SPACING, BLUR = 0.5, 0.85


@pytest.fixture(scope="module")
def scene():
    """Thirty helices of many turns and lengths, their scan with noise, and themselves a little aside; half hidden at roots."""
    generator = np.random.default_rng(5)
    strands = []
    for _ in range(30):
        s = np.linspace(0.0, generator.uniform(10.0, 60.0), 120)
        turn, wide = s / generator.uniform(2.0, 9.0), generator.uniform(0.5, 5.0)
        curl = np.stack([wide * np.cos(turn), wide * np.sin(turn), s], 1)
        strands.append(curl @ np.linalg.qr(generator.normal(size=(3, 3)))[0] + generator.uniform(-20, 20, 3))
    truth = Strands.from_polylines(strands)
    scan = render_density(truth, SPACING, BLUR)
    noise = generator.normal(0.0, 0.03, scan.bricks.shape).astype(np.float32)
    scan = BrickVolume(scan.table, scan.bricks + noise, scan.spacing, scan.origin)
    scan.bricks[:, :5] = 0.0  # cleared
    points, offsets = control_points(truth, 64)
    voxels = scan.to_voxel(points + generator.normal(0.0, 0.2, points.shape))
    visible = np.clip(generator.uniform(-1.0, 2.0, len(points)), 0.0, 1.0)
    return scan, voxels, offsets, visible


def asked(potential, voxels, offsets, visible):
    forces, weights = np.empty_like(voxels), np.empty(len(voxels))
    return potential.forces(voxels, offsets, visible, forces, weights), forces, weights


@pytest.mark.parametrize("chunks", ["one", "many"])
def test_the_card_asks_what_the_processor_asks(scene, chunks, monkeypatch):
    scan, voxels, offsets, visible = scene
    if chunks == "many":
        monkeypatch.setattr(card, "SAMPLES", 300)
        monkeypatch.setattr(card, "ROWS", 7)
    known, here = Potential(scan, BLUR, 1.0), card.CardPotential(scan, BLUR, 1.0, torch.device("cpu"))
    error, forces, weights = asked(known, *scene[1:])
    residual, errors = np.empty(scan.bricks.shape, np.float32), np.empty(len(scan.bricks))
    segments = bin_segments(voxels, offsets, visible, scan.table)
    assert list(misfit(voxels, visible, segments, scan, BLUR, 1.0, residual, np.arange(len(residual)), errors))
    for _ in range(2):  # a second look starts from nothing again
        found, pull, shown = asked(here, voxels, offsets, visible)
        assert found == pytest.approx(error, rel=1e-5)
        potential = blurred(BrickVolume(scan.table, residual, scan.spacing, scan.origin), BLUR)
        np.testing.assert_allclose(here.values[: len(scan.bricks)].numpy(), potential, atol=2e-5 * np.abs(potential).max())
        np.testing.assert_allclose(shown, weights)
        assert np.abs(forces).max() > 0.01
        np.testing.assert_allclose(pull, forces, atol=2e-3 * np.abs(forces).max())


def test_strands_outside_the_scan_ask_for_nothing(scene):
    scan, voxels, offsets, _ = scene
    far = voxels + 4000.0
    far[offsets[3] : offsets[4]] -= 9000.0
    here = card.CardPotential(scan, BLUR, 1.0, torch.device("cpu"))
    error, forces, _ = asked(here, far, offsets, np.ones(len(far)))
    assert error == pytest.approx(0.5 * np.square(scan.bricks, dtype=np.float64).sum(), rel=1e-5)
    np.testing.assert_array_equal(forces, 0.0)


def test_a_fit_on_the_card_ends_where_the_processors_does(scene, monkeypatch):
    scan, voxels, offsets, _ = scene

    class Free:
        def look(self, points):
            return np.ones(len(points))

        def push(self, points, offsets):
            pass

    class Profile:
        blur, line_mass = BLUR, SPACING**2

    settings = Settings.preset("draft").refinement
    given = scan.to_scan(voxels)
    known, tally = fit.fit_to_volume(given, offsets, scan, Profile, Free(), settings, "cpu")
    assert tally["fitted on a graphics card"] == 0
    monkeypatch.setattr(fit, "takes_card", lambda device, needed=0.0: True)
    monkeypatch.setattr(card, "CUDA", torch.device("cpu"))
    found, tally = fit.fit_to_volume(given, offsets, scan, Profile, Free(), settings, "auto")
    assert tally["fitted on a graphics card"] == 1
    assert np.linalg.norm(known - given, axis=1).max() > 0.2
    np.testing.assert_allclose(found, known, atol=0.02)


def test_a_card_without_room_is_left_and_one_that_is_not_there_is_an_error(scene, monkeypatch):
    needed = card.bytes_needed(scene[0])
    assert needed > 3 * scene[0].bricks.nbytes
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert not device.takes_card("auto", needed)
    assert not device.takes_card("cpu", needed)
    with pytest.raises(CT2HairError, match=r"run\.device is cuda, but torch"):
        device.takes_card("cuda", needed)
    with pytest.raises(CT2HairError, match=r"run\.device is cuda, but torch"):
        fit._potentials(scene[0], "cuda")
    monkeypatch.setattr(device, "_build", lambda: "torch 2.13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (needed, 2 * needed))
    assert device.takes_card("auto", needed)
    assert not device.takes_card("cpu", needed)
    assert not device.takes_card("cuda", needed + 1)
