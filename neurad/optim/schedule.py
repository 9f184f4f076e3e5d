"""What learning rates are multiplied by in the course of a run."""

import math


def warmup(iteration: int, steps: int) -> float:
    """A linear rise over the first ``steps`` iterations, in (0, 1]; ``iteration`` counts those that are done."""
    return min(1.0, (iteration + 1) / max(1, steps))


def cosine(progress: float, final: float) -> float:
    """From 1 at the beginning of a run to ``final`` at its end along half a cosine.

    Args:
        progress: fraction of the run that is over; clamped to [0, 1].
        final: factor at the end.
    """
    fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, max(0.0, progress))))
    return final + (1.0 - final) * fall
