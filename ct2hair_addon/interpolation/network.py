"""The strand prior's network (paper 3.3.1, supplement 4): a variational autoencoder, eight 1D convolutions to a code of 128 and
a modulated SIREN (Mehta et al. 2021) that gives directions and steps, which integrate to the strand.

Imports torch; the rest of the stage loads it late.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import nn

POINTS = 256
"""Points of a strand in the network."""
STEPS = POINTS - 1
CODE = 128
"""Size of a code: the logarithm of the length, the strand's slow course, and what is learned."""
SLOW = 16
"""Cosines of the slow course, for each axis: up to 8 cycles over the strand are carried by the code as they are."""
LEARNED = CODE - 1 - 3 * SLOW
SINES = 128
"""Width of the first sine layer; its frequencies begin at 0 to 63.5 cycles over the strand, as far as 255 steps show."""
HIDDEN = 32
"""Width of the deeper sine layers."""
CHANNELS = (6, 12, 24, 48, 96, 192, 384, 256)
"""Of the eight convolutions: each halves the length and doubles the channels, so that nothing need be lost on the way."""
LOG_LENGTH = (4.5, 1.0)
"""Middle and width of the logarithms of lengths (mm) of hair."""
LEAST_VARIANCE, MOST_VARIANCE = -12.0, 2.0
"""Bounds of the logarithm of a code's variance."""


def times() -> torch.Tensor:
    """(STEPS,) where on the strand, 0 root to 1 tip, the steps have their middles."""
    return (torch.arange(STEPS, dtype=torch.float32) + 0.5) / STEPS


def cosines(count: int) -> torch.Tensor:
    """(count, STEPS) float32 orthonormal cosines over the strand (DCT-II)."""
    rows = torch.cos(math.pi * torch.arange(count, dtype=torch.float64)[:, None] * times().double())
    return (rows / torch.linalg.norm(rows, dim=1, keepdim=True)).float()


class Encoder(nn.Module):
    """Eight strided convolutions over a strand's steps: mean and log variance of the learned part of its code."""

    def __init__(self) -> None:
        super().__init__()
        widths = (3, *CHANNELS)
        self.layers = nn.ModuleList(
            nn.Conv1d(before, after, kernel_size=4, stride=2, padding=1) for before, after in pairwise(widths)
        )
        # A slope of 1 is no bend at all: training sets out from a linear transform and bends it where that helps.
        self.bends = nn.ModuleList(nn.PReLU(width, init=1.0) for width in CHANNELS)
        self.mean = nn.Linear(CHANNELS[-1], LEARNED)
        self.log_variance = nn.Linear(CHANNELS[-1], LEARNED)

    def features(self, steps: torch.Tensor, layers: int = len(CHANNELS)) -> torch.Tensor:
        """(B, channels, length) after the first `layers` of the convolutions, of steps (B, 3, STEPS)."""
        signal = nn.functional.pad(steps, (0, 1), mode="replicate")
        for layer, bend in list(zip(self.layers, self.bends, strict=True))[:layers]:
            signal = bend(layer(signal))
        return signal

    def forward(self, steps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        seen = self.features(steps).flatten(1)
        return self.mean(seen), self.log_variance(seen).clamp(LEAST_VARIANCE, MOST_VARIANCE)


class Decoder(nn.Module):
    """A SIREN over t whose sine layers are gated by a modulator that reads the code; its output reads every layer.

    The first layer's sines are gated once for each axis, so that they alone can draw any course; the deeper layers, sines of
    gated sines, add to it what is quicker than the slow course that the code carries as it is.
    """

    def __init__(self) -> None:
        super().__init__()
        self.frequency = nn.Parameter(math.pi * torch.arange(SINES, dtype=torch.float32))
        self.phase = nn.Parameter(torch.full((SINES,), 0.5 * math.pi))
        self.modulator = nn.ModuleList([nn.Linear(CODE, 192), nn.Linear(192 + CODE, HIDDEN), nn.Linear(HIDDEN + CODE, HIDDEN)])
        self.straight = nn.Linear(CODE, 3 * SINES)
        self.gates = nn.Linear(192, 3 * (SINES - SLOW))
        self.mix = nn.Parameter(torch.randn(HIDDEN, 3, SINES) * 1.5)
        self.shift = nn.Parameter(torch.rand(HIDDEN) * 2.0 * math.pi)
        self.deeper = nn.Linear(HIDDEN, HIDDEN)
        self.out = nn.Linear(2 * HIDDEN, 3)
        nn.init.zeros_(self.gates.weight)
        nn.init.zeros_(self.gates.bias)
        nn.init.normal_(self.out.weight, std=1e-3)
        nn.init.zeros_(self.out.bias)
        nn.init.uniform_(self.deeper.weight, -math.sqrt(6.0 / HIDDEN), math.sqrt(6.0 / HIDDEN))
        self.register_buffer("times", times(), persistent=False)
        self.register_buffer("slow", cosines(SLOW), persistent=False)

    def forward(self, code: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of codes (B, CODE): unit directions (B, 3, STEPS), and steps (B, STEPS) as shares of length / STEPS."""
        sines = torch.sin(self.frequency[:, None] * self.times + self.phase[:, None])
        first = nn.functional.silu(self.modulator[0](code))
        second = torch.relu(self.modulator[1](torch.cat([first, code], dim=1)))
        third = torch.relu(self.modulator[2](torch.cat([second, code], dim=1)))
        quick = nn.functional.pad(self.gates(first).view(-1, 3, SINES - SLOW), (SLOW, 0))
        gates = self.straight(code).view(-1, 3, SINES) + quick
        course = gates @ sines
        mixed = torch.einsum("hck,bck->bhk", self.mix, gates)
        hidden = second[:, :, None] * torch.sin(mixed @ sines + self.shift[:, None])
        deepest = third[:, :, None] * torch.sin(self.deeper.weight @ hidden + self.deeper.bias[:, None])
        out = self.out.weight @ torch.cat([hidden, deepest], dim=1) + self.out.bias[:, None]
        velocity = course + out - (out @ self.slow.T) @ self.slow
        speed = torch.sqrt((velocity**2).sum(dim=1) + 1e-8)
        return velocity / speed[:, None], speed


class StrandPrior(nn.Module):
    """The autoencoder. `scale` (3 * SLOW,) brings the slow course's coefficients to unit variance."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.decoder = Decoder()
        self.register_buffer("scale", torch.ones(3 * SLOW))
        self.register_buffer("slow", cosines(SLOW), persistent=False)

    def encode(self, steps: torch.Tensor, length: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean (B, CODE) and log variance (B, LEARNED) of codes of strands.

        steps: (B, 3, STEPS), in units of length / STEPS: nearly unit vectors. length: (B,) mm.
        """
        carried = (steps @ self.slow.T / math.sqrt(STEPS)).flatten(1) / self.scale
        mean, log_variance = self.encoder(steps)
        log_length = (torch.log(length) - LOG_LENGTH[0]) / LOG_LENGTH[1]
        return torch.cat([log_length[:, None], carried, mean], dim=1), log_variance

    def decode(self, code: torch.Tensor) -> torch.Tensor:
        """(B, POINTS, 3) mm, the root at 0: the steps that the decoder gives, added up."""
        directions, sizes = self.decoder(code)
        length = torch.exp(code[:, 0] * LOG_LENGTH[1] + LOG_LENGTH[0])
        points = torch.cumsum(directions * sizes[:, None], dim=2) * (length / STEPS)[:, None, None]
        return nn.functional.pad(points, (1, 0)).transpose(1, 2)
