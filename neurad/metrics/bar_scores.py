"""How well error bars fit the errors: coverage, order, and the score of what they call sure."""

import math

import numpy as np

from neurad.core.records import Float64Array
from neurad.metrics.scores import psnr

LEVELS = (0.5, 0.9)
"""Probabilities of the central intervals whose coverage is reported."""


def bar_scores(predicted: Float64Array, std: Float64Array, truth: Float64Array) -> dict[str, float]:
    """``coverage_50``, ``coverage_90``, ``spearman``, ``ause``, ``psnr_sure`` and its constant of pixels [n, c] of all
    views; none without pixels. See :func:`coverage`, :func:`ause` and :func:`psnr_of_most_certain_half`; ``spearman``
    is the rank correlation of bars and absolute errors. A pixel's bar and error for the last four are roots of means
    over channels.

    Raises:
        ValueError: the shapes differ.
    """
    if not predicted.shape == std.shape == truth.shape:
        raise ValueError(f"shapes differ: prediction {predicted.shape}, bars {std.shape}, truth {truth.shape}")
    if len(predicted) == 0:
        return {}
    error = predicted - truth
    result = {f"coverage_{round(100 * level)}": coverage(error, std, level) for level in LEVELS}
    size, bar = (np.sqrt(np.square(values).mean(-1)) for values in (error, std))
    result["spearman"] = spearman(bar, size)
    result["ause"] = ause(bar, size)
    result["psnr_sure"], result["psnr_sure_constant"] = psnr_of_most_certain_half(bar, predicted, truth)
    return result


def coverage(error: Float64Array, std: Float64Array, level: float) -> float:
    """Fraction of the values whose truth lies in the central interval of probability ``level`` in (0, 1) around the
    prediction; of ``error`` and ``std`` [n, c], channel by channel.

    Errors have longer tails than normal ones: where bars are alike the fourth moment is many times the square of the
    second. They are taken for logistic: intervals are 0.606 and 1.623 standard deviations wide on either side for 0.5
    and 0.9.
    """
    half_width = math.sqrt(3.0) / math.pi * math.log((1.0 + level) / (1.0 - level)) * std
    return float((np.abs(error) <= half_width).mean())


def spearman(bar: Float64Array, size: Float64Array) -> float:
    """Rank correlation of bars and absolute errors [n], in [-1, 1]; 0 where one of them is the same everywhere."""
    if np.ptp(bar) == 0 or np.ptp(size) == 0:
        return 0.0
    return float(np.corrcoef(_ranks(bar), _ranks(size))[0, 1])


def ause(bar: Float64Array, size: Float64Array) -> float:
    """Area under the sparsification error, over that of a random order: 0 is the order of the true errors, 1 random.

    The sparsification curve is the root mean squared error of the pixels that are left while those with the largest
    bars are taken away, one after the other (Ilg et al. 2018). Its error is what it lies above the curve of the true
    errors' own order. A random order leaves the root mean squared error what it is. Equal bars count as a random order
    among themselves.

    Args:
        bar: of the pixels [n].
        size: their absolute errors [n].
    """
    whole = float(np.sqrt(np.square(size).mean()))
    best = _left_over(size, size)
    random_area = float((whole - best).mean())
    return float((_left_over(bar, size) - best).mean()) / random_area if random_area > 0 else 1.0


def psnr_of_most_certain_half(bar: Float64Array, predicted: Float64Array, truth: Float64Array) -> tuple[float, float]:
    """PSNR of the half of the pixels with the smallest bars, and of the best constant of these same pixels."""
    half = np.argsort(bar, kind="stable")[: (len(bar) + 1) // 2]
    error, around = predicted[half] - truth[half], truth[half] - truth[half].mean(0)
    return psnr(float(np.square(error).mean())), psnr(float(np.square(around).mean()))


def _left_over(order: Float64Array, size: Float64Array) -> Float64Array:
    """Root mean squared errors of the k pixels of smallest ``order``, for every k from 1 to n [n]."""
    _, place, count = np.unique(order, return_inverse=True, return_counts=True)
    mean = np.bincount(place, np.square(size)) / count  # of equal bars, whichever goes first
    return np.asarray(np.sqrt(np.cumsum(np.repeat(mean, count)) / np.arange(1, len(size) + 1)))


def _ranks(values: Float64Array) -> Float64Array:
    """Ranks [n], of equal values their mean."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - 0.5 * (count - 1))[place])
