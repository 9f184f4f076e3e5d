"""Scales of the roughness's error bars, from two independent halves of the photographs' pixels and without any truth.

Each half k of the pixels in a cell asks for a change of roughness ``d_k = g_k / F_k`` (:mod:`neurad.metrics.fisher`).
With e the error of the recovered roughness, ``d_k = noise_k - e``, and the noise of one half is independent of that of
the other. So ``d_1 d_2`` has the mean of e^2, noise or not, and

    mean of d_1 d_2 = 1 / (gain F + 1 / prior^2)

gives the ``gain``, how much of the information the fit made use of, from the products of all cells. ``F`` is that of
all pixels together, more than ``F_1 + F_2``, since halves know the albedo of a patch less well; ``prior`` is how far it
is off where there is no information. What the fit's error shares with the noise of the very pixels that it was fitted
to makes products smaller, at most by as much as a gain of 1 allows for.

The closing step of a fit looks at all of its pixels with many more samples, and before it has taken any of what they
ask for. From its halves both scales are found (:func:`calibrate_at_closing`), with ``F^POWER`` for ``F``: information
lies in few of the pixels that share a place, so that its error falls more slowly. Pixels ask for a part ``s``
(:data:`RESPONSE`) of the error ``e``, and the step takes a part ``t`` of the power of that: what is too fine for its
grid, or halves do not agree on, stays. So ``d_1 d_2`` has the mean of ``s^2 e^2``, and the step leaves
``((1 - s)^2 t + 1 - t) e^2``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurad.metrics.fisher import profile
from neurad.metrics.scores import BoolArray, Float64Array, IntArray

PRIOR = 0.14
"""Standard deviation of roughness where nothing is known: that of dielectrics between 0.1 and 0.6, all alike. Cells in
which pixels tell next to nothing could only measure it in larger numbers than there are."""
USUAL_GAIN, FACTOR = 0.02, 3.0
"""Gain of fits of some minutes, and the factor by which they differ: what the products have to outweigh."""
OUTLIER = 9.0
"""Products are cut at so many standard deviations: residuals have long tails."""
_GAINS = np.geomspace(1e-3, 1.0, 41)
POWER = 0.8
"""Of the information at a closing step. With 0.7 to 0.85 bars of three rooms cover alike in each sixth of them by
information; with 1 those that claim most are too narrow."""
RESPONSE = 0.65
"""The part of what a roughness is off by that pixels ask for at a closing step: their response is not linear, and
albedo and light have made up for some of it."""
SPREAD = 0.3
"""Of roughness. Patches that know it better than this count alike where halves of the pixels are compared: otherwise
a few would decide, of which the fit has long known all that there is to know."""
LEVELS, MODEL_ERROR = 16, 0.15
"""Of patches by information, and the part by which the means in them differ from any such curve."""
PRIOR_FACTOR, CLOSING_GAIN, CLOSING_FACTOR = 1.65, 1.0, 7.4
"""By which the prior of rooms differs from :data:`PRIOR`; what is usual of the gain of ``F^POWER``, and how much that
differs."""
_PRIORS, _CLOSING_GAINS = np.geomspace(0.02, 0.5, 65), np.geomspace(1e-2, 1e2, 65)


@dataclass(frozen=True)
class RoughnessBars:
    """How information becomes a standard deviation."""

    gain: float
    """Of the information: the fraction that the fit made use of, in (0, 1], where the power is 1."""
    prior: float
    """Standard deviation without any information."""
    power: float = 1.0
    """Of the information."""

    def variance(self, information: Float64Array) -> Float64Array:
        """Variance of the roughness by ``information`` in units of 1 / variance, which is noise where it is below 0."""
        return _variance(information, self.gain, self.prior, self.power)


def _variance(
    information: Float64Array, gain: float | Float64Array, prior: float | Float64Array, power: float
) -> Float64Array:
    """:meth:`RoughnessBars.variance` of scales that broadcast with the information."""
    return np.asarray(1.0 / (gain * np.maximum(information, 0.0) ** power + 1.0 / np.square(prior)))


def _unusual(values: Float64Array, usual: float, factor: float) -> Float64Array:
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
    costs = np.array(squares[1:]) / dispersion + _unusual(_GAINS, USUAL_GAIN, FACTOR)
    return float(_GAINS[int(np.argmin(costs))])


def levelled(information: Float64Array) -> Float64Array:
    """Weights of equations of so much information (1 / variance of a roughness), with which patches that know it better
    than :data:`SPREAD` count alike.
    """
    return np.asarray(1.0 / (1.0 + SPREAD**2 * information))


def calibrate_at_closing(
    information: Float64Array, gradient: Float64Array, around: Float64Array, explained: float = 0.0
) -> RoughnessBars:
    """The scales that fit best what halves of all training pixels ask for at the closing step of a fit.

    Args:
        information: 1 / variance of what both halves ask of each patch [2, m].
        gradient: what they ask for times that [2, m].
        around: information of all pixels around each patch, which the bars are made of [m].
        explained: by how much the step of one half lowers the other's squared residuals, over both halves, each
            equation times its :func:`levelled` weight.
    """
    both = (information > 0).all(0)
    information, gradient, around = information[:, both], gradient[:, both], around[both]
    # ---------------------- Mean square of what patches of like information ask for ----------------------

    edges = np.quantile(around, np.linspace(0.0, 1.0, LEVELS + 1)[1:-1]) if both.any() else np.empty(0)
    level = np.searchsorted(edges, around)
    weight = levelled(information)  # [2, m]
    part = {
        "products": (weight * gradient).prod(0),
        "amount": (weight * information).prod(0),
        "noise": np.square(weight).prod(0) * information.prod(0),  # variance of the products
        "logarithm": np.log1p(around),
        "all": (weight * information).sum(0),
        "count": np.ones(len(around)),
    }
    sums = {name: np.bincount(level, values, LEVELS) for name, values in part.items()}
    sums = {name: values[sums["amount"] > 0] for name, values in sums.items()}  # [levels]
    asked, deviation = sums["products"] / sums["amount"], np.sqrt(sums["noise"]) / sums["amount"]
    # ---------------------- Mean squared error that the step leaves ----------------------

    total = float((sums["all"] * asked.clip(0.0)).sum())
    taken = min(max(explained / total, 0.0), 1.0) if total > 0.0 else 0.0
    left = ((1.0 - RESPONSE) ** 2 * taken + 1.0 - taken) / RESPONSE**2
    square, deviation = left * asked, left * deviation
    middle = np.expm1(sums["logarithm"] / sums["count"])
    # ---------------------- The curve that fits it best ----------------------

    curve = _variance(middle, _CLOSING_GAINS[:, None], _PRIORS[:, None, None], POWER)  # [priors, gains, levels]
    costs = (np.square(square - curve) / (np.square(deviation) + np.square(MODEL_ERROR * curve))).sum(-1)
    costs += _unusual(_PRIORS, PRIOR, PRIOR_FACTOR)[:, None] + _unusual(_CLOSING_GAINS, CLOSING_GAIN, CLOSING_FACTOR)
    prior, gain = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return RoughnessBars(float(_CLOSING_GAINS[gain]), float(_PRIORS[prior]), POWER)
