"""Texels that belong to no surface, filled from those that do, so that smaller versions of a texture do not bleed."""

from __future__ import annotations

import numpy as np

from neurad.core.records import FloatArray
from neurad.metrics.scores import BoolArray


def push_pull(pixels: FloatArray, known: BoolArray) -> FloatArray:
    """The texture with every unknown texel filled by the mean of the known ones around it.

    Means of 2 x 2 texels are taken level by level up to one texel; on the way back every unknown texel gets the value
    of the smallest level that knows it.

    Args:
        pixels: [h, w, c], sides powers of two; not read where unknown.
        known: [h, w].

    Returns:
        A new array; zeros where nothing at all is known.
    """
    if known.all() or not known.any():
        return np.where(known[..., None], pixels, 0.0).astype(np.float32)
    filled = np.where(known[..., None], pixels, np.float32(0.0))
    if max(known.shape) == 1:
        return filled
    upper = push_pull(*_halved(filled, known))
    back = upper.repeat(known.shape[0] // upper.shape[0], 0).repeat(known.shape[1] // upper.shape[1], 1)
    return np.where(known[..., None], filled, back)


def _halved(filled: FloatArray, known: BoolArray) -> tuple[FloatArray, BoolArray]:
    """The next smaller level: means of the known texels of each 2 x 2 (or 2 x 1) ones, and whether there are any."""
    height, width = known.shape
    rows, columns = min(height, 2), min(width, 2)
    shape = (height // rows, rows, width // columns, columns)
    count = known.reshape(shape).sum((1, 3), dtype=np.float32)
    total = filled.reshape(*shape, -1).sum((1, 3))
    mean: FloatArray = total / np.maximum(count, 1.0)[..., None]
    return mean, count > 0
