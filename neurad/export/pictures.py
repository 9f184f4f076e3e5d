"""Views as several renderers show them, in passes that say how much of a picture is noise."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from neurad.core.records import Float64Array, FloatArray

ERROR = 0.002
"""Standard error of the mean of a view that is rendered for, as a fraction of it."""
SQUARED_ERROR = 0.007
"""Standard error, as a fraction, of the mean squared difference of all views to their photographs: 0.03 dB. That of one
view may be larger by the root of their number."""
CHANGE_ERROR = 0.0012
"""Standard error, as a fraction of that mean squared difference, of what baking changes of it: 0.005 dB, a tenth of
what it may lose."""
PASSES = 8
"""Most passes to get there; an even number."""
WHITE = 1.0
"""Values of a photograph, at the scene's exposure, from here on are white on a screen. They are left out of squared
differences: on the edges of lamps and windows, which are many times as bright, noise and the photograph's own decide
over all else."""
BLOCKS = 1, 4, 16
"""Sides in pixels of the blocks over whose means pictures are compared: more pixels average more of the noise."""
CHUNK = 1 << 14
"""Pixels whose passes are multiplied with each other at once."""

Draw = Callable[[int, int], FloatArray]
"""A picture [h, w, 3] of the view of this number by this seed; or two [h, w, 6], of the folder and of the fields along
the same paths."""
Estimate = tuple[float, float]
"""A figure and its standard error."""


@dataclass
class Pictures:
    """The views as one renderer shows them."""

    mean: list[FloatArray] = field(default_factory=list)
    """Linear [h, w, 3]."""
    error: list[float] = field(default_factory=list)
    """Standard error of the mean of each."""
    squared: list[Estimate | None] = field(default_factory=list)
    """What :func:`squared_difference` says of each; None without a photograph."""
    passes: list[int] = field(default_factory=list)

    def add(self, passes: FloatArray, photo: FloatArray | None) -> None:
        """Add a view: passes [k, h, w, 3] by different seeds and what they are compared with [h, w, 3], linear."""
        self.mean.append(passes.mean(0, dtype=np.float64).astype(np.float32))
        self.error.append(_error_of_mean(passes))
        self.squared.append(None if photo is None else squared_difference(passes, photo))
        self.passes.append(len(passes))


def drawn(
    draw: Callable[[int], FloatArray],
    known: Callable[[FloatArray], bool],
    most: int = PASSES,
    begun: FloatArray | None = None,
) -> FloatArray:
    """Passes of a view [k, h, w, c], by half as many more until enough is known.

    Args:
        draw: the picture [h, w, c] by a seed; see :data:`Draw`.
        known: whether passes are enough.
        most: passes, an even number of them.
        begun: passes that are there already, an even number of them, by the first seeds.
    """
    passes = [] if begun is None else list(begun)
    count = max(len(passes), 2)
    while True:
        passes += [draw(seed) for seed in range(len(passes), count)]
        found = np.stack(passes)
        if count >= most or known(found):
            return found
        count = min(count + 2 * max(count // 4, 1), most)


def is_known(passes: FloatArray, photo: FloatArray | None, views: int) -> bool:
    """Whether passes [k, h, w, 3] tell the mean of one of so many views, and its difference to the photograph."""
    if _error_of_mean(passes) > ERROR * abs(float(passes.mean())):
        return False
    if photo is None:
        return True
    squared, error = squared_difference(passes, photo)
    return bool(error <= SQUARED_ERROR * squared * views**0.5)


def change_is_known(pairs: FloatArray, photo: FloatArray | None, views: int) -> bool:
    """Whether passes of two pictures along the same paths [k, h, w, 6] tell how much farther from the photograph one of
    them is than the other.
    """
    if photo is None:
        return True
    squared, _ = squared_difference(pairs[..., :3], photo)
    return bool(excess(pairs[..., 3:], pairs[..., :3], photo)[1] <= CHANGE_ERROR * squared * views**0.5)


def squared_difference(passes: FloatArray, photo: FloatArray) -> Estimate:
    """Mean squared difference to a photograph [h, w, 3] of what passes [k, h, w, 3], an even number of them, show on
    average, over values below :data:`WHITE`.

    Linear, since a curve turns noise into bias: encoded, veach-ajar at 128 samples is 0.5 dB worse in Mitsuba, whose
    samples spread more, where linear the two agree.
    """
    off = _counting(passes.astype(np.float64) - photo, photo, 1)
    return _summed(off, off, photo)


def excess(theirs: FloatArray, ours: FloatArray, photo: FloatArray, block: int = 1) -> Estimate:
    """By how much the :func:`squared_difference` of some pictures to a photograph exceeds that of others.

    Pictures along the same paths share their noise, and most of it cancels here.

    Args:
        theirs: passes [k, h, w, 3].
        ours: passes [k, h, w, 3]; as many where noise is shared.
        photo: [h, w, 3].
        block: what differences over blocks of this side in pixels make of it, by their means over a block; 1 is all.
    """
    first, second = (_counting(passes.astype(np.float64) - photo, photo, block) for passes in (theirs, ours))
    if len(first) == len(second):
        return _summed(first - second, first + second, photo)  # squares of both differ by their difference times sum
    (a, a_error), (b, b_error) = _summed(first, first, photo), _summed(second, second, photo)
    return a - b, float(np.hypot(a_error, b_error))


def _counting(values: Float64Array, photo: FloatArray, block: int) -> Float64Array:
    """Values [k, h, w, 3] as those of pixels [k, n, 3], zero where the photograph is white; or of blocks, by their sums
    over the root of how many there are: summed squares are then those of as many pixels with the mean of the block.
    """
    counts = photo < WHITE
    off = np.where(counts, values, 0.0)
    if block == 1:
        return off.reshape(len(off), -1, 3)
    height, width = photo.shape[:2]
    rows, columns = np.arange(0, height, block), np.arange(0, width, block)
    total = np.add.reduceat(np.add.reduceat(off, rows, 1), columns, 2)
    values = np.add.reduceat(np.add.reduceat(counts.astype(np.float64), rows, 0), columns, 1)
    scaled: Float64Array = (total / np.sqrt(np.maximum(values, 1.0))).reshape(len(off), -1, 3)
    return scaled


def _summed(first: Float64Array, second: Float64Array, photo: FloatArray) -> Estimate:
    """Products of values [k, n, 3] with others, over the number of values that count.

    Products of different passes, whose noise is independent, have none of it on average. Pixels are independent, so
    variances add up. That of a pixel is its square less what products of four different passes say of the squared
    mean, without bias whatever the noise's distribution; one of fourth powers counts rare bright samples many times.
    With two passes there are no four: a and b have the product's variance in (|a|^2 - |b|^2) / 2, if noise is Gaussian.
    """
    count, values = len(first), max(int((photo < WHITE).sum()), 1)
    total, variance = 0.0, 0.0
    for begin in range(0, first.shape[1], CHUNK):
        gram = _gram(first[:, begin : begin + CHUNK], second[:, begin : begin + CHUNK])
        own = np.einsum("nii->ni", gram)
        pairs = gram - own[:, :, None] * np.eye(count)
        rows = pairs.sum(2)
        summed = rows.sum(1)
        total += float(summed.sum()) / (count * (count - 1))
        if count < 4:
            variance += float((0.25 * (own[:, 0] - own[:, 1]) ** 2).sum())
            continue
        apart = summed**2 - 4.0 * (rows**2).sum(1) + 2.0 * (pairs**2).sum((1, 2))
        fours = count * (count - 1) * (count - 2) * (count - 3)
        variance += float(((summed / (count * (count - 1))) ** 2 - apart / fours).sum())
    return total / values, float(np.sqrt(max(variance, 0.0))) / values


def _gram(first: Float64Array, second: Float64Array) -> Float64Array:
    """Products of every two passes of each pixel [n, k, k], the same in both orders."""
    a, b = (np.ascontiguousarray(values.transpose(1, 0, 2)) for values in (first, second))
    products: Float64Array = a @ b.transpose(0, 2, 1)
    return 0.5 * (products + products.transpose(0, 2, 1))


def _error_of_mean(passes: FloatArray) -> float:
    """Standard error of the mean of a view, from the spread of its pixels' passes [k, h, w, 3]."""
    grey = passes.mean(-1, dtype=np.float64)
    return float(np.sqrt(grey.var(0, ddof=1).sum() / len(grey)) / grey[0].size)
