"""Evaluation: hairstyles with known strands, scans made from them, scores of a result, and the report."""

from .density import BLUR, render_density, strand_peak
from .hairstyles import STYLES, hairstyle
from .pictures import strip_picture
from .report import curvature, write_report
from .scores import (
    centre_line_error,
    coverage,
    direction_share,
    evaluate,
    format_scores,
    hair_kept,
    orientation_error,
    registration_error,
    rooted_length,
    scan_scores,
)
from .spectrum import curvature_spectrum
from .synthesis import Synthesis, synthesize

__all__ = [
    "BLUR",
    "STYLES",
    "Synthesis",
    "centre_line_error",
    "coverage",
    "curvature",
    "curvature_spectrum",
    "direction_share",
    "evaluate",
    "format_scores",
    "hair_kept",
    "hairstyle",
    "orientation_error",
    "registration_error",
    "render_density",
    "rooted_length",
    "scan_scores",
    "strand_peak",
    "strip_picture",
    "synthesize",
    "write_report",
]
