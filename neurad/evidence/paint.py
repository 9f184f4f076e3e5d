"""Which colour of each smooth piece of the surfaces is plain paint: what lies within its own error of it, is it.

Light that is known a little wrong goes into the albedo as clouds, and pixels that were never drawn confirm them, since
they see the same light. But how far the albedo is known the error bars say. In each segment values ``a`` with error
bars ``s`` are a mixture of paint and of texture around it, a spike and a slab (Johnstone and Silverman 2004),

    a ~ pi N(c, s^2) + (1 - pi) N(c, s^2 + tau^2),

whose colour ``c``, fraction ``pi`` and strength ``tau`` have the largest likelihood (expectation maximisation). ``s``
is the lower quartile of a segment's error bars: they are wide where there is texture that no pixel resolves, and clouds
do not ask for texture. What is shown of a value is its posterior mean, see :class:`neurad.fields.segments.Segments`:
wood and pictures stay.
"""

import numpy as np

from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.fields.segments import PAINT_COLUMNS

ROUNDS = 30
"""Of expectation and maximisation."""
MIN_POINTS = 20
"""Points of a segment of which fewer say nothing of it."""
SUREST = 0.25
"""Quantile of a segment's error bars that is the error of its paint."""
START = 0.2
"""Standard deviation of textures at first."""
MIN_TEXTURE = 2.0
"""Smallest standard deviation of a texture, in error bars: a smaller one looks as errors do."""
_FRACTIONS = 1e-3, 1.0 - 1e-3


def find_paint(albedo: FloatArray, std: FloatArray, segment: IntArray, count: int) -> FloatArray:
    """The paint of each segment, as :class:`Segments` keeps it [count, PAINT_COLUMNS]; 0 where points say nothing.

    Args:
        albedo: at points of the surfaces [n, 3].
        std: its error bars [n, 3].
        segment: of each point [n].
        count: of the segments.
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
    s2 = np.square(_quantiles(std[used].astype(np.float64), row, points, SUREST))  # [m, 3]
    mean = s2.mean(1)  # [m]
    center, pi, tau2 = _quantiles(a, row, points, 0.5), np.full(len(rows), 0.5), np.full(len(rows), START**2)
    for _ in range(ROUNDS):
        # ---------------------- Chance that a point is paint ----------------------
        away = np.square(a - center[row])
        q, ratio = (away / s2[row]).mean(1), 1.0 + tau2 / mean
        log = np.log(ratio)[row] - q * (1.0 - 1.0 / ratio)[row]
        p = 1.0 / (1.0 + np.exp(np.clip(-0.5 * log, -50.0, 50.0)) * ((1.0 - pi) / pi)[row])
        # ---------------------- Colour, fraction and strength ----------------------
        chance = np.bincount(row, p)
        pi = np.clip(chance / points, *_FRACTIONS)
        center = _sums(p[:, None] * a, row) / np.maximum(chance, 1e-9)[:, None]
        texture = np.bincount(row, (1.0 - p) * away.mean(1)) / np.maximum(points - chance, 1e-9) - mean
        tau2 = np.maximum(texture, MIN_TEXTURE**2 * mean)
    found[rows] = np.concatenate((center, s2, pi[:, None], tau2[:, None]), 1)
    return found


def _sums(values: Float64Array, row: IntArray) -> Float64Array:
    """Sums of columns over the points of each row."""
    return np.stack([np.bincount(row, column) for column in values.T], 1)


def _quantiles(values: Float64Array, row: IntArray, points: IntArray, fraction: float) -> Float64Array:
    """Quantiles of columns over the points of each row, the lower of two."""
    at = np.cumsum(points) - points + (fraction * (points - 1)).astype(np.int64)
    return np.stack([column[np.lexsort((column, row))][at] for column in values.T], 1)
