"""Views as several renderers show them, in passes that say how much of a picture is noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from neurad.core.records import FloatArray
from neurad.metrics.scores import Float64Array

ERROR = 0.002
"""Standard error of the mean of a view that is rendered for, as a fraction of it."""
SQUARED_ERROR = 0.005
"""The same of its mean squared difference to the photograph: 0.02 dB."""
PASSES = 8
"""Most passes to get there."""

Draw = Callable[[int, int], FloatArray]
"""A picture [h, w, 3] of the view of this number by this seed."""


@dataclass
class Pictures:
    """The views as one renderer shows them."""

    mean: list[FloatArray] = field(default_factory=list)
    """Linear [h, w, 3]."""
    error: list[float] = field(default_factory=list)
    """Standard error of the mean of each."""
    squared: list[float | None] = field(default_factory=list)
    """Mean squared difference to the photograph, without the renderer's own noise; None without a photograph."""
    squared_error: list[float] = field(default_factory=list)
    """Standard error of that."""
    passes: list[int] = field(default_factory=list)

    def add(self, draw: Callable[[int], FloatArray], photo: FloatArray | None, most: int = PASSES) -> None:
        """Add a view: passes, two at least, until its mean and its difference to the photograph are known.

        Args:
            draw: the picture [h, w, 3] by a seed.
            photo: to compare with [h, w, 3].
            most: passes.
        """
        total, squares, grey = (np.zeros(1) for _ in range(3))
        first = draw(0).astype(np.float64)  # sums of differences to it: less is lost to cancellation
        for count in range(2, max(most, 2) + 1):
            off = draw(count - 1) - first
            total, squares, grey = total + off, squares + off**2, grey + off.mean(-1) ** 2
            error = float(np.sqrt(_variance(total.mean(-1), grey, count).sum()) / grey.size)
            mean = first + total / count
            known = error <= ERROR * abs(float(mean.mean()))
            if photo is not None:
                squared, squared_error = squared_difference(mean - photo, _variance(total, squares, count), count)
                known &= squared_error <= SQUARED_ERROR * squared
            if known:
                break
        self.mean.append(mean.astype(np.float32))
        self.error.append(error)
        self.squared.append(None if photo is None else squared)
        self.squared_error.append(0.0 if photo is None else squared_error)
        self.passes.append(count)


def squared_difference(off: Float64Array, variance: Float64Array, passes: int) -> tuple[float, float]:
    """Mean squared difference of a picture without its noise, and the standard error of that.

    Args:
        off: the mean picture less what it is compared with [h, w, 3].
        variance: of the mean picture, from the spread of its passes [h, w, 3].
        passes: how many.
    """
    squares = off**2 - variance
    # Of (mean - p)^2 - variance: 4 (mean - p)^2 variance by the first power of the noise, 2 variance^2 n / (n - 1) by
    # the second; the channels of a pixel share their noise, pixels do not.
    spread = 4.0 * np.maximum(squares, 0.0) * variance + 2.0 * variance**2 * (passes / (passes - 1))
    error = float(np.sqrt(spread.sum() * off.shape[-1]) / off.size)
    return float(squares.mean()), error


def _variance(total: Float64Array, squares: Float64Array, passes: int) -> Float64Array:
    """Of the mean over passes, without bias, from their sum and the sum of their squares."""
    spread: Float64Array = np.maximum(squares - total**2 / passes, 0.0) / (passes * (passes - 1))
    return spread
