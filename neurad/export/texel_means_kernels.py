"""Kernels of :mod:`neurad.export.texel_means`: samples of texels counted, placed in texture space and averaged, and
their means sharpened.

A texel has ``per`` x ``per`` samples, row by row. All release the interpreter lock and run on the calling thread.
"""

import math

import numpy as np

from neurad.core.records import Array, BoolArray
from neurad.export.raster_kernels import IntArray
from neurad.runtime.jit import kernel


@kernel
def count_owned(
    owner: IntArray, distance: Array, count: IntArray, inside: BoolArray
) -> None:  # pragma: no cover - compiled
    """How many samples of each texel have a triangle, and whether all of them lie on one.

    Args:
        owner: the triangle of each sample, -1 for none [n, s].
        distance: of each sample from it, zero on it [n, s].
        count: filled [n].
        inside: filled [n].
    """
    for n in range(len(owner)):
        found, on = 0, True
        for s in range(owner.shape[1]):
            found += owner[n, s] >= 0
            on &= owner[n, s] >= 0 and distance[n, s] <= 0.0
        count[n], inside[n] = found, on


@kernel
def place(
    owner: IntArray, texels: IntArray, begin: IntArray, width: int, per: int, face: IntArray, x: Array, y: Array
) -> None:  # pragma: no cover - compiled
    """Where the samples that have a triangle lie in texture space, texel by texel.

    Args:
        owner: the triangle of each sample, row by row, -1 for none [n, per * per].
        texels: numbers of the texels in row-major order [n].
        begin: where the samples of each texel begin in what is filled [n].
        width: of the texture.
        per: samples along the side of a texel.
        face: filled with their triangles [m].
        x: filled [m].
        y: filled [m].
    """
    for n in range(len(owner)):
        at, row, column = begin[n], texels[n] // width, texels[n] % width
        for s in range(per * per):
            if owner[n, s] >= 0:
                face[at], x[at], y[at] = owner[n, s], column + (s % per + 0.5) / per, row + (s // per + 0.5) / per
                at += 1


@kernel
def averaged(
    owner: IntArray, begin: IntArray, values: Array, per: int, mean: Array, spread: Array, least: Array, most: Array
) -> None:  # pragma: no cover - compiled
    """Means over the samples of texels, and how far these are from a plane through them.

    Args:
        owner: the triangle of each sample, row by row, -1 for none [n, per * per].
        begin: where the values of each texel begin [n].
        values: of the samples that have a triangle, texel by texel [m, c].
        per: samples along the side of a texel.
        mean: filled with means, zero for texels without a sample [n, c].
        spread: filled with the standard deviation from a plane of the value that varies most [n].
        least: lowered to the smallest values [c].
        most: raised to the largest ones [c].
    """
    channels = values.shape[1]
    scale = (1.0 - 1.0 / (per * per)) / 12.0
    for n in range(len(owner)):
        spread[n] = 0.0
        for c in range(channels):
            total, count = 0.0, 0
            for s in range(per * per):
                if owner[n, s] >= 0:
                    value = values[begin[n] + count, c]
                    total += value
                    count += 1
                    least[c], most[c] = min(least[c], value), max(most[c], value)
            middle = total / max(count, 1)
            mean[n, c] = middle
            squares, right, down, at = 0.0, 0.0, 0.0, begin[n]
            for s in range(per * per):
                if owner[n, s] >= 0:
                    off = values[at, c] - middle
                    squares += off * off
                    right += off * ((s % per + 0.5) / per - 0.5)
                    down += off * ((s // per + 0.5) / per - 0.5)
                    at += 1
            variance = squares / max(count, 1)
            if per > 1:
                variance -= (right * right + down * down) / (max(count, 1) ** 2 * scale)
            spread[n] = max(spread[n], math.sqrt(max(variance, 0.0)))


@kernel
def contrast(values: Array, covered: BoolArray, low: int, high: int, out: Array) -> None:  # pragma: no cover - compiled
    """How much texels differ from their four neighbours at most, in any channel.

    Args:
        values: of a texture [h, w, c].
        covered: texels that have one [h, w]; others differ from nothing.
        low: first row to fill.
        high: row behind the last one.
        out: filled [h, w].
    """
    height, width, channels = values.shape
    for j in range(low, high):
        for i in range(width):
            most = 0.0
            if covered[j, i]:
                for k in range(4):
                    y, x = j + (k == 0) - (k == 1), i + (k == 2) - (k == 3)
                    if 0 <= y < height and 0 <= x < width and covered[y, x]:
                        for c in range(channels):
                            most = max(most, abs(values[j, i, c] - values[y, x, c]))
            out[j, i] = most


@kernel
def sharpen(
    values: Array, covered: BoolArray, mask: BoolArray, share: float, least: Array, most: Array,
    low: int, high: int, out: Array,
) -> None:  # fmt: skip # pragma: no cover - compiled
    """Move texels away from their four neighbours, but not beyond a range.

    Args:
        values: of a texture [h, w, c].
        covered: texels that have one [h, w]; from others nothing is moved away.
        mask: texels to move [h, w]; others keep their values.
        share: of the difference to each neighbour, how much to add.
        least: smallest values [c].
        most: largest ones [c].
        low: first row to fill.
        high: row behind the last one.
        out: filled [h, w, c].
    """
    height, width, channels = values.shape
    for j in range(low, high):
        for i in range(width):
            for c in range(channels):
                here = values[j, i, c]
                if mask[j, i]:
                    moved = np.float32(0.0)
                    for k in range(4):
                        y, x = j + (k == 0) - (k == 1), i + (k == 2) - (k == 3)
                        if 0 <= y < height and 0 <= x < width and covered[y, x]:
                            moved += here - values[y, x, c]
                    here = min(max(here + np.float32(share) * moved, least[c]), most[c])
                out[j, i, c] = here
