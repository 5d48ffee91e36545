"""Where the fit to the scan runs: the processor, or a CUDA card where torch has one."""

from __future__ import annotations

import importlib.metadata
import importlib.util

from ..errors import CT2HairError


def check_device(device: str) -> None:
    """Raise CT2HairError where `device` (auto, cpu or cuda) is cuda and torch finds no card. Quick for the others."""
    if device != "cuda" or _has_card():
        return
    raise CT2HairError(
        f"run.device is cuda, but {_build()} finds no CUDA card; install a CUDA build of torch and the card's driver, "
        "or set run.device to auto or cpu"
    )


def takes_card(device: str, needed: float = 0.0) -> bool:
    """Whether work that needs so many bytes on a card runs on one: not with device cpu, nor where no card has so much free.

    Raises CT2HairError where cuda is asked for and there is no card.
    """
    check_device(device)
    if device == "cpu" or not _has_card():
        return False
    import torch

    return torch.cuda.mem_get_info()[0] >= needed


def _build() -> str:
    """Which torch there is, in words."""
    try:
        return f"torch {importlib.metadata.version('torch')}"
    except importlib.metadata.PackageNotFoundError:
        return "a Python without torch"


def _has_card() -> bool:
    """Whether torch can run on CUDA; torch, which takes seconds to import, is asked only where it is no CPU build."""
    if importlib.util.find_spec("torch") is None or _build().endswith("+cpu"):
        return False
    import torch

    return torch.cuda.is_available()
