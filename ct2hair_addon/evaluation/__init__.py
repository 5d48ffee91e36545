"""Evaluation: hairstyles with known strands, scans made from them, scores of a result, and the report."""

from .density import BLUR, render_density, strand_peak
from .scores import centre_line_error, coverage, evaluate, format_scores, orientation_error, scan_scores
from .synthesis import Synthesis, synthesize

__all__ = [
    "BLUR",
    "Synthesis",
    "centre_line_error",
    "coverage",
    "evaluate",
    "format_scores",
    "orientation_error",
    "render_density",
    "scan_scores",
    "strand_peak",
    "synthesize",
]
