"""Stage 5, interpolation: as many strands as the scan holds, blended from the guides over the scalp."""

from .coder import Coder, EuclideanCoder, blend
from .count import estimate_strand_count
from .fill import Dense, blend_weights, fill_scalp

__all__ = ["Coder", "Dense", "EuclideanCoder", "blend", "blend_weights", "estimate_strand_count", "fill_scalp"]
