"""What is wrong with the pixels of a photograph, whatever it shows: clipped ones, few values, all of them the same."""

from dataclasses import dataclass

import numpy as np

from neurad.core.records import BoolArray, FloatArray

LEVELS = 256
"""Different values of a channel of 8 bits."""
_MIN_PIXELS = 4096  # pixels in which a photograph of more bits has more values than that


@dataclass(frozen=True)
class PhotographFacts:
    """Brightness and codes of one photograph."""

    mean: float
    """Mean of the pixels that show a surface and no emitter, all channels; 0 where there are none."""
    highest: float
    """Largest value of all pixels."""
    clipped: float
    """Fraction of the pixels that show a surface and no emitter that have the largest value of a channel, for the
    channel with most of them; 0 where it is a single one."""
    black: float
    """Fraction of these that are 0 in all channels."""
    constant: bool
    """All pixels are equal."""
    levels: int | None
    """Different values of the channel with most of them; None where there are few pixels."""


def photograph_facts(pixels: FloatArray, counted: BoolArray) -> PhotographFacts:
    """Look at a photograph [h, w, 3 or 4], finite, where ``counted`` [h, w] shows a surface and no emitter."""
    colour = pixels[..., :3]
    inside = colour[counted]  # [n, 3]
    constant = bool((colour == colour[0, 0]).all())
    many = len(colour.reshape(-1, 3)) >= _MIN_PIXELS
    levels = max(len(np.unique(colour[..., c])) for c in range(3)) if many else None
    if len(inside) == 0:
        return PhotographFacts(0.0, float(colour.max()), 0.0, 0.0, constant, levels)
    top = inside.max(0)
    at_top = int(((inside == top) & (top > 0)).sum(0).max())
    clipped = at_top / len(inside) if at_top > 1 else 0.0  # some pixel is always the brightest
    black = float((inside == 0).all(-1).mean())
    return PhotographFacts(float(inside.mean(dtype=np.float64)), float(colour.max()), clipped, black, constant, levels)
