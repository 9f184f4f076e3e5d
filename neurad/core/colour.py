"""Linear sRGB colours."""

from torch import Tensor

LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Weights of linear sRGB in luminance (Rec. 709), as Mitsuba has them."""


def luminance(rgb: Tensor) -> Tensor:
    """Luminance [...] of linear sRGB [..., 3]; negative values count as black."""
    return (rgb * rgb.new_tensor(LUMINANCE)).sum(-1).clamp_min(0.0)
