"""Stage 3, the orientation field (paper 3.2.1)."""

from .field import OrientationField, noise_level, orientation_field

__all__ = ["OrientationField", "noise_level", "orientation_field"]
