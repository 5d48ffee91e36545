"""Training the strand prior (paper 3.3.1, supplement 4) on strands that the caller brings; losses as in Neural Strands.

Positions, directions, curvature and a small weight on the divergence from a normal distribution. The network sets out from the
best linear code of the data (a principal component analysis in the cosines' domain), which it holds exactly, and is trained
on from there: minutes on two cores instead of days.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..errors import CT2HairError
from .network import LEARNED, SINES, SLOW, STEPS, StrandPrior, cosines

POSITION_METRIC = 300.0
"""How much more a slow error of direction counts than a quick one in the linear start: an error of position, integrated."""
WEIGHTS = {"position": 1e4, "direction": 1.0, "step": 0.3, "curvature": 0.5, "divergence": 1e-6}
"""Weights of the losses: squared error of positions over the length, of unit directions, of relative steps, of the directions'
differences, and the Kullback-Leibler divergence in nats."""
FIRST_LOG_VARIANCE = -9.0
AVERAGE = 0.998
"""Weights are averaged over the last steps with this factor; the average is what is kept."""
WARM_UP = 100
CHECKPOINT_SECONDS = 60.0
REPORT_STEPS = 50


@dataclass(frozen=True)
class TrainingPlan:
    """How long and how. rate: Adam's, at its height, for the deeper layers; what the linear start has set well takes
    `start_share` of it. Both fall as a cosine to 1 % at the last step."""

    steps: int = 600
    batch: int = 256
    rate: float = 5e-5
    start_share: float = 0.06
    seed: int = 0


def steps_of(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the network reads: steps (N, 3, STEPS) float32 in units of length / STEPS, and lengths (N,) float32 mm.

    shapes: (N, POINTS, 3) mm. Raises CT2HairError for strands of no length.
    """
    moves = np.diff(shapes.astype(np.float32), axis=1)
    length = np.linalg.norm(moves, axis=2).sum(axis=1)
    if not (np.isfinite(length) & (length > 0.0)).all():
        raise CT2HairError("a strand of no length can't be brought into the strand prior; drop it first")
    steps = moves.transpose(0, 2, 1) * (STEPS / length)[:, None, None]
    return np.ascontiguousarray(steps, np.float32), length.astype(np.float32)


def train(
    steps: np.ndarray,
    length: np.ndarray,
    plan: TrainingPlan,
    state: Path,
    told: Callable[[int, float], None] = lambda step, loss: None,
) -> StrandPrior:
    """The trained prior. steps, length: as `steps_of` gives them. told(step, loss) now and then.

    `state` is the file that the training writes each minute and goes on from: the same data, plan and threads give the same
    weights whether it was cut off or not. Raises CT2HairError where the file is of another training.
    """
    torch.manual_seed(plan.seed)
    prior, average = StrandPrior(), StrandPrior()
    steps, length = torch.from_numpy(steps), torch.from_numpy(length)
    optimiser = torch.optim.Adam(_groups(prior, plan), betas=(0.9, 0.99))
    saved = _resumed(state, plan)
    if saved is None:
        start_linear(prior, steps, plan.seed)
        average.load_state_dict(prior.state_dict())
        first = 0
    else:
        prior.load_state_dict(saved["prior"])
        average.load_state_dict(saved["average"])
        optimiser.load_state_dict(saved["optimiser"])
        first = saved["step"]
    last_saved = time.monotonic()
    for step in range(first, plan.steps):
        generator = torch.Generator().manual_seed((plan.seed << 32) + step)
        rows = torch.randint(len(steps), (plan.batch,), generator=generator)
        for group in optimiser.param_groups:
            group["lr"] = group["height"] * _schedule(step, plan.steps)
        loss = losses(prior, turned(steps[rows], generator), length[rows], generator)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(prior.parameters(), 1.0)
        optimiser.step()
        with torch.no_grad():
            factor = min(AVERAGE, (step + 1.0) / (step + 10.0))
            for kept, now in zip(average.parameters(), prior.parameters(), strict=True):
                kept.lerp_(now, 1.0 - factor)
        if step % REPORT_STEPS == 0:
            told(step, loss.item())
        if time.monotonic() - last_saved > CHECKPOINT_SECONDS or step + 1 == plan.steps:
            _save(state, plan, step + 1, prior, average, optimiser)
            last_saved = time.monotonic()
    average.load_state_dict({**average.state_dict(), "scale": prior.scale})
    return average.eval()


