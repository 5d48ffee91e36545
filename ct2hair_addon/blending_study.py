"""How well strands are interpolated: a hairstyle's strands are held back, blended from the rest by each coder, and compared.

The paper's ablation 4.1.2 in figures (Euclidean against the learned prior), with the linear coder beside them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

from .evaluation import hairstyle
from .evaluation.spectrum import band_powers
from .head import Head, template_head
from .interpolation import Blending, EuclideanCoder, LinearCoder, NetworkCoder
from .settings import InterpolationSettings
from .strands import Strands

POINTS = 128
LIKE_REACH = 15.0
"""Real strands rooted within this many mm are asked whether they look like a blended one."""
NEAR_STRANDS = 24


def study(
    style: str, settings: InterpolationSettings, strands: int = 4000, held_back: float = 0.5, seed: int = 31, noise: float = 0.0
) -> dict[str, dict[str, float]]:
    """Scores by coder of a style's strands, a share of which is held back and blended from the rest at its own roots.

    noise: mm, standard deviation of a smooth error put on the strands that are kept, as tracing makes one. Scores:
    `distance` (mm, mean over points at the same share of the length), `angle` (degrees, mean between tangents there), `like`
    (degrees: the same angle to the held-back strand nearby that is most like it: how natural), `curvature` (rms curvature over
    the truth's), `spectrum` (largest departure of the curvature's power over the bands from the truth's, as a share),
    `length` (ratio).
    """
    truth, head = _grown(style, strands, seed)
    kept = np.random.default_rng(seed).random(len(truth)) >= held_back
    roots = head.closest_scalp(truth.roots)
    frames = head.frames(roots.face, roots.bary).astype(np.float64)
    real = truth.resampled(POINTS).astype(np.float64)
    guides = truth.select(kept)
    if noise > 0.0:
        guides = _with_noise(guides, noise, seed)
    scores = {}
    for name, coder in coders().items():
        shapes = _in_frames(guides, frames[kept], coder.points)
        blending = Blending(shapes, roots.uv[kept], coder, settings)
        made = blending.at(roots.uv[~kept])[0]
        made = np.einsum("nij,npi->npj", frames[~kept], made) + truth.roots[~kept][:, None]
        made = Strands.from_array(made.astype(np.float32)).resampled(POINTS).astype(np.float64)
        scores[name] = _scores(made, real[~kept], truth.roots[~kept])
    return scores


def coders() -> dict:
    """The coders that are compared."""
    return {"euclidean": EuclideanCoder(POINTS), "network": NetworkCoder.load(), "linear": LinearCoder(POINTS)}


def as_table(styles: Iterable[str], settings: InterpolationSettings, **options) -> str:
    """The scores of some styles as a Markdown table, a row a style and coder."""
    lines = [
        "| style | coder | distance mm | angle ° | unlike ° | curvature % | spectrum off % | length % |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for style in styles:
        for name, of in study(style, settings, **options).items():
            lines.append(
                f"| {style} | {name} | {of['distance']:.2f} | {of['angle']:.2f} | {of['like']:.2f} "
                f"| {100 * of['curvature']:.0f} | {100 * of['spectrum']:.0f} | {100 * of['length']:.1f} |"
            )
    return "\n".join(lines)


def settings_for(similarity: float | None, phase: str | None) -> InterpolationSettings:
    """The standard settings, with these changed where given."""
    changes = {key: value for key, value in (("similarity", similarity), ("phase", phase)) if value is not None}
    return dataclasses.replace(InterpolationSettings(), **changes)


@functools.lru_cache(maxsize=1)
def _grown(style: str, strands: int, seed: int) -> tuple[Strands, Head]:
    mesh = template_head()
    return hairstyle(style, mesh, strands, seed), Head(mesh)


def _in_frames(strands: Strands, frames: np.ndarray, points: int) -> np.ndarray:
    return np.einsum("nij,npj->npi", frames, strands.resampled(points) - strands.roots[:, None]).astype(np.float32)


def _with_noise(strands: Strands, size: float, seed: int) -> Strands:
    """Strands with a smooth random error: normal numbers every 4 mm, none at the root."""
    generator = np.random.default_rng([seed, 1])
    strands = Strands(strands.points, strands.offsets).resampled_by_step(4.0)
    error = generator.normal(0.0, size, strands.points.shape)
    error[strands.offsets[:-1]] = 0.0
    return strands.with_points(strands.points + error.astype(np.float32))


def _tangents(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    moves = np.diff(points, axis=1)
    size = np.linalg.norm(moves, axis=2)
    return moves / np.maximum(size, 1e-9)[:, :, None], size.sum(axis=1)


def _scores(made, truth, roots) -> dict[str, float]:
    tangents, length = _tangents(made)
    true_tangents, true_length = _tangents(truth)
    other_tangents = true_tangents[:, ::2].astype(np.float32)
    angle = np.degrees(np.arccos(np.clip((tangents * true_tangents).sum(axis=2), -1.0, 1.0))).mean(axis=1)
    distance, near = cKDTree(roots).query(roots, k=NEAR_STRANDS)
    cosine = np.einsum("nqc,nkqc->nkq", tangents[:, ::2].astype(np.float32), other_tangents[near], optimize=True)
    apart = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean(axis=2)
    apart[(distance > LIKE_REACH)] = 180.0
    spectrum, true_spectrum = _curvature_spectrum(tangents, length), _curvature_spectrum(true_tangents, true_length)
    counted = true_spectrum > 0.02 * true_spectrum.sum()
    return {
        "distance": float(np.linalg.norm(made - truth, axis=2).mean()),
        "angle": float(angle.mean()),
        "like": float(apart.min(axis=1).mean()),
        "curvature": float(np.sqrt(spectrum.sum() / true_spectrum.sum())),
        "spectrum": float(np.abs(spectrum / np.maximum(true_spectrum, 1e-12) - 1.0)[counted].max()),
        "length": float(length.sum() / true_length.sum()),
    }


def _curvature_spectrum(tangents: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Power of the curvature (1/mm) of strands in the bands of `evaluation.spectrum`, weighted by their lengths."""
    step = length / tangents.shape[1]
    curvature = np.diff(tangents, axis=1) / step[:, None, None]
    return (band_powers(curvature, step, np.full(len(length), curvature.shape[1])) * length[:, None]).sum(axis=0)
