"""Blending strands: codes that come back, curls that don't cancel, and strands at places on the scalp."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from ct2hair_addon import blending_study
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.interpolation import Blending, EuclideanCoder, LinearCoder, NetworkCoder
from ct2hair_addon.interpolation.phase import in_phase, swing_share
from ct2hair_addon.interpolation.procedural import procedural_strands
from ct2hair_addon.settings import Settings


def curl(phase: float, radius: float = 6.0, turns: float = 6.0, handed: float = 1.0, points: int = 128) -> np.ndarray:
    """(points, 3) mm: a curl that hangs on a bent course, the root at 0."""
    t = np.linspace(0.0, 1.0, points)
    angle = 2.0 * np.pi * turns * t + phase
    course = np.stack([60.0 * t**2, 0.0 * t, 150.0 * t], axis=1)
    wound = course + radius * np.stack([np.cos(angle), handed * np.sin(angle), 0.0 * t], axis=1)
    return (wound - wound[0]).astype(np.float32)


def mean_radius(strand: np.ndarray, turns: float = 6.0) -> float:
    """Radius of a curl as `curl` makes them: amplitude of its swing in y over the middle of the strand."""
    t = np.linspace(0.0, 1.0, len(strand))
    middle = (t > 0.15) & (t < 0.85)
    y = strand[middle, 1] - strand[middle, 1].mean()
    wave = np.exp(-2j * np.pi * turns * t[middle])
    return float(2.0 * np.abs((y * wave).mean()))


@pytest.mark.parametrize("coder", [LinearCoder(), EuclideanCoder()])
def test_codes_come_back(coder):
    shapes = procedural_strands(60, 11, coder.points).shapes
    made = coder.decode(coder.encode(shapes))
    assert made.shape == shapes.shape and made.dtype == np.float32
    length = np.linalg.norm(np.diff(shapes, axis=1), axis=2).sum(axis=1)
    assert (np.abs(made - shapes).max(axis=(1, 2)) < 0.006 * length).all()


def test_a_strand_of_no_length_is_refused():
    with pytest.raises(CT2HairError, match="no length"):
        LinearCoder().encode(np.zeros((2, 128, 3), np.float32))


def test_equal_neighbours_stay_as_they_are():
    same = np.tile(curl(0.3), (1, 3, 1, 1))
    brought = in_phase(same, np.array([[0.5, 0.3, 0.2]]))
    np.testing.assert_allclose(brought, same, atol=0.02)


@pytest.mark.parametrize("apart", [1.0, 2.0, 2.8])
def test_curls_out_of_phase_do_not_cancel(apart):
    shapes = np.stack([curl(0.0), curl(apart)])[None]
    weights = np.array([[0.6, 0.4]])
    plain = (shapes[0] * weights[0][:, None, None]).sum(axis=0)
    brought = in_phase(shapes, weights)
    blended = (brought[0] * weights[0][:, None, None]).sum(axis=0)
    assert mean_radius(curl(0.0)) == pytest.approx(6.0, rel=0.05)
    assert mean_radius(blended) == pytest.approx(6.0, rel=0.08)
    assert mean_radius(plain) < 6.0 * np.cos(apart / 2.0) + 0.6


def test_the_blend_s_phase_lies_between():
    shapes = np.stack([curl(0.0), curl(1.0)])[None]
    brought = in_phase(shapes, np.array([[0.5, 0.5]]))
    half = curl(0.5)
    error = np.linalg.norm((brought[0].mean(axis=0) - half)[10:-10], axis=1)
    assert np.median(error) < 1.0


def test_a_curl_of_the_other_hand_takes_the_nearest_s_swing():
    shapes = np.stack([curl(0.0), curl(0.0, handed=-1.0)])[None]
    brought = in_phase(shapes, np.array([[0.6, 0.4]]))
    assert mean_radius(brought[0].mean(axis=0)) == pytest.approx(6.0, rel=0.12)


def test_smooth_strands_have_no_swing():
    t = np.linspace(0.0, 1.0, 128)
    smooth = np.stack([40.0 * t**2, 10.0 * np.sin(t), 150.0 * t], axis=1)[None]
    assert swing_share(smooth)[0] < 0.05 < 0.4 < swing_share(curl(0.0)[None])[0]


class TestBlending:
    UV = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])

    def test_a_place_beside_a_guide_gets_its_strand(self):
        shapes = np.stack([curl(p) for p in (0.0, 0.5, 1.0, 1.5)])
        made, weights = Blending(shapes, self.UV, LinearCoder(), Settings().interpolation).at(np.array([[1e-6, 1e-6]]))
        np.testing.assert_allclose(made[0], shapes[0], atol=0.3)
        assert weights[0].sum() == pytest.approx(1.0) and weights[0, 0] > 0.99

    def test_the_linear_coder_keeps_curls_that_the_euclidean_flattens(self):
        shapes = np.stack([curl(p) for p in (0.0, 1.8, -1.8, 2.5)])
        settings = Settings().changed({"interpolation.similarity": 0.0}).interpolation
        place = np.array([[0.4, 0.4]])
        radii = [
            mean_radius(Blending(shapes, self.UV, coder, settings).at(place)[0][0])
            for coder in (EuclideanCoder(), LinearCoder())
        ]
        assert radii[0] < 4.5 and radii[1] > 5.3

    def test_coils_beyond_the_learned_prior_are_kept_by_cosines(self):
        coils = np.stack([curl(p, radius=2.0, turns=30.0, points=256) for p in (0.0, 0.3, 0.6, 0.9)])
        network = NetworkCoder.load()
        assert mean_radius(network.decode(network.encode(coils[:1]))[0], 30.0) < 1.0
        blending = Blending(coils, self.UV, network, Settings().interpolation)
        made, _ = blending.at(np.array([[0.3, 0.2], [1e-6, 1e-6]]))
        assert not blending.held.any()
        assert mean_radius(made[1], 30.0) == pytest.approx(mean_radius(coils[0], 30.0), rel=0.05)
        assert mean_radius(made[0], 30.0) > 0.8 * mean_radius(coils[0], 30.0)

    def test_noisy_guides_are_held_by_the_learned_prior(self):
        generator = np.random.default_rng(4)
        smooth = np.stack([curl(p, points=256) for p in (0.0, 0.3, 0.6, 0.9)])
        noise = np.repeat(generator.normal(0.0, 0.15, (4, 64, 3)), 4, axis=1)
        noisy = (smooth + gaussian_filter1d(noise, 3.0, axis=1)).astype(np.float32)
        assert Blending(noisy, self.UV, NetworkCoder.load(), Settings().interpolation).held.all()

    def test_phase_found_blends_as_the_paper_does(self):
        shapes = np.stack([curl(p) for p in (0.0, 1.8, -1.8, 2.5)])
        settings = Settings().changed({"interpolation.similarity": 0.0, "interpolation.phase": "found"}).interpolation
        made, _ = Blending(shapes, self.UV, LinearCoder(), settings).at(np.array([[0.4, 0.4]]))
        assert mean_radius(made[0]) < 4.5


@pytest.mark.slow
def test_held_back_curls_keep_their_curvature_and_length_in_the_learned_blend():
    settings = blending_study.settings_for(0.0, None)
    scores = blending_study.study("curly", settings, strands=2000)
    euclidean, network, linear = scores["euclidean"], scores["network"], scores["linear"]
    for learned in (network, linear):
        assert abs(learned["length"] - 1.0) < 0.06 < abs(euclidean["length"] - 1.0)
        assert learned["spectrum"] < 0.5 * euclidean["spectrum"]
        assert learned["like"] < euclidean["like"]
        assert learned["distance"] < 1.03 * euclidean["distance"]
