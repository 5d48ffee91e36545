"""Stage 6, refinement: strands fitted to the volume."""

from .agreement import scan_agreement
from .refine import Refined, refine

__all__ = ["Refined", "refine", "scan_agreement"]
