"""Strands as codes that can be blended (paper 3.3.1): here plain shapes in the root's tangent frame.

The learned prior fits behind the same two calls.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Coder(Protocol):
    """Turns strand shapes into codes and back. Shapes: (N, P, 3) float32 mm in the root's tangent frame (rows tangent,
    bitangent, normal), the root at 0. Codes: (N, C) float32, such that weighted sums of near codes are strands, too."""

    def encode(self, shapes: np.ndarray) -> np.ndarray: ...

    def decode(self, codes: np.ndarray) -> np.ndarray: ...


class EuclideanCoder:
    """The plain blend that the paper compares its prior with (4.1.2): a code is the shape's coordinates."""

    def encode(self, shapes: np.ndarray) -> np.ndarray:
        return shapes.reshape(len(shapes), -1)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        return codes.reshape(len(codes), -1, 3)


def blend(codes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(M, C) float32: the weighted sums of codes (M, k, C) under weights (M, k) that add up to 1 (eq. 3)."""
    return np.einsum("mkc,mk->mc", codes, weights, optimize=True).astype(np.float32)
