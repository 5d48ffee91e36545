"""Stage 4, guide strands: tracing, fine and poor segments, growing (paper 3.2.2)."""

from .stage import Guides, find_segments, root_segments, trace_guides

__all__ = ["Guides", "find_segments", "root_segments", "trace_guides"]
