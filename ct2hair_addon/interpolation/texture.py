"""The paper's own way over the scalp: texels drawn at random, and the weights of eq. 3 (paper 3.3.1, Fig. 4)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..head import ScalpPoints
from ..settings import InterpolationSettings

SIDE = 2048
"""Texels along an edge where the settings leave it open (supplement 4)."""


def texels_of(uv: np.ndarray, side: int) -> np.ndarray:
    """(M, 2) int64: the texels that texture coordinates (M, 2) lie in."""
    return np.clip(np.floor(np.asarray(uv, np.float64) * side), 0, side - 1).astype(np.int64)


def drawn_texels(
    head, guides_uv: np.ndarray, samples: int, settings: InterpolationSettings, seed: int
) -> tuple[ScalpPoints, dict[str, int]]:
    """Scalp points at the centres of texels drawn evenly from the scalp's region, and what was discarded.

    head: answers `on_scalp(uv)`. guides_uv: (N, 2) of the guides. samples: N_i, texels of the scalp that are drawn, none twice.
    A texel whose nearest guide's is not within [sigma_min, sigma_max] texels is discarded.
    """
    side = settings.texture or SIDE
    order = np.random.default_rng(seed).permutation(side * side)
    points: list[ScalpPoints] = []
    found = at = 0
    while found < samples and at < len(order):
        part = order[at : at + 2 * (samples - found) + 64]
        at += len(part)
        centres = (np.stack([part // side, part % side], axis=1) + 0.5) / side
        there = head.on_scalp(centres)
        there = there.select(np.flatnonzero(there.face >= 0)[: samples - found])
        found += len(there)
        points.append(there)
    texels = np.concatenate([texels_of(some.uv, side) for some in points])
    distance = cKDTree(texels_of(guides_uv, side)).query(texels)[0]
    near, far = distance < settings.nearest, distance > settings.farthest
    kept = ~near & ~far
    tally = {
        "texels drawn": len(texels),
        "texels discarded: nearer to a guide than sigma_min": int(near.sum()),
        "texels discarded: farther from a guide than sigma_max": int(far.sum()),
    }
    begin, chosen = 0, []
    for some in points:
        chosen.append(some.select(kept[begin : begin + len(some)]))
        begin += len(some)
    keys = ("distance", "position", "normal", "face", "bary", "uv")
    return ScalpPoints(*(np.concatenate([getattr(some, key) for some in chosen]) for key in keys)), tally


def eq3_weights(distance: np.ndarray, near: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """(M, k) float32 weights of eq. 3, adding up to 1: nearness in texels times likeness of the codes to the nearest guide's.

    distance, near: (M, k) texels and indices of guides, nearest first. codes: (N, C). Both factors are normalised over the k
    neighbours as in the text. Taken literally, its first factor grows with the distance and the farthest of the three would
    weigh most; it is read as the distance's inverse. A code at more than a right angle to the nearest's has no weight.
    """
    close = 1.0 / np.maximum(distance, 0.5)
    close /= np.linalg.norm(close, axis=1, keepdims=True)
    alike = np.einsum("mkc,mc->mk", codes[near], codes[near[:, 0]]).astype(np.float64)
    alike = np.maximum(alike / np.maximum(np.linalg.norm(alike, axis=1, keepdims=True), 1e-30), 0.0)
    weight = close * alike
    weight[:, 0] = np.maximum(weight[:, 0], 1e-12)
    return (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
