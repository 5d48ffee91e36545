"""The benchmark: named sets of scans made, reconstructed and scored, the paper's method beside ours (paper 4)."""

from .runner import Bench, Case
from .sets import SETS, Options, run_benchmark

__all__ = ["SETS", "Bench", "Case", "Options", "run_benchmark"]
