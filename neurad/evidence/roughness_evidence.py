"""What all training pixels ask of the roughness: a Gauss-Newton step with the albedo profiled out, patch by patch.

A residual ``e`` of a pixel is explained by changes ``R dr + D da`` of the roughness and the albedo. Both derivatives
are estimates with noise, and a least-squares fit to noisy derivatives is drawn to zero. So the equations are multiplied
by instruments instead (instrumental variables): ``R'`` and ``D'``, the means of ``R`` and ``D`` over the 5 x 5 pixels
around, without the pixel itself. These have a twenty-fourth of the noise, and none of it in common with ``R``, ``D``
and ``e`` of the pixel, so that sums of products have the right mean whatever the noise. With the albedo of each small
patch free,

    F = sum R'W R - (sum R'W D) (sum D'W D)^-1 (sum D'W R),   g = sum R'W e - (sum R'W D) (sum D'W D)^-1 (sum D'W e),

and the patch asks for ``dr = g / F``. D is a diagonal matrix of the colour channels and W the inverse of the residual's
covariance around the pixel: noise of light is much the same in all channels, in units of their brightness, while a
sheen on coloured paint is not, so that differences of the channels tell most (generalised least squares, Aitken 1935).
How sure the patch is follows from how its pixels scatter: the variance of ``g`` is the sum of their squared parts,
which can be larger than ``F``, since residuals have long tails. ``F`` and ``g`` are divided by that ratio, measured
over patches of like ``F``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurad.core.records import BoolArray, Float64Array, FloatArray, IntArray
from neurad.evidence.error_bars import ToUnitCube, cells, in_cube
from neurad.evidence.fisher import FLOOR, per_patch
from neurad.evidence.pixel_means import PixelMeans

BOX = 5
"""Pixels along the side of the box that instruments are means over, where all pixels are drawn."""
COVARIANCE_BOX = 9
"""Pixels along the side of the box of the residual's covariance. With 5 a pixel's own residual is so much of it that
parts no longer scatter as they should."""
NEIGHBOURS, MAX_BOX = 8, 65
"""Pixels that should lie in most boxes: where a part of them is drawn, boxes grow until they do, or to this side."""
PIXELS_A_PATCH = 4
"""Fewer in the mean, and patches are larger: each has an albedo of its own, which takes a pixel's worth of evidence."""
RIDGE = 0.05
"""Fraction of the covariance of all pixels that is added to that around each."""
DIAGONAL_RIDGE = 1e-3
"""Fraction of that covariance's trace on its diagonal: where all is grey, channels do not differ at all."""
OUTLIER = 2.0
"""Parts of single pixels are cut at so many of their standard deviations."""
MAX_CHANGE, MAX_DEVIATIONS = 0.5, 4.0
"""Patches that ask for a larger change, and for so many standard deviations more, are left out."""
RANKS = 20
"""Groups of patches of like ``F`` that the ratio is measured in."""


@dataclass(frozen=True)
class Evidence:
    """Information and gradient of the patches that the pixels see."""

    side: int
    """Patches along the unit cube."""
    x: Float64Array
    """Middle of each in the unit cube [m, 3]."""
    information: Float64Array
    """1 / variance of what each asks for [m]."""
    gradient: Float64Array
    """Change of roughness that each asks for, times :attr:`information` [m]."""


def evidence(
    pixels: PixelMeans, to_cube: ToUnitCube, side: int, residual: FloatArray | None = None
) -> tuple[Evidence, Evidence, Evidence]:
    """Evidence of all pixels and of two halves of them, the two colours of a chess board, in the same patches.

    Args:
        pixels: some of the training pixels.
        to_cube: positions to the unit cube of the fields.
        side: patches along that, each with an albedo of its own; half as many until pixels suffice.
        residual: what is to be explained in place of the pixels' own [n, 3], by whose covariance it is weighted.
    """
    x = in_cube(to_cube, pixels.p)
    patch, count = cells(x, side)
    while side > 2 and len(x) < PIXELS_A_PATCH * count:
        side //= 2
        patch, count = cells(x, side)
    whole = _Pixels.of(pixels)
    if residual is not None:
        whole = replace(whole, e=residual)
    odd = (pixels.corner.sum(-1) + pixels.view) % 2 == 1
    everything = np.ones(len(x), bool)
    first, second, third = (whole.evidence(x, side, patch, count, part) for part in (everything, ~odd, odd))
    return first, second, third


