"""Stage 5, interpolation: as many strands as the scan holds, blended from the guides over the scalp."""

from .coder import Coder, EuclideanCoder, LinearCoder, blend, chosen_coder
from .count import estimate_strand_count
from .fill import Blending, Dense, blend_weights, fill_scalp
from .prior import NetworkCoder

__all__ = [
    "Blending",
    "Coder",
    "Dense",
    "EuclideanCoder",
    "LinearCoder",
    "NetworkCoder",
    "blend",
    "blend_weights",
    "chosen_coder",
    "estimate_strand_count",
    "fill_scalp",
]
