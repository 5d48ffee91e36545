"""Easing: short waves of straight hair go, its bends and whole curls stay."""

from __future__ import annotations

import numpy as np
import pytest

from ct2hair_addon.refinement.curves import (
    EASED_BY,
    _solve_bands,
    eased,
    easing_lengths,
    mean_curvature,
    segment_lengths,
)
from ct2hair_addon.strands import Strands

VOXEL = 0.4


def arc(radius, length=120.0, step=VOXEL):
    t = np.arange(0.0, length, step) / radius
    return radius * np.stack([np.cos(t), np.sin(t), np.zeros_like(t)], axis=1)


def one(points):
    return Strands(np.asarray(points, np.float32), np.array([0, len(points)]))


def ease(points, lengths=None):
    strands = one(points)
    lengths = easing_lengths(mean_curvature(strands, VOXEL), VOXEL) if lengths is None else np.array([lengths])
    return eased(np.asarray(points, float), strands.offsets, lengths, VOXEL)


def test_the_bands_are_solved_as_the_whole_matrix():
    rng = np.random.default_rng(0)
    factor = np.tril(rng.normal(size=(12, 12)) * 0.3, 0) * (np.abs(np.subtract.outer(range(12), range(12))) < 4) + np.eye(12)
    whole, right = factor @ factor.T, rng.normal(size=(12, 3))
    band = np.array([[whole[i, i + k] if i + k < 12 else 0.0 for k in range(4)] for i in range(12)])
    found = right.copy()
    _solve_bands(band, found)
    np.testing.assert_allclose(found, np.linalg.solve(whole, right), atol=1e-9)


def test_curvature_is_that_of_an_arc_whatever_its_short_waves():
    clean = arc(50.0)
    assert mean_curvature(one(clean), VOXEL)[0] == pytest.approx(1 / 50.0, rel=0.05)
    wave = 0.04 * np.sin(2 * np.pi * np.arange(len(clean)) * VOXEL / 2.0)
    assert mean_curvature(one(clean + wave[:, None] * [0, 0, 1]), VOXEL)[0] < 1.6 / 50.0


def test_noise_of_smooth_hair_is_eased_and_its_bend_kept():
    clean, rng = arc(60.0), np.random.default_rng(1)
    noisy = clean + rng.normal(size=clean.shape) * 0.08
    found = ease(noisy)
    inside = slice(12, -12)
    before, after = (np.sqrt(((some - clean)[inside] ** 2).sum(axis=1).mean()) for some in (noisy, found))
    assert after < 0.5 * before
    np.testing.assert_array_equal(found[0], noisy[0])
    np.testing.assert_allclose(ease(clean), clean, atol=0.02)


def test_a_curl_is_left_as_it_is():
    s = np.arange(0.0, 150.0, VOXEL)
    curl = np.stack([5 * np.cos(s / 6.0), 5 * np.sin(s / 6.0), 0.5 * s], axis=1)
    assert easing_lengths(mean_curvature(one(curl), VOXEL), VOXEL)[0] == 0.0
    np.testing.assert_array_equal(ease(curl), curl)


def test_nothing_moves_farther_than_tracing_is_off():
    s = np.arange(0.0, 100.0, VOXEL)
    wave = np.stack([2.0 * np.sin(s / 1.5), np.zeros_like(s), s], axis=1)
    moved = ease(wave, lengths=10.0) - wave
    assert 0.0 < np.sqrt((moved**2).sum(axis=1).mean()) <= EASED_BY * VOXEL


def test_each_strand_is_eased_by_itself():
    two = [arc(60.0) + np.random.default_rng(seed).normal(size=(300, 3)) * 0.05 for seed in range(2)]
    offsets = np.array([0, 300, 600])
    together = eased(np.concatenate(two), offsets, np.array([3.0, 2.0]), VOXEL)
    for n, length in enumerate((3.0, 2.0)):
        np.testing.assert_allclose(together[300 * n : 300 * (n + 1)], ease(two[n], length), atol=1e-9)
    assert segment_lengths(together, offsets)[[299, 599]].tolist() == [0.0, 0.0]