@dataclass(frozen=True)
class _Pixels:
    """Estimates and instruments of pixels."""

    r: FloatArray
    """R [n, 3]; D and e likewise."""
    d: FloatArray
    e: FloatArray
    r_instrument: FloatArray
    """R' [n, 3], and D' likewise."""
    d_instrument: FloatArray
    precision: FloatArray
    """W [n, 3, 3]."""
    root: Float64Array
    """Cholesky factor of the residual's covariance over all pixels [3, 3]."""

    @classmethod
    def of(cls, pixels: PixelMeans) -> _Pixels:
        views = _by_view(pixels)
        box = BOX
        derivatives = np.concatenate((pixels.r, pixels.d), -1)
        sums, around = _box_sums(derivatives, pixels.corner, views, box)
        while np.median(around) < NEIGHBOURS and box < MAX_BOX:
            box = 2 * box - 1
            sums, around = _box_sums(derivatives, pixels.corner, views, box)
        instruments = (sums - derivatives) / np.maximum(around - 1.0, 1.0)[:, None]
        # ---------------------- Covariance of the channels ----------------------

        pairs = pixels.e[:, _ROWS] * pixels.e[:, _COLUMNS]  # [n, 6]
        sums, around = _box_sums(pairs, pixels.corner, views, box + COVARIANCE_BOX - BOX)
        mean = _matrices(pairs.mean(0, dtype=np.float64))
        mean += (DIAGONAL_RIDGE * np.trace(mean) + 1e-30) * np.eye(3)
        precision = np.linalg.inv(_matrices(sums / around[:, None]) + RIDGE * mean).astype(np.float32)
        return cls(
            pixels.r, pixels.d, pixels.e, instruments[:, :3], instruments[:, 3:], precision,
            np.asarray(np.linalg.cholesky(mean), np.float64),
        )  # fmt: skip

    def evidence(self, x: Float64Array, side: int, patch: IntArray, count: int, chosen: BoolArray) -> Evidence:
        """Evidence of some pixels at ``x`` [n, 3] in ``patch`` [n], of which there are ``count``, ``side`` along the
        cube.
        """
        precision = self.precision * chosen[:, None, None]
        by_r = np.einsum("ni,nij->nj", self.r_instrument, precision)  # R'W [n, 3]
        by_d = self.d_instrument[:, :, None] * precision  # D'W [n, 3, 3]
        rr = np.bincount(patch, (by_r * self.r).sum(-1), count).astype(np.float64)
        rd = per_patch(np.asarray(by_r * self.d, np.float64), patch, count)
        dr, de = (per_patch((by_d @ value[:, :, None])[..., 0], patch, count) for value in (self.r, self.e))
        dd = per_patch(np.asarray(by_d * self.d[:, None], np.float64).reshape(-1, 9), patch, count).reshape(-1, 3, 3)
        inverse = self._inverse(dd)
        by_albedo = np.einsum("pi,pij->pj", rd, inverse)
        information = rr - (by_albedo * dr).sum(-1)
        # ---------------------- What every pixel adds to g ----------------------

        explained = np.einsum("pij,pj->pi", inverse, de)
        free = self.r_instrument - by_albedo[patch] * self.d_instrument
        weighted = np.einsum("ni,nij->nj", free, precision)
        part = (weighted * (self.e - explained[patch] * self.d)).sum(-1)
        deviation = np.sqrt((weighted * free).sum(-1).clip(0.0))
        part = part.clip(-OUTLIER * deviation, OUTLIER * deviation)
        gradient = np.bincount(patch, part, count).astype(np.float64)
        scatter = np.bincount(patch, np.square(part), count).astype(np.float64)
        # Of few pixels, or lit in few colours, the albedo can take away all that there is to know but for noise.
        possible = np.abs(gradient) <= MAX_CHANGE * information + MAX_DEVIATIONS * np.sqrt(information.clip(0.0))
        information, gradient, scatter = (np.where(possible, x, 0.0) for x in (information, gradient, scatter))
        ratio = _excess(information, scatter)
        middle = per_patch(x, patch, count) / np.bincount(patch, minlength=count)[:, None]
        return Evidence(side, middle, information.clip(0.0) / ratio, gradient / ratio)

    def _inverse(self, dd: Float64Array) -> Float64Array:
        """Inverse of ``sum D'W D`` of patches [m, 3, 3], but for noise and with :data:`FLOOR` pixels of brightness 1
        more.
        """
        white = self.root.T @ (0.5 * (dd + dd.transpose(0, 2, 1))) @ self.root
        power, axes = np.linalg.eigh(white)
        axes = self.root @ axes
        return np.asarray(axes / (power.clip(0.0) + FLOOR)[:, None, :] @ axes.transpose(0, 2, 1))


_ROWS, _COLUMNS = np.triu_indices(3)


def _matrices(triangles: FloatArray | Float64Array) -> Float64Array:
    """Symmetric matrices [..., 3, 3] by their upper triangles [..., 6]."""
    matrices = np.empty((*triangles.shape[:-1], 3, 3))
    matrices[..., _ROWS, _COLUMNS] = matrices[..., _COLUMNS, _ROWS] = triangles
    return matrices


def _by_view(pixels: PixelMeans) -> list[IntArray]:
    """Indices of the pixels of each view."""
    order = np.argsort(pixels.view, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(pixels.view[order])) + 1)


def _box_sums(values: FloatArray, corner: IntArray, views: list[IntArray], box: int) -> tuple[FloatArray, FloatArray]:
    """Sums [n, c] of the values of a view's pixels over the boxes around them, and how many pixels each box has [n]."""
    from scipy.ndimage import uniform_filter  # imported where it is needed: it loads slowly

    sums, around = np.empty_like(values), np.empty(len(values), values.dtype)
    for lanes in views:
        column, row = (corner[lanes] - corner[lanes].min(0)).T
        image = np.zeros((int(row.max()) + 1, int(column.max()) + 1, values.shape[1] + 1), np.float32)
        image[row, column, :-1], image[row, column, -1] = values[lanes], 1.0
        found = uniform_filter(image, (box, box, 0), mode="constant")[row, column] * np.float32(box * box)
        sums[lanes], around[lanes] = found[:, :-1], np.rint(found[:, -1])
    return sums, around


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
