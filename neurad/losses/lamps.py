"""Lamps against their own photographs."""

import torch

from neurad.emitters.fitted_lamps import FittedLamps
from neurad.losses.relative import Loss

HALF_WEIGHT_PIXELS = 8
"""Pixels of a lamp that have half of the weight that any number has."""


def shown_lamps(lamps: FittedLamps) -> Loss:
    """Relative L2 of what each lamp sends and reflects from what photographs show of it, the mean over the lamps that
    they show; 0 where they show none.

    Where every surface is free to be as dark as it likes, direct light says nothing of a lamp's scale; a picture of the
    lamp does. What it reflects is held fixed, and few pixels count less.
    """
    pixels = lamps.unclipped
    weight = (pixels / (pixels + HALF_WEIGHT_PIXELS)).unsqueeze(-1)  # [m, 1]
    shown = lamps.photographed > 0
    ratio = (lamps.radiance + lamps.reflected) / torch.where(shown, lamps.photographed, 1.0)
    squared = torch.where(shown, weight * (ratio - 1.0).square(), 0.0)
    loss = squared.sum() / (3 * (pixels > 0).sum().clamp_min(1))
    return Loss(loss, loss.detach())
