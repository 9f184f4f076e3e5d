"""Which colour of each smooth piece of the surfaces is plain paint: what lies within its own error of it, is it.

Light that is known a little wrong goes into the albedo as clouds, and pixels that were never drawn confirm them, since
they see the same light. But how far the albedo is known the error bars say. In each segment values ``a`` with error
bars ``s`` are a mixture of paint and of texture around it, a spike and a slab (Johnstone and Silverman 2004),

    a ~ pi N(c, s^2) + (1 - pi) N(c, s^2 + tau^2),

whose colour ``c``, fraction ``pi`` and strength ``tau`` have the largest likelihood (expectation maximisation). Error
bars are as wide as one error in ten needs and most are smaller: one scale of at most 1 for all of them, by the same
likelihood, makes them errors of paint. What is shown of a value is its posterior mean, see
:class:`neurad.fields.segments.Segments`: wood and pictures stay.
"""

import numpy as np

from neurad.core.groups import group_sums
from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.fields.segments import PAINT_COLUMNS

ROUNDS = 30
"""Of expectation and maximisation."""
MIN_POINTS = 20
"""Points of a segment of which fewer say nothing of it."""
START = 0.2
"""Standard deviation of textures at first."""
MIN_TEXTURE = 2.0
"""Smallest standard deviation of a texture, in error bars: a smaller one looks as errors do."""
MIN_SCALE = 1e-4
"""Smallest scale of variances, where all points of a colour are equal."""
_FRACTIONS = 1e-3, 1.0 - 1e-3


def find_paint(albedo: FloatArray, std: FloatArray, segment: IntArray, count: int) -> FloatArray:
    """The paint of each segment, as :class:`Segments` keeps it [count, PAINT_COLUMNS]; 0 where points say nothing. By
    the albedo at points of the surfaces [n, 3], its error bars [n, 3] and their segments [n].
    """
    found = np.zeros((count, PAINT_COLUMNS), np.float32)
    points = np.bincount(segment, minlength=count)
    rows = np.flatnonzero(points >= MIN_POINTS)
    if len(rows) == 0:
        return found
    of_row = np.full(count, -1)
    of_row[rows] = np.arange(len(rows))
    used = of_row[segment] >= 0
    a, row, points = albedo[used].astype(np.float64), of_row[segment[used]], points[rows]
    bar2 = np.square(std[used].astype(np.float64)).mean(1)  # [n]
    typical, scale = np.bincount(row, bar2) / points, 1.0
    center, pi, tau2 = _medians(a, row, points), np.full(len(rows), 0.5), np.full(len(rows), START**2)
    for _ in range(ROUNDS):
        # ---------------------- Chance that a point is paint ----------------------
        s2, away = scale * bar2, np.square(a - center[row]).mean(1)
        ratio = 1.0 + tau2[row] / s2
        odds = np.log((1.0 - pi) / pi)[row] + 0.5 * (away / s2 * (1.0 - 1.0 / ratio) - np.log(ratio))
        p = 1.0 / (1.0 + np.exp(np.clip(odds, -50.0, 50.0)))
        # ---------------------- Colour, scale, fraction and strength ----------------------
        chance, weight = np.bincount(row, p), p / bar2
        pi = np.clip(chance / points, *_FRACTIONS)
        center = group_sums(weight[:, None] * a, row, len(rows)) / np.maximum(np.bincount(row, weight), 1e-9)[:, None]
        away = np.square(a - center[row]).mean(1)
        scale = np.clip((weight * away).sum() / max(p.sum(), 1e-9), MIN_SCALE, 1.0)
        texture = np.bincount(row, (1.0 - p) * away) / np.maximum(points - chance, 1e-9) - scale * typical
        tau2 = np.maximum(texture, MIN_TEXTURE**2 * scale * typical)
    found[rows] = np.concatenate((center, (scale * typical)[:, None], pi[:, None], tau2[:, None]), 1)
    return found


def _medians(values: Float64Array, row: IntArray, points: IntArray) -> Float64Array:
    """Medians of columns over the points of each row, the lower of two."""
    at = np.cumsum(points) - points + (points - 1) // 2
    return np.stack([column[np.lexsort((column, row))][at] for column in values.T], 1)
