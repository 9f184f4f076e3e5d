"""Scales of the roughness's error bars, from two independent halves of the photographs' pixels and without any truth.

Each half k of the pixels in a cell asks for a change of roughness ``d_k = g_k / F_k`` (:mod:`neurad.metrics.fisher`).
With e the error of the recovered roughness, ``d_k = noise_k - e``, and the noise of one half is independent of that of
the other. So the mean of ``d_1 d_2`` is the mean of e^2, less twice what the fit's own error shares with the noise of the
pixels that it was fitted to. A fit that weighs what pixels say against a prior shares its posterior variance with them,
``v = F / (F + 1 / prior^2)^2``:

    mean of d_1 d_2 = 1 / (gain F + 1 / prior^2) - 2 v

``gain`` says how much of the information the fit made use of, ``prior`` how far it is off where there is none. Both are
fitted to the products of all cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurad.metrics.fisher import profile
from neurad.metrics.scores import BoolArray, Float64Array, IntArray

USUAL = 0.14
"""Standard deviation of roughness where nothing is known: that of dielectrics between 0.1 and 0.6, all alike."""
USUAL_CELLS = 16
"""Cells' worth of trust in it: with many cells the photographs decide."""
OUTLIER = 4.0
"""Products are cut at so many standard deviations: residuals have long tails."""
_PRIORS = np.geomspace(0.02, 0.4, 61)
_GAINS = np.geomspace(1e-4, 1.0, 41)


@dataclass(frozen=True)
class RoughnessBars:
    """How information becomes a standard deviation."""

    gain: float
    """Fraction of the information that the fit made use of, in (0, 1]."""
    prior: float
    """Standard deviation without any information."""

    def variance(self, information: Float64Array) -> Float64Array:
        """Variance of the roughness, in the shape of ``information`` (in units of 1 / variance; below 0 it is noise)."""
        return np.asarray(1.0 / (self.gain * np.maximum(information, 0.0) + 1.0 / self.prior**2))


def calibrate(
    by_albedo: Float64Array,
    by_roughness: Float64Array,
    residual: Float64Array,
    odd: BoolArray,
    places: tuple[IntArray, IntArray],
    noise: float,
    times: float,
) -> RoughnessBars:
    """Measure the scales.

    Args:
        by_albedo: derivatives, by half of the samples, in units of the brightness [2, n, c].
        by_roughness: the same by the roughness.
        residual: the same unit.
        odd: whether a pixel belongs to the second half of the photographs' pixels [n].
        places: the patch of one albedo and the cell of one roughness that each pixel lies in [n], numbered from 0.
        noise: squared residual of the photographs.
        times: all pixels that the fit has seen over those given.
    """
    patch, cell = places
    patches, count = int(patch.max(initial=-1)) + 1, int(cell.max(initial=-1)) + 1
    information, gradient = np.zeros((2, count)), np.zeros((2, count))
    scatter = noise
    for half in range(2):
        lanes = odd == bool(half)
        profiled = profile(*(x[:, lanes] for x in (by_albedo, by_roughness, residual)), patch[lanes], patches)
        information[half] = np.bincount(cell[lanes], profiled.information(), count)
        gradient[half] = np.bincount(cell[lanes], profiled.gradient(), count)
        if lanes.any():
            scatter = max(scatter, float(np.square(profiled.residual.mean(0)).mean()))
    both = (information > 0).all(0)
    return _fit(information[:, both], gradient[:, both], scatter, times / noise)


def _fit(information: Float64Array, gradient: Float64Array, scatter: float, times: float) -> RoughnessBars:
    """The scales that fit the products of both halves best.

    Products are weighted by their variance: a change is shrunk by ``F / (F + scatter / prior^2)``, which keeps cells
    without information from deciding.

    Args:
        information: F of both halves of the pixels, in units of w [2, cells], above 0.
        gradient: their gradients [2, cells].
        scatter: variance of a residual, the estimate's own noise included.
        times: what turns ``information``, both halves together, into that of all pixels in units of 1 / variance.
    """
    ridge = scatter / USUAL**2
    shrunk = information / (information + ridge)  # [2, cells]
    root = np.sqrt(shrunk.prod(0))  # [cells]
    product = (gradient / (information + ridge)).prod(0) / np.maximum(root, 1e-12)
    limit = OUTLIER * USUAL**2
    product = product.clip(-limit, limit)
    all_pixels = times * information.sum(0)
    best, scales = np.inf, RoughnessBars(1.0, USUAL)
    for prior in _PRIORS:
        shared = 2.0 * all_pixels / np.square(all_pixels + 1.0 / prior**2)
        trust = USUAL_CELLS * np.square(prior**2 - USUAL**2)
        for gain in _GAINS:
            expected = RoughnessBars(gain, prior).variance(all_pixels) - shared
            cost = float(np.square(product - root * expected).sum() + trust)
            if cost < best:
                best, scales = cost, RoughnessBars(float(gain), float(prior))
    return scales
