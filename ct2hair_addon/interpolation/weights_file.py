"""The strand prior's weights as a safetensors file: float16 numbers, and what they are and where they come from as metadata.

Imports torch; the rest of the stage loads it late.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save_file

from ..errors import CT2HairError
from .network import StrandPrior

FORMAT = "ct2hair strand prior"
VERSION = 1
"""Of the network's layout: weights of another version don't fit."""
SINGLE = ("decoder.frequency", "decoder.phase")
"""Kept in float32: a rounded frequency is a phase lost by the tip."""


class WeightsError(CT2HairError):
    """The weights of the strand prior are missing, damaged, or not for this network."""


def save_weights(prior: StrandPrior, path: Path, facts: dict[str, Any]) -> None:
    """Write the weights and what made them (`facts`: plain values), beside the target and renamed."""
    tensors = {
        name: (value.detach().float() if name in SINGLE else value.detach().half()).contiguous()
        for name, value in prior.state_dict().items()
    }
    beside = path.with_name("." + path.name + ".part")
    metadata = {"format": FORMAT, "version": str(VERSION), "facts": json.dumps(facts, sort_keys=True)}
    try:
        save_file(tensors, beside, metadata)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def load_weights(path: Path) -> StrandPrior:
    """The network with the weights of a file, for inference. Raises WeightsError for a file that won't do."""
    read_facts(path)
    prior = StrandPrior()
    try:
        prior.load_state_dict({name: value.float() for name, value in load_file(path).items()})
    except (OSError, RuntimeError, safetensors.SafetensorError) as error:
        raise WeightsError(f"{path}: the strand prior's weights don't fit its network ({error}); {REMEDY}") from error
    if not all(torch.isfinite(value).all() for value in prior.state_dict().values()):
        raise WeightsError(f"{path}: the strand prior's weights are not all numbers; {REMEDY}")
    return prior.eval().requires_grad_(False)


def read_facts(path: Path) -> dict[str, Any]:
    """What made the weights of a file. Raises WeightsError where it is missing, damaged, or of another version."""
    if not path.is_file():
        raise WeightsError(f"{path}: the strand prior's weights are missing; {REMEDY}")
    try:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
        facts = json.loads(metadata.get("facts", "{}"))
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        raise WeightsError(f"{path}: the strand prior's weights are damaged ({error}); {REMEDY}") from error
    if metadata.get("format") != FORMAT or metadata.get("version") != str(VERSION):
        raise WeightsError(
            f"{path}: holds {metadata.get('format', 'no strand prior')} version {metadata.get('version', '?')}, "
            f"expected {FORMAT} version {VERSION}; {REMEDY}"
        )
    return facts


REMEDY = "install the extension anew, or set interpolation.coder to linear"
