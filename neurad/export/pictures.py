"""Views as several renderers show them, in passes that say how much of a picture is noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from neurad.core.records import FloatArray

ERROR = 0.002
"""Standard error of the mean of a view that is rendered for, as a fraction of it."""
PASSES = 32
"""Most passes to get there."""

Draw = Callable[[int, int], FloatArray]
"""A picture [h, w, 3] of the view of this number by this seed."""


@dataclass
class Pictures:
    """The views as one renderer shows them."""

    mean: list[FloatArray] = field(default_factory=list)
    """Linear [h, w, 3]."""
    two: list[FloatArray] = field(default_factory=list)
    """The same of the first two passes alone."""
    error: list[float] = field(default_factory=list)
    """Standard error of the mean of each."""
    noise: list[float] = field(default_factory=list)
    """Mean squared noise of a pixel of ``mean``."""
    noise_of_two: list[float] = field(default_factory=list)
    """The same of ``two``."""
    passes: list[int] = field(default_factory=list)

    def add(self, draw: Callable[[int], FloatArray], most: int = PASSES) -> None:
        """Add a view: passes, two at least, until its mean is known well enough.

        Args:
            draw: the picture [h, w, 3] by a seed.
            most: passes.
        """
        total, squares = np.zeros(1), np.zeros(1)
        two: list[np.ndarray] = []
        grey, grey_squares = np.zeros(1), np.zeros(1)
        for count in range(1, max(most, 2) + 1):
            shown = draw(count - 1).astype(np.float64)
            total, squares = total + shown, squares + shown**2
            grey, grey_squares = grey + shown.mean(-1), grey_squares + shown.mean(-1) ** 2
            if count <= 2:
                two.append(shown)
            if count >= 2:
                mean = total / count
                error = standard_error(grey, grey_squares, count)
                if error <= ERROR * abs(float(mean.mean())):
                    break
        self.passes.append(count)
        self.mean.append(mean.astype(np.float32))
        self.error.append(error)
        self.noise.append(float(_variance(total, squares, count).mean()) / count)
        self.two.append((0.5 * (two[0] + two[1])).astype(np.float32))
        self.noise_of_two.append(float(np.square(two[0] - two[1]).mean()) / 4.0)


def standard_error(total: np.ndarray, squares: np.ndarray, passes: int) -> float:
    """Of the mean of a picture, from the spread of every pixel over the passes: pixels are independent.

    Args:
        total: sums over passes [h, w].
        squares: sums of squares [h, w].
        passes: how many.
    """
    return float(np.sqrt(_variance(total, squares, passes).sum() / passes) / total.size)


def _variance(total: np.ndarray, squares: np.ndarray, passes: int) -> np.ndarray:
    """Of one pass, of every pixel, without bias."""
    spread: np.ndarray = np.maximum(squares - total**2 / passes, 0.0) / (passes - 1)
    return spread
