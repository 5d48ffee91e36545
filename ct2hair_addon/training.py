"""Training the strand prior from the project's own hairstyles and from single strands (paper 3.3.1, supplement 4), and what it
reaches on strands that it has not seen.

It stands above the stages: the strands are the evaluation's, the network is the interpolation's.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import CT2HairError
from .evaluation import STYLES, hairstyle
from .head import Head, template_head
from .interpolation.procedural import KINDS, procedural_strands
from .strands import Strands, normalized

POINTS = 256
FEWEST = 2500
"""Strands that a hairstyle is grown with at least: its wisps need that many to look like wisps. A share is picked from them."""
HELD_OUT_SEED = 7_000_001
"""Added to the seed for strands that are never trained on."""
TOLERANCE = 0.5 / 200.0
"""Error that a strand is to be decoded within: root mean square distance over length."""


MANY_TURNS = 5.0
CURLED = f"{MANY_TURNS:.0f} turns or more"


@dataclass(frozen=True)
class Recipe:
    """Of which strands: `styles` of the hairstyles together, `single` procedural ones, all from `seed`."""

    styles: int = 30_000
    single: int = 30_000
    seed: int = 0


@dataclass(frozen=True)
class Examples:
    """Strands to train on or to measure with. shapes: (N, POINTS, 3) float32 mm in the root's frame, root at 0.
    kind: (N,) int64 into `NAMES`."""

    shapes: np.ndarray
    kind: np.ndarray


NAMES = (*KINDS, *STYLES)
"""Kinds of examples: the procedural ones, then the hairstyles."""


def examples(recipe: Recipe) -> Examples:
    """The strands of a recipe; the same recipe gives the same strands."""
    single = procedural_strands(recipe.single, recipe.seed, POINTS)
    shapes, kinds = [single.shapes], [single.kind]
    mesh = template_head()
    head = Head(mesh)
    each = recipe.styles // max(len(STYLES), 1)
    for n, style in enumerate(STYLES if each else ()):
        strands = hairstyle(style, mesh, max(each, FEWEST), recipe.seed)
        picked = np.sort(np.random.default_rng([recipe.seed, n]).permutation(len(strands))[:each])
        shapes.append(rooted_shapes(strands.select(picked), head, POINTS))
        kinds.append(np.full(each, len(KINDS) + n, np.int64))
    return Examples(np.concatenate(shapes), np.concatenate(kinds))


def rooted_shapes(strands: Strands, head: Head, points: int) -> np.ndarray:
    """(N, points, 3) float32 mm: strands on a head, seen from the tangent frame of the scalp at their roots."""
    rooted = head.closest_scalp(strands.roots)
    frames = head.frames(rooted.face, rooted.bary)
    return np.einsum("nij,npj->npi", frames, strands.resampled(points) - strands.roots[:, None]).astype(np.float32)


def train_prior(out: Path, folder: Path, recipe: Recipe, plan, threads: int = 0, told: Callable[[str], None] = print) -> dict:
    """Train the prior and write its weights to `out`; the figures on held-out strands, also kept in the file's metadata.

    plan: `interpolation.train.TrainingPlan`. `folder` keeps the strands and the state of the training: the same call goes on
    where it was cut off. threads: of torch; 0 takes all.
    """
    import torch

    from .interpolation.train import steps_of, train
    from .interpolation.weights_file import save_weights

    if threads:
        torch.set_num_threads(threads)
    folder.mkdir(parents=True, exist_ok=True)
    made = _kept(folder / "examples.npz", recipe, told)
    begun = time.monotonic()

    def report(step: int, loss: float) -> None:
        told(f"step {step} of {plan.steps}, loss {loss:.5f}, {time.monotonic() - begun:.0f} s")

    steps, length = steps_of(made.shapes)
    prior = train(steps, length, plan, folder / "training.pt", report)
    facts = {"recipe": vars(recipe), "plan": vars(plan), "torch": torch.__version__.split("+")[0]}
    save_weights(prior, out, facts)
    figures = held_out_figures(out, recipe.seed)
    save_weights(prior, out, facts | {"held_out": figures})
    return figures


def held_out_figures(weights: Path | None, seed: int, each: int = 300) -> dict:
    """What weights (None: the shipped ones) reach on `each` fresh strands of every kind: see `decoding_errors`."""
    from .interpolation.prior import NetworkCoder

    held_out = examples(Recipe(each * len(STYLES), each * len(KINDS), seed + HELD_OUT_SEED))
    coder = NetworkCoder.load(weights, points=POINTS)
    return decoding_errors(held_out, coder.decode(coder.encode(held_out.shapes)))


def decoding_errors(truth: Examples, made: np.ndarray) -> dict:
    """By kind, for "all" and for the CURLED: `within` (share within TOLERANCE), `mm_per_200` and `degrees`.

    The latter two are given as median and 99th percentile.
    The error in mm is the root mean square distance of points at the same place along the strand, scaled to 200 mm of hair; in
    degrees, the mean angle between steps.
    """
    distance, angle = strand_errors(truth.shapes, made)
    figures = {}
    sets = {"all": np.ones(len(distance), bool), CURLED: turns(truth.shapes) >= MANY_TURNS}
    for name, rows in (sets | {name: truth.kind == n for n, name in enumerate(NAMES)}).items():
        if rows.any():
            figures[name] = {
                "within": round(float((distance[rows] <= TOLERANCE).mean()), 4),
                "mm_per_200": [round(float(np.percentile(distance[rows], q)) * 200.0, 3) for q in (50, 99)],
                "degrees": [round(float(np.percentile(angle[rows], q)), 2) for q in (50, 99)],
            }
    return figures


def turns(shapes: np.ndarray) -> np.ndarray:
    """(N,): how often each strand (N, P, 3) turns round: the sum of its bends over a full turn."""
    moves = normalized(np.diff(shapes, axis=1))
    return np.arccos(np.clip((moves[:, 1:] * moves[:, :-1]).sum(axis=2), -1.0, 1.0)).sum(axis=1) / (2.0 * np.pi)


def as_table(figures: dict) -> str:
    """`decoding_errors` as a Markdown table."""
    lines = ["| strands | within % | mm per 200 mm: median, 99th | degrees: median, 99th |", "| --- | --- | --- | --- |"]
    for name, of in figures.items():
        mm, degrees = of["mm_per_200"], of["degrees"]
        lines.append(f"| {name} | {100 * of['within']:.1f} | {mm[0]:.3f}, {mm[1]:.3f} | {degrees[0]:.2f}, {degrees[1]:.2f} |")
    return "\n".join(lines)


def draw_decodings(weights: Path | None, picture: Path, seed: int, columns: int = 4) -> None:
    """A PNG of held-out strands (bright) with their decodings over them (orange), a row a kind, each to its own scale."""
    from PIL import Image, ImageDraw

    from .interpolation.prior import NetworkCoder

    cell, scale = 150, 2
    held_out = examples(Recipe(columns * len(STYLES), columns * len(KINDS), seed + HELD_OUT_SEED))
    coder = NetworkCoder.load(weights, points=POINTS)
    made = coder.decode(coder.encode(held_out.shapes))
    half = (len(NAMES) + 1) // 2
    image = Image.new("RGB", (2 * columns * cell * scale, half * cell * scale), (22, 23, 26))
    draw = ImageDraw.Draw(image)
    view = np.array([[0.9, 0.35, 0.0], [-0.15, 0.4, 0.9]])
    for k, name in enumerate(NAMES):
        for column, n in enumerate(np.flatnonzero(held_out.kind == k)[:columns]):
            left = (columns * (k // half) + column) * cell * scale
            top = (k % half) * cell * scale
            both = np.stack([held_out.shapes[n], made[n]]) @ view.T
            low, high = both[0].min(axis=0), both[0].max(axis=0)
            size = 0.84 * cell * scale / max(float((high - low).max()), 1e-6)
            middle = 0.5 * (low + high)
            for points, colour, width in zip(both, ((225, 222, 215), (255, 122, 41)), (5, 2), strict=True):
                at = (points - middle) * [size, -size] + [left + 0.5 * cell * scale, top + 0.5 * cell * scale]
                draw.line([tuple(p) for p in at.tolist()], fill=colour, width=width)
            if column == 0:
                draw.text((left + 8, top + 6), name, fill=(150, 150, 150), font_size=24)
    image.resize((image.width // scale, image.height // scale), Image.Resampling.LANCZOS).save(picture)


def strand_errors(truth: np.ndarray, made: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of strands (N, P, 3) against the truth: root mean square distance over length (N,), mean angle of steps (N,) degrees."""
    if truth.shape != made.shape:
        raise CT2HairError(f"strands of {made.shape} can't be held against {truth.shape}")
    a, b = np.diff(truth.astype(np.float64), axis=1), np.diff(made.astype(np.float64), axis=1)
    length = np.linalg.norm(a, axis=2).sum(axis=1)
    distance = np.sqrt(((truth - made).astype(np.float64) ** 2).sum(axis=2).mean(axis=1)) / length
    cosine = (a * b).sum(axis=2) / np.maximum(np.linalg.norm(a, axis=2) * np.linalg.norm(b, axis=2), 1e-12)
    return distance, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean(axis=1)


def _kept(file: Path, recipe: Recipe, told: Callable[[str], None]) -> Examples:
    """The recipe's strands, from the file where it holds them, else made and written there."""
    wanted = json.dumps(vars(recipe), sort_keys=True)
    if file.exists():
        with np.load(file) as kept:
            if str(kept["recipe"]) == wanted:
                return Examples(kept["shapes"], kept["kind"])
    told(f"making {recipe.styles} strands of hairstyles and {recipe.single} single ones")
    made = examples(recipe)
    beside = file.with_name("." + file.stem + ".part.npz")
    np.savez(beside, shapes=made.shapes, kind=made.kind, recipe=wanted)
    beside.replace(file)
    return made
