"""Compiled form of :func:`neurad.integrators.stratified.stratified_samples`."""

import numpy as np

from neurad.core.records import FloatArray, IntArray
from neurad.runtime.jit import kernel

_ONE = np.float32(1.0)


@kernel
def stratified_samples(
    low: int, high: int, random: FloatArray, units: IntArray, mirrored: FloatArray, count: int, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Numbers ``out`` [groups * count, 7] of groups ``low .. high - 1`` from ``random`` [groups, 12]: shifts, then
    choices of affine maps.

    ``units`` are the factors to choose from, ``mirrored`` [count] is van der Corput's sequence.
    """
    maps = count * units.shape[0]
    for g in range(low, high):
        for decision in range(5):
            first = (0, 2, 3, 4, 6)[decision]
            second = (1, -1, -1, 5, -1)[decision]
            choice = min(np.int64(random[g, 7 + decision] * np.float32(maps)), maps - 1)
            order, factor = choice % count, units[choice // count]
            for k in range(count):
                value = random[g, first] + np.float32(order) / np.float32(count)
                out[g * count + k, first] = value - _ONE if value >= _ONE else value
                if second >= 0:
                    value = random[g, second] + mirrored[order]
                    out[g * count + k, second] = value - _ONE if value >= _ONE else value
                order = (order + factor) % count
