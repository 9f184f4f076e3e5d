"""Scales of the roughness's error bars, from what halves of all training pixels ask for at the closing step of a fit.

The step looks at all pixels with many more samples than the pass of :mod:`neurad.evidence.bar_calibration` has, before
it has taken any of what they ask for. So from its halves both scales are found, with ``F^POWER`` for ``F``: information
lies in few of the pixels that share a place, so that its error falls more slowly. Pixels ask for a part ``s``
(:data:`RESPONSE`) of the error ``e``, and the step takes a part ``t`` of the power of that: what is too fine for its
grid, or halves do not agree on, stays. So products of what halves ask of a patch have the mean of ``s^2 e^2``, and the
step leaves ``((1 - s)^2 t + 1 - t) e^2``.

Where little is known products of patches are noise, and what both halves mistake for roughness, an edge of the albedo,
say. Sums over the cells of the step's grid have less of both, but also less of the error: patches of a cell are off by
the same only in part. The cells that know much give the ratio, where both are measured well; so curves are fitted to
patches and to cells together. What the step takes is compared with what these curves say that pixels ask for:
noise of the products that happens to be positive would count as something that the step leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from neurad.core.records import Float64Array, IntArray
from neurad.evidence.bar_calibration import PRIOR, RoughnessBars, log_prior_cost, variance
from neurad.evidence.fisher import per_patch

POWER = 0.8
"""Power of the information. With 0.7 to 0.85 bars of three rooms cover alike in each sixth by information; with 1
those that claim most are too narrow."""
RESPONSE = 0.65
"""The part of what a roughness is off by that pixels ask for at a closing step: their response is not linear, and
albedo and light have made up for some of it."""
SPREAD = 0.3
"""Standard deviation of roughness. Patches that know it better count alike where halves are compared: otherwise
a few would decide, of which the fit has long known all that there is to know."""
LEVELS, MODEL_ERROR = 16, 0.15
"""Levels of patches by information, and the part by which the means in them differ from any such curve."""
PRIOR_FACTOR, GAIN, GAIN_FACTOR = 1.65, 1.0, 7.4
"""By which the prior of rooms differs from :data:`PRIOR`; what is usual of the gain of ``F^POWER``, and how much that
differs."""
ROUNDS = 2
"""Rounds of finding what the step takes of what pixels ask for by the curves, and of fitting the curves again."""
RATIO, RATIO_FACTOR = 1.4, 1.5
"""Mean squared error of patches over that of the means of cells, and by how much that differs."""
_PRIORS, _GAINS, _RATIOS = np.geomspace(0.02, 0.5, 65), np.geomspace(1e-2, 1e2, 65), np.geomspace(0.8, 4.0, 33)


def robust_weight(information: Float64Array) -> Float64Array:
    """Weights of equations of so much information (1 / variance of a roughness), with which patches that know it better
    than :data:`SPREAD` count alike.
    """
    return np.asarray(1.0 / (1.0 + SPREAD**2 * information))


def calibrate_at_closing(
    information: Float64Array, gradient: Float64Array, around: Float64Array, place: IntArray, explained: float = 0.0
) -> RoughnessBars:
    """The scales that fit best what halves ask for.

    Args:
        information: 1 / variance of what both halves ask of each patch [2, m].
        gradient: what they ask for times that [2, m].
        around: information of all pixels around each patch, which the bars are made of [m].
        place: the cell of the step's grid that each patch lies in, numbered from 0 [m].
        explained: by how much the step of one half lowers the other's squared residuals, over both halves, each
            equation times its :func:`robust_weight` weight.
    """
    both = (information > 0).all(0)
    patches = _Equations.from_halves(information[:, both], gradient[:, both], around[both])
    edges = np.quantile(around[both], np.linspace(0.0, 1.0, LEVELS + 1)[1:-1]) if both.any() else np.empty(0)
    of_patches, of_cells = patches.products(edges), patches.summed(place[both]).products(edges)
    left = 1.0 / RESPONSE**2
    scales = _fitted(of_patches, of_cells, left)
    for _ in range(ROUNDS):
        total = float((of_patches.information * scales.variance(of_patches.middle)).sum()) / left
        taken = min(explained / total, 1.0) if total > 0.0 else 0.0
        left = ((1.0 - RESPONSE) ** 2 * taken + 1.0 - taken) / RESPONSE**2
        scales = _fitted(of_patches, of_cells, left)
    return scales


def _fitted(of_patches: _Products, of_cells: _Products, left: float) -> RoughnessBars:
    """The scales that fit both best where the step leaves so much squared error over the products."""
    costs = np.stack([of_cells.misfit(left, ratio) for ratio in _RATIOS])  # [ratios, priors, gains]
    costs += log_prior_cost(_RATIOS, RATIO, RATIO_FACTOR)[:, None, None] + of_patches.misfit(left)
    costs += log_prior_cost(_PRIORS, PRIOR, PRIOR_FACTOR)[:, None] + log_prior_cost(_GAINS, GAIN, GAIN_FACTOR)
    _, prior, gain = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return RoughnessBars(float(_GAINS[gain]), float(_PRIORS[prior]), POWER)


@dataclass(frozen=True)
class _Products:
    """What halves agree to ask for, by level of information."""

    middle: Float64Array
    """Information around [levels]."""
    mean: Float64Array
    """Product of what both halves ask for [levels]."""
    deviation: Float64Array
    """Standard deviation of that mean [levels]."""
    information: Float64Array
    """Information of both halves, times the weights [levels]."""

    def misfit(self, left: float, ratio: float = 1.0) -> Float64Array:
        """Sums of squared differences from the curves of all scales [priors, gains], in units of what they may be.

        Args:
            left: the squared error after the step over the products.
            ratio: of the curves to the squared errors that these products have the mean of.
        """
        curve = variance(self.middle, _GAINS[:, None], _PRIORS[:, None, None], POWER) / ratio  # [priors, gains, levels]
        allowed = np.square(left * self.deviation) + np.square(MODEL_ERROR * curve)
        return np.asarray((np.square(left * self.mean - curve) / allowed).sum(-1))


@dataclass(frozen=True)
class _Equations:
    """``amount * change = gradient`` of both halves [2, n], times their weights."""

    amount: Float64Array
    gradient: Float64Array
    noise: Float64Array
    """Variance of the gradient [2, n]."""
    around: Float64Array
    """log(1 + information around) [n]."""

    @classmethod
    def from_halves(cls, information: Float64Array, gradient: Float64Array, around: Float64Array) -> Self:
        weight = robust_weight(information)
        return cls(weight * information, weight * gradient, np.square(weight) * information, np.log1p(around))

    def summed(self, place: IntArray) -> _Equations:
        """One equation for all that lie in the same of the places [n]; what is around them is their mean."""
        occupied, place = np.unique(place, return_inverse=True)
        amount, gradient, noise = (
            per_patch(x.T, place, len(occupied)).T for x in (self.amount, self.gradient, self.noise)
        )
        return _Equations(amount, gradient, noise, np.bincount(place, self.around) / np.bincount(place))

    def products(self, edges: Float64Array) -> _Products:
        """By levels with these edges of the information around."""
        level = np.searchsorted(np.log1p(edges), self.around)
        columns = (
            self.noise.prod(0), self.amount.prod(0), self.gradient.prod(0), self.amount.sum(0), self.around,
            np.ones(len(self.around)),
        )  # fmt: skip
        sums = per_patch(np.stack(columns, -1), level, LEVELS)
        noise, square, product, information, around, count = sums[sums[:, 1] > 0].T
        return _Products(np.expm1(around / count), product / square, np.sqrt(noise) / square, information)
