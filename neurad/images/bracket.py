"""Several exposures of one view merged: what of each is neither clipped nor lost in noise."""

from collections.abc import Sequence

import numpy as np

from neurad.core.records import Array, BoolArray, Float64Array, FloatArray

FULL_WELL = 20000.0
"""Electrons of a pixel at its largest value: shot noise has the variance of their number."""
READ_NOISE = 6.0
"""Standard deviation in electrons of reading a pixel: between good cameras and telephones."""
NEAR = 0.93
"""Fraction of the ceiling from which on a sample is left out: noise would be cut off on one side there."""
NOTHING_KNOWN = 1e3
"""Standard deviation, over the ceiling, where no sample says anything: a weight of next to nothing."""
_ROUNDS = 3


def merge(
    exposures: Sequence[FloatArray],
    times: Sequence[float],
    ceiling: float = 1.0,
    rounding: Sequence[Array] | None = None,
    usable: Sequence[BoolArray] | None = None,
    clipped: Sequence[BoolArray] | None = None,
    full_well: float = FULL_WELL,
    read_noise: float = READ_NOISE,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Radiance from linear pictures of one view, each sample weighted by one over its variance.

    A sample ``y = radiance * time`` has the variance of shot and read noise, ``y / full_well + (read_noise /
    full_well)^2``, with ``y`` by the present estimate: by the sample itself, those that noise made small would count
    more. Whether a sample is near its ceiling is said by the shorter exposures, and so independent of its own noise;
    where their noise decides it, the mean is up to 0.4 % too large.

    Args:
        exposures: pictures of the same size, values in units of the largest [h, w, c].
        times: their exposures, times in any unit, above 0.
        ceiling: value from which on a sample is clipped.
        rounding: variance of each picture's rounding, in squared units of the largest value; None for none.
        usable: of each picture, samples that say something [h, w, c]; colours that are interpolated from clipped ones
            do not, whatever they are. None for all.
        clipped: of each picture, samples that are clipped below the ceiling [h, w, c]; None for none.
        full_well: as :data:`FULL_WELL`.
        read_noise: as :data:`READ_NOISE`.

    Returns:
        Radiance in units of the largest value over the unit of time [h, w, c], its standard deviation, and where every
        sample is clipped: there the radiance is what the shortest exposure shows, or more, and the standard
        deviation infinite. Where no sample is usable it is that of the shortest exposure, below the ceiling, and the
        standard deviation :data:`NOTHING_KNOWN` ceilings.
    """
    order = np.argsort(times)
    y = np.stack([np.asarray(exposures[i], np.float64) for i in order])  # [n, h, w, c]
    t = np.asarray(times, np.float64)[order].reshape(-1, 1, 1, 1)
    floor = (read_noise / full_well) ** 2 * np.ones_like(y[:1])
    floor = floor + (0.0 if rounding is None else np.stack([np.asarray(rounding[i]) for i in order]))
    useful = np.ones(y.shape, bool) if usable is None else np.stack([np.asarray(usable[i], bool) for i in order])
    full = y >= ceiling
    if clipped is not None:
        full |= np.stack([np.asarray(clipped[i], bool) for i in order])
    free = _free(y, t, ceiling, useful & ~full)
    none = ~np.asarray(free.any(0))
    all_clipped: BoolArray = none & full[0] & useful[0]
    alone = np.minimum(y[0], np.where(all_clipped, ceiling, NEAR * ceiling)) / t[0]
    radiance = np.where(none, alone, _ratio((y * free).sum(0), (t * free).sum(0)))
    weight = np.zeros_like(y)
    for _ in range(_ROUNDS):
        variance = np.maximum(radiance, 0.0) * t / full_well + floor
        weight = np.where(free, t * t / variance, 0.0)
        radiance = np.where(none, radiance, _ratio((weight * y / t).sum(0), weight.sum(0)))
    spread = np.sqrt(_ratio(np.ones_like(radiance), weight.sum(0)))
    spread = np.where(none, np.where(all_clipped, np.inf, NOTHING_KNOWN * ceiling / t[0]), spread)
    return np.maximum(radiance, 0.0).astype(np.float32), spread.astype(np.float32), all_clipped


def _free(y: Float64Array, t: Float64Array, ceiling: float, useful: BoolArray) -> BoolArray:
    """Which of the useful samples count [n, h, w, c], from the shortest exposure to the longest."""
    free = useful.copy()
    free[1:] &= free[:-1]  # what is clipped in a shorter exposure is so in a longer one
    value, time = y[0].copy(), np.full_like(y[0], t[0].item())
    for i in range(1, len(y)):
        free[i] &= value / time * t[i] < NEAR * ceiling
        value += np.where(free[i], y[i], 0.0)
        time += np.where(free[i], t[i], 0.0)
    return np.asarray(free)


def _ratio(a: Float64Array, b: Float64Array) -> Float64Array:
    """``a / b``, and 0 where ``b`` is 0."""
    found: Float64Array = np.divide(a, b, out=np.zeros_like(a), where=b > 0)
    return found
