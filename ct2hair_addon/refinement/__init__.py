"""Stage 6, refinement: strands fitted to the volume."""

from .agreement import scan_agreement
from .device import check_device
from .refine import Refined, refine
from .surplus import unexplained, without_surplus

__all__ = ["Refined", "check_device", "refine", "scan_agreement", "unexplained", "without_surplus"]
