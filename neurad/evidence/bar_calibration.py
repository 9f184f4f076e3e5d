"""Scales of the roughness's error bars, from two independent halves of the photographs' pixels and without any truth.

Each half k of the pixels in a cell asks for a change of roughness ``d_k = g_k / F_k`` (:mod:`neurad.evidence.fisher`).
With e the error of the recovered roughness, ``d_k = noise_k - e``, and the noise of one half is independent of that of
the other. So ``d_1 d_2`` has the mean of e^2, noise or not, and

    mean of d_1 d_2 = 1 / (gain F + 1 / prior^2)

gives the ``gain``, how much of the information the fit made use of, from the products of all cells. ``F`` is that of
all pixels together, more than ``F_1 + F_2``, since halves know the albedo of a patch less well; ``prior`` is how far it
is off where there is no information. What the fit's error shares with the noise of the very pixels that it was fitted
to makes products smaller, at most by as much as a gain of 1 allows for.

A fit with a closing step has better ones: :mod:`neurad.evidence.closing_calibration`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurad.core.records import BoolArray, Float64Array, IntArray
from neurad.evidence.fisher import profile

PRIOR = 0.14
"""Standard deviation of roughness where nothing is known: that of dielectrics between 0.1 and 0.6, all alike. Cells in
which pixels tell next to nothing could only measure it in larger numbers than there are."""
USUAL_GAIN, FACTOR = 0.02, 3.0
"""Gain of fits of some minutes, and the factor by which they differ: what the products have to outweigh."""
OUTLIER = 9.0
"""Products are cut at so many standard deviations: residuals have long tails."""
_GAINS = np.geomspace(1e-3, 1.0, 41)


@dataclass(frozen=True)
class RoughnessBars:
    """How information becomes a standard deviation."""

    gain: float
    """Fraction of the information that the fit made use of, in (0, 1], where the power is 1."""
    prior: float
    """Standard deviation without any information."""
    power: float = 1.0
    """Power of the information."""

    def variance(self, information: Float64Array) -> Float64Array:
        """Variance of the roughness by ``information`` in units of 1 / variance, which is noise where it is below 0."""
        return variance(information, self.gain, self.prior, self.power)


def variance(
    information: Float64Array, gain: float | Float64Array, prior: float | Float64Array, power: float
) -> Float64Array:
    """:meth:`RoughnessBars.variance` of scales that broadcast with the information."""
    return np.asarray(1.0 / (gain * np.maximum(information, 0.0) ** power + 1.0 / np.square(prior)))


def log_prior_cost(values: Float64Array, usual: float, factor: float) -> Float64Array:
    """The cost of values that are not the usual one: 1 where they differ from it by ``factor``."""
    return np.asarray(np.square(np.log(values / usual) / np.log(factor)))


def calibrate(
    by_albedo: Float64Array,
    by_roughness: Float64Array,
    residual: Float64Array,
    whole: Float64Array,
    odd: BoolArray,
    places: tuple[IntArray, IntArray],
    noise: float,
) -> RoughnessBars:
    """Measure the scales.

    Args:
        by_albedo: derivatives, by half of the samples, in units of the brightness [2, n, c].
        by_roughness: the same by the roughness.
        residual: the same unit.
        whole: what every pixel adds to the information of all that the fit has seen, in units of 1 / variance [n].
        odd: whether a pixel belongs to the second half of the photographs' pixels [n].
        places: the patch of one albedo and the cell of one roughness that each pixel lies in [n], numbered from 0.
        noise: squared residual of the photographs.
    """
    patch, cell = places
    patches, count = int(patch.max(initial=-1)) + 1, int(cell.max(initial=-1)) + 1
    information, gradient = np.zeros((2, count)), np.zeros((2, count))
    scatter = noise
    for half in range(2):
        lanes = odd == bool(half)
        profiled = profile(by_albedo[:, lanes], by_roughness[:, lanes], residual[:, lanes], patch[lanes], patches)
        information[half] = np.bincount(cell[lanes], profiled.information(), count)
        gradient[half] = np.bincount(cell[lanes], profiled.gradient(), count)
        if lanes.any():
            scatter = max(scatter, float(np.square(profiled.residual.mean(0)).mean()))
    both = (information > 0).all(0)
    information, gradient = information[:, both], gradient[:, both]
    all_pixels = np.bincount(cell, whole, count)[both].astype(np.float64)
    return RoughnessBars(_gain(information, gradient, scatter, all_pixels), PRIOR)


def _gain(information: Float64Array, gradient: Float64Array, scatter: float, all_pixels: Float64Array) -> float:
    """The gain that fits the products of both halves best, by weighted least squares, and is not far from the usual.

    A product has the variance ``(e^2 + n_1) (e^2 + n_2)`` with ``n_k = scatter / F_k``, in which e^2 is that of the
    usual gain.

    Args:
        information: F of both halves of the pixels, in units of w [2, cells], above 0.
        gradient: their gradients [2, cells].
        scatter: variance of a residual, the estimate's own noise included.
        all_pixels: F of all pixels that the fit has seen, in units of 1 / variance [cells].
    """
    error = RoughnessBars(USUAL_GAIN, PRIOR).variance(all_pixels)
    # Numbers of order 1, also where there is next to no information: F / (F e^2 + scatter) instead of 1 / (e^2 + n)
    spread = information * error + scatter  # [2, cells]
    product = (gradient / np.sqrt(information * spread)).prod(0).clip(-OUTLIER, OUTLIER)
    slope = np.sqrt((information / spread).prod(0))  # 1 / standard deviation of a product
    expected = [slope * RoughnessBars(gain, PRIOR).variance(all_pixels) for gain in (USUAL_GAIN, *_GAINS)]
    squares = [float(np.square(product - mean).sum()) for mean in expected]
    dispersion = max(squares[0] / max(len(product), 1), 1.0)  # residuals have longer tails than the variance above has
    costs = np.array(squares[1:]) / dispersion + log_prior_cost(_GAINS, USUAL_GAIN, FACTOR)
    return float(_GAINS[int(np.argmin(costs))])