def losses(prior: StrandPrior, steps: torch.Tensor, length: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """The weighted sum of the losses over a batch, with codes drawn from their distributions."""
    mean, log_variance = prior.encode(steps, length)
    drawn = torch.randn(log_variance.shape, generator=generator) * torch.exp(0.5 * log_variance)
    code = mean + torch.nn.functional.pad(drawn, (mean.shape[1] - LEARNED, 0))
    directions, sizes = prior.decoder(code)
    made = directions * sizes[:, None]
    norm = torch.linalg.norm(steps, dim=1, keepdim=True).clamp_min(1e-6)
    wanted = steps / norm
    position = ((torch.cumsum(made - steps, dim=2) / STEPS) ** 2).sum(dim=1).mean()
    direction = ((directions - wanted) ** 2).sum(dim=1).mean()
    size = ((sizes - norm[:, 0]) ** 2).mean()
    curvature = ((torch.diff(directions, dim=2) - torch.diff(wanted, dim=2)) ** 2).sum(dim=1).mean()
    learned = mean[:, -LEARNED:]
    divergence = 0.5 * (learned**2 + log_variance.exp() - log_variance - 1.0).sum(dim=1).mean()
    terms = {"position": position, "direction": direction, "step": size, "curvature": curvature, "divergence": divergence}
    return sum(WEIGHTS[name] * term for name, term in terms.items())


def turned(steps: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """The strands (B, 3, STEPS) turned about the root's normal (z), each by an angle of its own, and half of them mirrored."""
    angle = torch.rand(len(steps), generator=generator) * 2.0 * math.pi
    mirror = torch.where(torch.rand(len(steps), generator=generator) < 0.5, -1.0, 1.0)
    cos, sin, zero, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    rows = torch.stack([cos * mirror, -sin, zero, sin * mirror, cos, zero, zero, zero, one], dim=1)
    return rows.view(-1, 3, 3) @ steps


def start_linear(prior: StrandPrior, steps: torch.Tensor, seed: int, most: int = 20_000) -> None:
    """Set the network to the best linear code of the strands: cosines above the slow course, reduced to their components."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randperm(len(steps), generator=generator)[:most]
    seen = turned(steps[rows], generator)
    basis = cosines(SINES)
    spectrum = seen @ basis.T / math.sqrt(STEPS)  # (N, 3, SINES)
    deviation = spectrum[:, :, :SLOW].pow(2).mean(dim=0).sqrt().clamp_min(1e-3)
    deviation[:2] = deviation[:2].pow(2).mean(dim=0).sqrt()  # the strands are turned: x and y are alike
    metric = torch.sqrt(1.0 + (POSITION_METRIC / (math.pi * torch.arange(SLOW, SINES))) ** 2)
    quick = (spectrum[:, :, SLOW:] * metric).flatten(1)
    _, components = torch.linalg.eigh((quick.T @ quick).double() / len(quick))
    components = components[:, -LEARNED:].float()
    scores = quick @ components
    width = scores.pow(2).mean(dim=0).sqrt().clamp_min(1e-6)
    scores = scores / width
    with torch.no_grad():
        prior.scale.copy_(deviation.flatten())
        encoder, decoder = prior.encoder, prior.decoder
        for layer in encoder.layers[:-1]:
            # the two middle taps turn the signal into as many numbers as it has: nothing is lost
            count = layer.out_channels
            square = torch.linalg.qr(torch.randn(count, count, generator=generator))[0]
            layer.weight.mul_(0.02)
            layer.weight[:, :, 1:3] = square.view(count, count // 2, 2)
            layer.bias.zero_()
        before = encoder.features(seen, len(encoder.layers) - 1).flatten(1).double()
        gram = before.T @ before
        gram += 1e-7 * gram.diagonal().mean() * torch.eye(len(gram), dtype=torch.float64)
        solved = torch.linalg.solve(gram, before.T @ scores.double()).float().T  # (LEARNED, channels * 2)
        last = encoder.layers[-1]
        last.weight[:LEARNED] = 0.0
        last.weight[:LEARNED, :, 1:3] = solved.view(LEARNED, last.in_channels, 2)
        last.bias.zero_()
        for head in (encoder.mean, encoder.log_variance):
            head.weight.mul_(0.02)
            head.bias.zero_()
        encoder.mean.weight.zero_()
        encoder.mean.weight[:, :LEARNED] = torch.eye(LEARNED)
        encoder.log_variance.bias.fill_(FIRST_LOG_VARIANCE)
        # gates of the first sine layer, which begins as the cosines: (3, SINES) of each number of the code
        norm = torch.full((SINES,), math.sqrt(2.0))  # of a cosine's height to its coefficient
        norm[0] = 1.0
        straight = torch.zeros(3, SINES, decoder.straight.in_features)
        for axis in range(3):
            for k in range(SLOW):
                straight[axis, k, 1 + axis * SLOW + k] = deviation[axis, k] * norm[k]
        back = (components * width).view(3, SINES - SLOW, LEARNED) / metric[:, None]
        straight[:, SLOW:, -LEARNED:] = back * norm[SLOW:, None]
        decoder.straight.weight.copy_(straight.flatten(0, 1))
        decoder.straight.bias.zero_()


def _groups(prior: StrandPrior, plan: TrainingPlan) -> list[dict]:
    """The optimiser's groups: what the linear start has set, and the rest."""
    decoder = prior.decoder
    started = [*prior.encoder.parameters(), *decoder.straight.parameters(), decoder.frequency, decoder.phase]
    known = {id(parameter) for parameter in started}
    deeper = [parameter for parameter in prior.parameters() if id(parameter) not in known]
    low = plan.rate * plan.start_share
    return [{"params": started, "lr": low, "height": low}, {"params": deeper, "lr": plan.rate, "height": plan.rate}]


def _schedule(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / WARM_UP) * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * step / steps)))


def _save(state: Path, plan: TrainingPlan, step: int, prior, average, optimiser) -> None:
    beside = state.with_name(state.name + ".part")
    held = {"prior": prior.state_dict(), "average": average.state_dict(), "optimiser": optimiser.state_dict()}
    torch.save({"plan": vars(plan), "step": step, **held}, beside)
    beside.replace(state)


def _resumed(state: Path, plan: TrainingPlan) -> dict | None:
    if not state.exists():
        return None
    saved = torch.load(state, weights_only=True)
    if saved["plan"] != vars(plan):
        raise CT2HairError(f"{state}: belongs to a training with other settings, {saved['plan']}; choose another folder")
    return saved
