"""Spread that a few outliers do not change."""

import numpy as np
import numpy.typing as npt

NORMAL = 1.4826
"""Standard deviation of normal errors over the median of their absolute values."""


def robust_deviation(values: npt.NDArray[np.floating], middle: float) -> float:
    """Standard deviation of values around ``middle``, by the median of their distances to it."""
    return NORMAL * float(np.median(np.abs(values - middle)))
