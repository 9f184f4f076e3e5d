"""A Gauss-Newton step of the roughness from all training pixels, with the albedo profiled out, patch by patch.

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

F has noise too. Where matt paint says little, a third of the patches have one below zero: without these F would be too
large in the mean and what is asked for too small, by a half on a white ceiling. So sums over patches keep their sign.
What a place asks for is ``g / F`` with an F that has less noise: the instruments' squares ``V`` times what F is of them
in all places around (regression calibration, Carroll et al. 2006), and F itself where it is known better than that
(empirical Bayes). The variance of ``g`` is V, times what squared parts of pixels are of it in the room.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from neurad.core.groups import group_sums
from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.evidence.pixel_means import PixelMeans

FLOOR = 0.05
"""Added to ``sum D'W D`` of a patch, in pixels of relative brightness 1: keeps dark patches from dividing noise."""
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
MIN_INFORMATION = 1e-6
"""Less is none."""


@dataclass(frozen=True)
class Evidence:
    """What patches say, in sums over their pixels."""

    slope: Float64Array
    """F: what :attr:`gradient` rises by with the roughness [m]."""
    gradient: Float64Array
    """g [m]."""
    square: Float64Array
    """V: instruments squared, which is the slope but for noise [m]."""
    slope_scatter: Float64Array
    """Squared parts of the slope [m]."""
    scatter: Float64Array
    """Squared parts of the gradient [m]."""

    def of_groups(self, group: IntArray, count: int) -> Evidence:
        """Sums over groups of patches, by the group of each [m]."""
        columns = np.stack([getattr(self, f.name) for f in fields(self)], 1)
        return Evidence(*group_sums(columns, group, count).T)

    def changes(self, around: IntArray) -> tuple[Float64Array, Float64Array]:
        """The change of roughness that each asks for, and its information, 1 / variance [m].

        Args:
            around: the larger place that each lies in, from 0 [m].
        """
        large = self.of_groups(around, int(around.max()) + 1)
        expected = (large.slope / np.maximum(large.square, 1e-300)).clip(0.0, 1.0)[around] * self.square
        # As a priori nothing is known of how places differ, what is expected may be off by as much as it is.
        prior = np.square(expected)
        slope = (self.slope * prior + expected * self.slope_scatter) / np.maximum(prior + self.slope_scatter, 1e-300)
        variance = self.square * (self.scatter.sum() / max(self.square.sum(), 1e-300))
        information = np.square(slope.clip(0.0)) / np.maximum(variance, 1e-300)
        known = information > MIN_INFORMATION
        return np.where(known, self.gradient / np.where(known, slope, 1.0), 0.0), np.where(known, information, 0.0)


def patches_of(x: Float64Array, part: IntArray, side: int, pixels: int = PIXELS_A_PATCH) -> tuple[IntArray, int]:
    """The patch that each pixel lies in, numbered from 0 [n], and how many there are: cells of the unit cube, of each
    connected part that pixels show [n] apart.

    Args:
        x: positions in the unit cube [n, 3].
        side: cells along an edge; half as many until pixels suffice.
        pixels: that suffice for a patch, in the mean.
    """
    while True:
        cell = np.minimum((np.clip(x, 0.0, 1.0) * side).astype(np.int64), side - 1)
        number = ((part * side + cell[:, 0]) * side + cell[:, 1]) * side + cell[:, 2]
        occupied, patch = np.unique(number, return_inverse=True)
        if side <= 2 or len(x) >= pixels * len(occupied):
            return patch, len(occupied)
        side //= 2


def asked_about(
    present: Float64Array, change: Float64Array, information: Float64Array, value: Float64Array | None
) -> tuple[Float64Array, Float64Array]:
    """What pixels ask for where they are no longer linear in the roughness.

    The peak of a highlight falls as ``r^-4`` (GGX, Walter et al. 2007, with alpha = r^2). So pixels that were looked at
    with r0 ask for a change, where the surface has a roughness r > r0, of

        h(r) = r0 / 4 (1 - (r / r0)^-4),

    which is less than ``r - r0``: with r0 = 0.5 surfaces of 0.87 ask for 0.61. A step of Gauss and Newton about a value
    asks for ``value + (change - h) / h'`` with information ``h'^2 F``. Below r0, where lamps and pixels are wider than
    peaks, h is ``r - r0``.

    Args:
        present: roughness r0 with which pixels were looked at [m].
        change: that they ask for [m].
        information: F, 1 / variance of that [m].
        value: present one [m]; None for that of ``present``.
    """
    if value is None:
        return present + change, information
    value = np.minimum(value, np.maximum(present, 1.0))
    ratio = np.maximum(value / present, 1.0)
    slope = ratio**-5
    response = np.where(ratio > 1.0, 0.25 * present * (1.0 - ratio**-4), value - present)
    return value + (change - response) / slope, np.square(slope) * information


