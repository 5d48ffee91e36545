"""Stage 3, the orientation field (paper 3.2.1)."""

from .field import OrientationField, noise_level, orientation_field
from .traced import field_along

__all__ = ["OrientationField", "field_along", "noise_level", "orientation_field"]
