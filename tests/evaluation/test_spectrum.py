"""The curvature's spectrum, of curves whose curvature is known."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.evaluation import curvature_spectrum, evaluate, format_scores
from ct2hair_addon.strands import Strands


def helix(radius: float, rise: float, length: float = 200.0) -> np.ndarray:
    """(P, 3): `rise` mm along its axis a radian."""
    angle = np.arange(0.0, length, 0.7) / np.hypot(radius, rise)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), rise * angle], axis=1).astype(np.float32)


def wave(size: float, period: float, length: float = 200.0) -> np.ndarray:
    z = np.arange(0.0, length, 0.7)
    return np.stack([size * np.sin(2 * np.pi * z / period), np.zeros_like(z), z], axis=1).astype(np.float32)


def test_a_curl_has_its_curvature_at_the_length_of_its_turns():
    spectrum = curvature_spectrum(Strands.from_array(helix(5.0, 2.5)[None]))
    assert spectrum["25-60"] == pytest.approx(1000 * 5.0 / (5.0**2 + 2.5**2), rel=0.01)
    assert spectrum["10-25"] < 3.0 and spectrum["60-150"] < 4.0


@pytest.mark.parametrize("period, band", [(15.0, "10-25"), (40.0, "25-60"), (90.0, "60-150")])
def test_a_wave_is_found_in_its_band(period, band):
    size = 0.01 * period
    spectrum = curvature_spectrum(Strands.from_array(wave(size, period, 400.0)[None]))
    assert spectrum[band] == pytest.approx(1000 * size * (2 * np.pi / period) ** 2 / np.sqrt(2), rel=0.06)
    assert max(spectrum, key=spectrum.get) == band


def test_strands_count_by_their_length_and_short_ones_not_at_all():
    straight = wave(0.0, 40.0, 200.0)
    curls, short = helix(5.0, 2.5, 200.0), helix(5.0, 2.5, 10.0)
    points = np.concatenate([curls, straight, short])
    offsets = np.cumsum([0, len(curls), len(straight), len(short)])
    both = curvature_spectrum(Strands(points, offsets))
    alone = curvature_spectrum(Strands.from_array(curls[None]))
    assert both["25-60"] == pytest.approx(alone["25-60"] / np.sqrt(2), rel=0.02)
    assert set(curvature_spectrum(Strands.from_array(short[None])).values()) == {0.0}


def test_evaluate_tells_a_curl_pulled_straight():
    truth, flat = Strands.from_array(helix(5.0, 2.5)[None]), Strands.from_array(helix(2.5, 5.0)[None])
    scores = evaluate(truth, flat, voxels=(1.0,))
    assert scores["curvature"]["25-60"]["result"] == pytest.approx(0.5 * scores["curvature"]["25-60"]["truth"], rel=0.03)
    assert "25-60" in format_scores(scores)