def evidence(pixels: PixelMeans, patch: IntArray, count: int) -> Evidence:
    """Evidence of pixels in patches [n], of which there are ``count``, each with an albedo of its own."""
    order = np.argsort(pixels.view, kind="stable")
    views = np.split(order, np.flatnonzero(np.diff(pixels.view[order])) + 1)
    # ---------------------- Instruments ----------------------

    r, d, box = pixels.r, pixels.d, BOX
    derivatives = np.concatenate((r, d), -1)
    sums, around = _box_sums(derivatives, pixels.corner, views, box)
    while np.median(around) < NEIGHBOURS and box < MAX_BOX:
        box = 2 * box - 1
        sums, around = _box_sums(derivatives, pixels.corner, views, box)
    instruments = (sums - derivatives) / np.maximum(around - 1.0, 1.0)[:, None]
    r_instrument, d_instrument = instruments[:, :3], instruments[:, 3:]  # R' and D'
    # ---------------------- Covariance of the channels ----------------------

    pairs = pixels.e[:, _ROWS] * pixels.e[:, _COLUMNS]  # [n, 6]
    sums, around = _box_sums(pairs, pixels.corner, views, box + COVARIANCE_BOX - BOX)
    mean = _matrices(pairs.mean(0, dtype=np.float64))
    mean += (DIAGONAL_RIDGE * np.trace(mean) + 1e-30) * np.eye(3)
    precision = np.linalg.inv(_matrices(sums / around[:, None]) + RIDGE * mean).astype(np.float32)  # W [n, 3, 3]
    by_r = np.einsum("ni,nij->nj", r_instrument, precision)  # R'W [n, 3]
    by_d = d_instrument[:, :, None] * precision  # D'W [n, 3, 3]
    # ---------------------- Albedo of each patch ----------------------

    rd = group_sums(np.asarray(by_r * d, np.float64), patch, count)
    dr, de = (group_sums((by_d @ value[:, :, None])[..., 0], patch, count) for value in (r, pixels.e))
    dd = group_sums(np.asarray(by_d * d[:, None], np.float64).reshape(-1, 9), patch, count).reshape(-1, 3, 3)
    inverse = _inverse(dd, np.asarray(np.linalg.cholesky(mean), np.float64))
    by_albedo = np.einsum("pi,pij->pj", rd, inverse)
    free = r_instrument - by_albedo[patch] * d_instrument
    weighted = np.einsum("ni,nij->nj", free, precision)

    def left(value: FloatArray, product: Float64Array) -> Float64Array:
        """What every pixel adds once the albedo has its part [n]."""
        explained = np.einsum("pij,pj->pi", inverse, product)
        return np.asarray((weighted * (value - explained[patch] * d)).sum(-1), np.float64)

    # ---------------------- Sums over patches ----------------------

    square = (weighted * free).sum(-1).clip(0.0)
    limit = OUTLIER * np.sqrt(square)
    slope, gradient = left(r, dr), left(pixels.e, de).clip(-limit, limit)
    columns = np.stack((slope, gradient, square, np.square(slope), np.square(gradient)), 1)
    totals = group_sums(np.asarray(columns, np.float64), patch, count)
    # An albedo takes from the squares. Where it adds to them, of few pixels or in few colours, it is noise itself.
    sound = totals[:, 2] <= np.bincount(patch, (by_r * r_instrument).sum(-1), count)
    return Evidence(*np.where(sound[:, None], totals, 0.0).T)


def _inverse(dd: Float64Array, root: Float64Array) -> Float64Array:
    """Inverse of ``sum D'W D`` of patches [m, 3, 3], but for noise and with :data:`FLOOR` pixels of brightness 1 more;
    ``root`` is the Cholesky factor of the residual's covariance over all pixels [3, 3].
    """
    white = root.T @ (0.5 * (dd + dd.transpose(0, 2, 1))) @ root
    power, axes = np.linalg.eigh(white)
    axes = root @ axes
    return np.asarray(axes / (power.clip(0.0) + FLOOR)[:, None, :] @ axes.transpose(0, 2, 1))


_ROWS, _COLUMNS = np.triu_indices(3)


def _matrices(triangles: FloatArray | Float64Array) -> Float64Array:
    """Symmetric matrices [..., 3, 3] by their upper triangles [..., 6]."""
    matrices = np.empty((*triangles.shape[:-1], 3, 3))
    matrices[..., _ROWS, _COLUMNS] = matrices[..., _COLUMNS, _ROWS] = triangles
    return matrices


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
