"""Learning rates over a run."""

from __future__ import annotations

import math

from neurad.module.config import Optimization


def rate_factor(settings: Optimization, iteration: int, progress: float) -> float:
    """What the learning rates are multiplied by.

    Args:
        settings: schedule and warm-up.
        iteration: iterations done.
        progress: share of the run that is over, in [0, 1].
    """
    rise = min(1.0, (iteration + 1) / max(1, settings.warmup))
    if settings.schedule == "constant":
        return rise
    fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, max(0.0, progress))))
    return rise * (settings.final + (1.0 - settings.final) * fall)
