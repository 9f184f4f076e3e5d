"""What all training pixels ask of the roughness: a Gauss-Newton step with the albedo profiled out, patch by patch.

A residual ``e`` of a pixel is explained by changes ``R dr + D da`` of the roughness and the albedo. Both derivatives
are estimates with noise, and a least-squares fit to noisy derivatives is drawn to zero. So the equations are multiplied
by instruments instead (instrumental variables): ``R'`` and ``D'``, the means of ``R`` and ``D`` over 5 x 5 pixels and
all groups of samples, without what they are multiplied with. These have a twentieth of the noise, and none of it in
common with ``R``, ``D`` and ``e`` of the pixel, so that sums of products have the right mean whatever the noise. With
the albedo of each small patch free in every channel,

    F = sum R'R w - (sum R'D w)(sum D'R w) / sum D'D w,   g = sum R'e w - (sum R'D w)(sum D'e w) / sum D'D w,

``w`` = 1 / variance of the residual around the pixel, and the patch asks for ``dr = g / F``. How sure that is follows
from how its pixels scatter: the variance of ``g`` is the sum of their squared parts, which is larger than ``F``, since
residuals have long tails. ``F`` and ``g`` are divided by that ratio, measured over patches of like ``F``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurad.core.records import FloatArray, IntArray
from neurad.metrics.error_bars import ToUnitCube, cells, in_cube
from neurad.metrics.fisher import FLOOR, per_patch
from neurad.metrics.pixel_moments import PixelMoments
from neurad.metrics.scores import BoolArray, Float64Array

BOX = 5
"""Pixels along the side of the box that instruments are means over."""
PIXELS_A_PATCH = 4
"""Fewer in the mean, and patches are larger: each has an albedo of its own, which takes a pixel's worth of evidence."""
LEAST_VARIANCE = 0.3
"""Of the mean: the least that the residual's variance is taken for."""
OUTLIER = 2.0
"""Parts of single pixels are cut at so many of their standard deviations."""
RANKS = 20
"""Groups of patches of like ``F`` that the ratio is measured in."""


@dataclass(frozen=True)
class Evidence:
    """Of the patches that the pixels see."""

    side: int
    """Patches along the unit cube."""
    x: Float64Array
    """Middle of each in the unit cube [m, 3]."""
    information: Float64Array
    """1 / variance of what each asks for [m]."""
    gradient: Float64Array
    """Change of roughness that each asks for, times :attr:`information` [m]."""


def evidence(pixels: PixelMoments, to_cube: ToUnitCube, side: int) -> tuple[Evidence, Evidence, Evidence]:
    """Of all pixels, and of two halves of them, the two colours of a chess board, in the same patches.

    Args:
        pixels: some of the training pixels.
        to_cube: positions to the unit cube of the fields.
        side: patches along that, each with an albedo of its own; half as many until pixels suffice.
    """
    x = in_cube(to_cube, pixels.p)
    patch, count = cells(x, side)
    while side > 2 and len(x) < PIXELS_A_PATCH * count:
        side //= 2
        patch, count = cells(x, side)
    whole = _Pixels.of(pixels)
    odd = (pixels.corner.sum(-1) + pixels.view) % 2 == 1
    everything = np.ones(len(x), bool)
    first, second, third = (whole.evidence(x, side, patch, count, part) for part in (everything, ~odd, odd))
    return first, second, third


