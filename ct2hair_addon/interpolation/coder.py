"""Strands as codes that can be blended (paper 3.3.1): plain coordinates, cosines, or the learned prior, by the same calls."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.fft

from ..errors import CT2HairError
from ..settings import InterpolationSettings
from .prior import NetworkCoder

SHAPE_POINTS = 128
"""Points of a shape in the plain coders: 2 to 3 mm apart on long hair, so that curls of a few mm come through."""
COSINES = 64
"""Cosines that a strand is kept as, on each axis: up to 32 cycles from root to tip. Quicker is noise."""


class Coder(Protocol):
    """Turns strand shapes into codes and back. Shapes: (N, P, 3) float32 mm in the root's tangent frame (rows tangent,
    bitangent, normal), the root at 0. Codes: (N, C) float32, such that weighted sums of near codes are strands, too.

    points: how many points the shapes have that `decode` gives. in_phase: whether the curls of strands are to be brought
    into phase (`phase.py`) before they are blended. lossy: whether there are strands that a code doesn't hold.
    """

    points: int
    in_phase: bool
    lossy: bool

    def encode(self, shapes: np.ndarray) -> np.ndarray: ...

    def decode(self, codes: np.ndarray) -> np.ndarray: ...


class EuclideanCoder:
    """The plain blend that the paper compares its prior with (4.1.2): a code is the shape's coordinates."""

    in_phase = False
    lossy = False

    def __init__(self, points: int = SHAPE_POINTS) -> None:
        self.points = points

    def encode(self, shapes: np.ndarray) -> np.ndarray:
        return shapes.reshape(len(shapes), -1)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        return codes.reshape(len(codes), -1, 3)


class LinearCoder:
    """A strand as the cosines of its steps over the relative arc length (DCT-II), and the logarithm of its length.

    Blending codes blends directions, not positions: where neighbours part ways a blend keeps their length and form instead of
    being pulled straight. It is linear but for the length.
    """

    in_phase = True
    lossy = False

    def __init__(self, points: int = SHAPE_POINTS) -> None:
        self.points = points

    def encode(self, shapes: np.ndarray) -> np.ndarray:
        moves = np.diff(shapes.astype(np.float32), axis=1)
        length = np.linalg.norm(moves, axis=2).sum(axis=1)
        if not (np.isfinite(length) & (length > 0.0)).all():
            raise CT2HairError("a strand of no length can't be blended; drop it first")
        steps = moves * (moves.shape[1] / length)[:, None, None]
        spectrum = scipy.fft.dct(steps, axis=1, norm="ortho")[:, :COSINES] / np.sqrt(steps.shape[1])
        return np.concatenate([np.log(length)[:, None], spectrum.reshape(len(shapes), -1)], axis=1).astype(np.float32)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        count = self.points - 1
        spectrum = np.zeros((len(codes), count, 3), np.float32)
        kept = codes[:, 1:].reshape(len(codes), -1, 3)[:, :count]
        spectrum[:, : kept.shape[1]] = kept * np.sqrt(np.float32(count))
        steps = scipy.fft.idct(spectrum, axis=1, norm="ortho")
        steps *= (np.exp(codes[:, 0]) / count)[:, None, None]
        points = np.zeros((len(codes), self.points, 3), np.float32)
        np.cumsum(steps, axis=1, out=points[:, 1:])
        return points


def blend(codes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(M, C) float32: the weighted sums of codes (M, k, C) under weights (M, k) that add up to 1 (eq. 3)."""
    return np.einsum("mkc,mk->mc", codes, weights, optimize=True).astype(np.float32)


def chosen_coder(settings: InterpolationSettings, tally: dict[str, int] | None = None) -> Coder:
    """The coder that the settings ask for.

    Raises CT2HairError where the learned prior's weights or torch are missing or damaged; only where
    `settings.without_prior` says "linear" is the linear coder taken instead, and `tally` says so.
    """
    if settings.coder == "euclidean":
        return EuclideanCoder()
    if settings.coder == "linear":
        return LinearCoder()
    try:
        return NetworkCoder.load()
    except CT2HairError:
        if settings.without_prior != "linear":
            raise
        if tally is not None:
            tally["the learned prior can't be loaded: blended by the linear one instead"] = 1
        return LinearCoder()
