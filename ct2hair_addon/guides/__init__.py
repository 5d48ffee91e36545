"""Stage 4, guide strands: tracing, fine and poor segments, growing (paper 3.2.2)."""

from .knots import strands_by_knots
from .stage import Guides, Habit, amend_guides, find_segments, root_segments, trace_guides

__all__ = ["Guides", "Habit", "amend_guides", "find_segments", "root_segments", "strands_by_knots", "trace_guides"]