@dataclass(frozen=True)
class _Pixels:
    """Products of instruments and estimates [n, 3], each in a pixel and channel."""

    rr: Float64Array
    rd: Float64Array
    dr: Float64Array
    dd: Float64Array
    re: Float64Array
    de: Float64Array
    instruments: tuple[Float64Array, Float64Array]
    """R' and D' of all groups but one's share of the pixel itself [n, 3]."""
    weight: Float64Array
    """[n]."""

    @classmethod
    def of(cls, pixels: PixelMoments) -> _Pixels:
        order = np.argsort(pixels.view, kind="stable")
        values = np.concatenate((pixels.r, pixels.d, np.square(pixels.e).mean(-1, keepdims=True)), -1)
        boxed, around = np.empty_like(values), np.empty(len(values), values.dtype)
        for lanes in np.split(order, np.flatnonzero(np.diff(pixels.view[order])) + 1):
            boxed[lanes], around[lanes] = _box_sums(values[lanes], pixels.corner[lanes])
        others = np.maximum(around * pixels.groups - 1.0, 1.0)[:, None]
        sums = boxed[:, :6] * pixels.groups

        def product(which: slice, with_: FloatArray, own: FloatArray) -> Float64Array:
            """Mean over the groups of the instrument, without the group itself, times an estimate of the group."""
            return ((sums[:, which] * with_ - own) / others).astype(np.float64)

        r, d = slice(0, 3), slice(3, 6)
        variance = boxed[:, 6] / around
        weight = 1.0 / np.maximum(variance, LEAST_VARIANCE * variance.mean() + 1e-30)
        return cls(
            product(r, pixels.r, pixels.rr), product(r, pixels.d, pixels.rd), product(d, pixels.r, pixels.rd),
            product(d, pixels.d, pixels.dd), product(r, pixels.e, pixels.re), product(d, pixels.e, pixels.de),
            ((sums[:, r] - pixels.r) / others, (sums[:, d] - pixels.d) / others), np.asarray(weight, np.float64),
        )  # fmt: skip

    def evidence(self, x: Float64Array, side: int, patch: IntArray, count: int, chosen: BoolArray) -> Evidence:
        """Of some of the pixels at ``x`` [n, 3] in ``patch`` [n], of which there are ``count``, and ``side`` along the
        cube.
        """
        w = np.where(chosen, self.weight, 0.0)[:, None]
        rr, rd, dr, dd, de = (
            per_patch(w * value, patch, count) for value in (self.rr, self.rd, self.dr, self.dd, self.de)
        )
        dd = dd.clip(0.0) + FLOOR * float(np.median(self.weight))
        information = (rr - rd * dr / dd).sum(-1)
        # ---------------------- What every pixel adds to g ----------------------

        by_albedo, explained = (rd / dd)[patch], (de / dd)[patch]
        part = (w * (self.re - by_albedo * self.de - explained * (self.rd - by_albedo * self.dd))).sum(-1)
        free = self.instruments[0] - by_albedo * self.instruments[1]
        deviation = np.sqrt((w * np.square(free)).sum(-1))
        part = part.clip(-OUTLIER * deviation, OUTLIER * deviation)
        gradient = np.bincount(patch, part, count).astype(np.float64)
        ratio = _excess(information, np.bincount(patch, np.square(part), count).astype(np.float64))
        middle = per_patch(x, patch, count) / np.bincount(patch, minlength=count)[:, None]
        return Evidence(side, middle, information.clip(0.0) / ratio, gradient / ratio)


def _box_sums(values: FloatArray, corner: IntArray) -> tuple[FloatArray, FloatArray]:
    """Sums [n, c] of the values of a view's pixels over the boxes around them, and how many pixels each box has [n]."""
    from scipy.ndimage import uniform_filter  # imported where it is needed: it loads slowly

    column, row = (corner - corner.min(0)).T
    image = np.zeros((int(row.max()) + 1, int(column.max()) + 1, values.shape[1] + 1), np.float32)
    image[row, column, :-1], image[row, column, -1] = values, 1.0
    sums = uniform_filter(image, (BOX, BOX, 0), mode="constant")[row, column] * np.float32(BOX * BOX)
    return sums[:, :-1], sums[:, -1]


def _excess(information: Float64Array, variance: Float64Array) -> Float64Array:
    """By how much the gradients of patches scatter more than their information [m] says, at least 1, in groups of
    patches of like information; infinite where that is not above zero.
    """
    positive = information.clip(0.0)
    edges = np.quantile(positive, np.linspace(0.0, 1.0, RANKS + 1)[1:-1])
    rank = np.searchsorted(edges, positive)
    total, scatter = (np.bincount(rank, values, RANKS) for values in (information, variance))
    ratio = np.where(total > 0, np.maximum(scatter / np.maximum(total, 1e-300), 1.0), np.inf)
    return np.asarray(ratio[rank])
