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
"""Most passes to get there; an even number."""

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
    """Mean squared difference to the photograph, linear, without the renderer's own noise; None without a photograph.
    Linear, since a curve turns noise into bias: encoded, veach-ajar at 128 samples is 0.5 dB worse in Mitsuba, whose
    samples spread more, where linear the two agree."""
    squared_error: list[float] = field(default_factory=list)
    """Standard error of that."""
    passes: list[int] = field(default_factory=list)
    halves: list[tuple[Float64Array, Float64Array] | None] = field(default_factory=list)
    """Means of every other pass, less the photograph [h, w, 3] each; None without a photograph."""

    def add(
        self, draw: Callable[[int], FloatArray], photo: FloatArray | None, most: int = PASSES, least: int = 2
    ) -> None:
        """Add a view: pairs of passes, until its mean and its difference to the photograph are known.

        Args:
            draw: the picture [h, w, 3] by a seed.
            photo: to compare with [h, w, 3], linear.
            most: passes; two at least.
            least: passes, even where fewer would do.
        """
        first = draw(0).astype(np.float64)  # sums of differences to it: less is lost to cancellation
        halves = [np.zeros_like(first), np.zeros_like(first)]
        grey, count = np.zeros(first.shape[:2]), 0
        while count < max(most, 2):
            for half in halves:
                off = (draw(count) if count else first) - first
                half += off
                grey, count = grey + off.mean(-1) ** 2, count + 1
            total = halves[0] + halves[1]
            error = float(np.sqrt(_variance(total.mean(-1), grey, count).sum()) / grey.size)
            mean = first + total / count
            known = error <= ERROR * abs(float(mean.mean()))
            if photo is not None:
                squared, squared_error = squared_difference(*_off(first, halves, count, photo))
                known &= squared_error <= SQUARED_ERROR * squared
            if known and count >= least:
                break
        self.mean.append(mean.astype(np.float32))
        self.error.append(error)
        self.squared.append(None if photo is None else squared)
        self.squared_error.append(0.0 if photo is None else squared_error)
        self.passes.append(count)
        self.halves.append(None if photo is None else _off(first, halves, count, photo))

    def farther(self, other: Pictures, view: int) -> tuple[float, float]:
        """By how much a view's mean squared difference to the photograph exceeds that of other pictures of it.

        Renderers that were given the same random numbers share their noise, and most of it cancels here.

        Args:
            other: pictures of the same views, with photographs; as many passes where random numbers are shared.
            view: its number.

        Returns:
            The mean of the difference, without either's noise, and its standard error.
        """
        ours, theirs = self.halves[view], other.halves[view]
        if ours is None or theirs is None:
            return 0.0, 0.0
        (a, b), (c, d) = ours, theirs
        spread = 0.5 * (a**2 - b**2 - c**2 + d**2).sum(-1)  # as in squared_difference
        return float((a * b - c * d).mean()), float(np.sqrt((spread**2).sum()) / a.size)


def squared_difference(first: Float64Array, second: Float64Array) -> tuple[float, float]:
    """Mean squared difference of a picture without its noise, and the standard error of that.

    The product of two halves whose noise is independent has none of it on average. With m their mean and d their
    difference, m . d has the variance of the product, and does not know the answer: (|a|^2 - |b|^2) / 2.

    Args:
        first: one half of the passes less what the picture is compared with [h, w, 3].
        second: the other half.
    """
    squared = float((first * second).mean())
    spread = 0.5 * (first**2 - second**2).sum(-1)  # channels of a pixel share their noise, pixels do not
    return squared, float(np.sqrt((spread**2).sum()) / first.size)


def _off(
    first: Float64Array, halves: list[Float64Array], passes: int, photo: FloatArray
) -> tuple[Float64Array, Float64Array]:
    """The mean of each half of the passes less the photograph, from the sums of their differences to the first pass."""
    one, other = (first + 2.0 * half / passes - photo for half in halves)
    return one, other


def _variance(total: Float64Array, squares: Float64Array, passes: int) -> Float64Array:
    """Of the mean over passes, without bias, from their sum and the sum of their squares."""
    spread: Float64Array = np.maximum(squares - total**2 / passes, 0.0) / (passes * (passes - 1))
    return spread
