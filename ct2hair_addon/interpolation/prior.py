"""The learned strand prior as a coder (paper 3.3.1): strands to codes of 128 and back, by the network of `network.py`.

torch is loaded when the first coder is made, so that whoever blends otherwise never waits for it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np

from ..errors import CT2HairError
from ..strands import Strands

WEIGHTS = Path(__file__).with_name("weights") / "strand_prior.safetensors"
NETWORK_POINTS = 256
BATCH = 256
"""Strands a call of the network: fixed, so that the bits of a strand don't hang on how many come with it."""


class NetworkCoder:
    """Codes (N, 128) float32 of the variational autoencoder: the mean of the encoder's distribution.

    Shapes go in at any number of points and come out at `points`, of equal arc length. The result doesn't depend on the
    number of threads: each batch is computed by one.
    """

    in_phase = True
    lossy = True

    def __init__(self, prior, points: int = NETWORK_POINTS) -> None:
        self._prior = prior
        self.points = points

    @classmethod
    def load(cls, path: Path | None = None, points: int = NETWORK_POINTS) -> NetworkCoder:
        """The coder with the weights of a file; None takes the shipped ones. Raises CT2HairError where there are none that
        fit, or where torch is not installed."""
        if importlib.util.find_spec("torch") is None:
            raise CT2HairError("the strand prior needs torch, which this Python lacks; set interpolation.coder to linear")
        from .weights_file import load_weights

        return cls(load_weights(path or WEIGHTS), points)

    def encode(self, shapes: np.ndarray) -> np.ndarray:
        """(N, 128) float32 codes of shapes (N, P, 3), mm, root at 0 in the root's frame."""
        import torch

        from .network import CODE
        from .train import steps_of

        if not len(shapes):
            return np.zeros((0, CODE), np.float32)
        if shapes.shape[1] != NETWORK_POINTS:
            shapes = Strands.from_array(shapes).resampled(NETWORK_POINTS)
        steps, length = steps_of(shapes)

        def work(steps: np.ndarray, length: np.ndarray) -> np.ndarray:
            return self._prior.encode(torch.from_numpy(steps), torch.from_numpy(length))[0].numpy()

        return _batched(work, steps, length)

    def decode(self, codes: np.ndarray) -> np.ndarray:
        """(N, points, 3) float32 mm of codes (N, 128)."""
        import torch

        codes = np.ascontiguousarray(codes, np.float32)
        if not len(codes):
            return np.zeros((0, self.points, 3), np.float32)
        made = _batched(lambda codes: self._prior.decode(torch.from_numpy(codes)).numpy(), codes)
        return made if self.points == NETWORK_POINTS else Strands.from_array(made).resampled(self.points)


def _batched(work: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """`work` on BATCH rows of the arrays at a time, one thread of torch a batch, as many batches at once as numba may take
    threads. The last batch is filled up with its last row."""
    import torch

    def alone() -> None:
        torch.set_num_threads(1)

    def one(first: int) -> np.ndarray:
        rows = [array[first : first + BATCH] for array in arrays]
        count = len(rows[0])
        filled = [np.pad(part, [(0, BATCH - count)] + [(0, 0)] * (part.ndim - 1), mode="edge") for part in rows]
        with torch.inference_mode():
            return work(*filled)[:count]

    before = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(numba.get_num_threads(), initializer=alone) as pool:
            return np.concatenate(list(pool.map(one, range(0, len(arrays[0]), BATCH))))
    finally:
        torch.set_num_threads(before)
