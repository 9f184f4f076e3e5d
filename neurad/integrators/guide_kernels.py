"""Compiled CPU twins of the lookups in ``guide``: one pass over the lanes, on the calling thread."""

import math
from typing import Any

import numpy as np

from neurad.core.records import BoolArray, FloatArray, IntArray
from neurad.runtime.jit import kernel, subroutine

_BELOW_ONE = np.float32(1.0 - 2.0**-24)
_FOUR_BY_PI = np.float32(4.0 / math.pi)
_INV_PI = np.float32(1.0 / math.pi)
_HALF, _ZERO, _ONE = np.float32(0.5), np.float32(0.0), np.float32(1.0)


@subroutine
def _row(
    p: FloatArray, nx: Any, ny: Any, nz: Any, lowest: FloatArray, scale: Any, sx: int, sy: int, sz: int
) -> Any:  # pragma: no cover - compiled
    """Row of the histogram for a position [3] and a normal on the viewer's side."""
    x = min(max(int((p[0] - lowest[0]) * scale), 0), sx - 1)
    y = min(max(int((p[1] - lowest[1]) * scale), 0), sy - 1)
    z = min(max(int((p[2] - lowest[2]) * scale), 0), sz - 1)
    axis, along = 0, nx
    if abs(ny) > abs(along):
        axis, along = 1, ny
    if abs(nz) > abs(along):
        axis, along = 2, nz
    facing = 2 * axis + (1 if along > _ZERO else 0)
    return ((x * sy + y) * sz + z) * 6 + facing


@kernel
def rows(
    p: FloatArray, n: FloatArray, lowest: FloatArray, inverse_side: float, sx: int, sy: int, sz: int, out: IntArray
) -> None:  # pragma: no cover - compiled
    """Fill ``out`` with rows of the histogram."""
    scale = np.float32(inverse_side)
    for i in range(p.shape[0]):
        out[i] = _row(p[i], n[i, 0], n[i, 1], n[i, 2], lowest, scale, sx, sy, sz)


@kernel
def warp(
    rows: IntArray, u: FloatArray, fraction: FloatArray, cdf: FloatArray, bins: int, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Fill ``out`` [n, 3] with numbers ``u`` [n, 3], the last two of them drawn by the rows' distributions where the
    first lies below ``fraction``, [n] or [1] for one of all lanes.
    """
    last, lanes = bins * bins - 1, fraction.shape[0] - 1
    for i in range(u.shape[0]):
        out[i, 0] = u[i, 0]
        if not u[i, 0] < fraction[min(i, lanes)]:
            out[i, 1], out[i, 2] = u[i, 1], u[i, 2]
            continue
        row, x = rows[i], u[i, 1]
        low, high = 0, last  # the first entry above x
        while low < high:
            middle = (low + high) // 2
            if cdf[row, middle] > x:
                high = middle
            else:
                low = middle + 1
        before = cdf[row, low - 1] if low > 0 else _ZERO
        inside = min(max((x - before) / (cdf[row, low] - before), _ZERO), _BELOW_ONE)
        out[i, 1] = min((np.float32(low // bins) + inside) / np.float32(bins), _BELOW_ONE)
        out[i, 2] = min((np.float32(low % bins) + u[i, 2]) / np.float32(bins), _BELOW_ONE)


@subroutine
def _bin(x: Any, y: Any, bins: int) -> Any:  # pragma: no cover - compiled
    """Bin of a local direction by its two tangential components."""
    radius = np.float32(math.sqrt(x * x + y * y))
    if abs(x) > abs(y):
        a = radius if x > _ZERO else -radius
        b = a * _FOUR_BY_PI * np.float32(math.atan(y / x))
    else:
        b = radius if y > _ZERO else -radius
        a = b * _FOUR_BY_PI * np.float32(math.atan(x / y)) if y != _ZERO else _ZERO
    scale = np.float32(bins)
    column = min(max(int((_HALF * a + _HALF) * scale), 0), bins - 1)
    line = min(max(int((_HALF * b + _HALF) * scale), 0), bins - 1)
    return column * bins + line


@kernel
def add_pdf(
    rows: IntArray, wi: FloatArray, fraction: FloatArray, cdf: FloatArray, bins: int, pdf: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add what a guide adds to the density ``pdf`` [n] of directions ``wi`` [n, 3], where there is one; ``fraction`` as
    in :func:`warp`.
    """
    lanes = fraction.shape[0] - 1
    for i in range(wi.shape[0]):
        if pdf[i] > _ZERO:
            chosen = _bin(wi[i, 0], wi[i, 1], bins)
            before = cdf[rows[i], chosen - 1] if chosen > 0 else _ZERO
            density = (cdf[rows[i], chosen] - before) * np.float32(bins * bins)  # relative to the cosine's
            delta = fraction[min(i, lanes)] * (max(wi[i, 2], _ZERO) * _INV_PI) * (density - _ONE)
            pdf[i] = max(pdf[i] + delta, _ZERO)


@kernel
def bin_samples(
    p: FloatArray, n: FloatArray, wo: FloatArray, valid: BoolArray, wi: FloatArray, light: FloatArray,
    lowest: FloatArray, inverse_side: float, sx: int, sy: int, sz: int, bins: int, places: IntArray, values: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill ``places`` [n] with entries of the histogram, one row after the other, and ``values`` [n, 2] with what is to
    be added there.
    """
    scale, third = np.float32(inverse_side), np.float32(1.0 / 3.0)
    for i in range(wi.shape[0]):
        x, y, z = n[i, 0], n[i, 1], n[i, 2]
        if x * wo[i, 0] + y * wo[i, 1] + z * wo[i, 2] < _ZERO:
            x, y, z = -x, -y, -z
        row = _row(p[i], x, y, z, lowest, scale, sx, sy, sz)
        places[i] = row * bins * bins + _bin(wi[i, 0], wi[i, 1], bins)
        mean = (light[i, 0] + light[i, 1] + light[i, 2]) * third
        known = _ONE if valid[i] and wi[i, 2] > _ZERO else _ZERO
        values[i, 0], values[i, 1] = known, mean * mean * known


@kernel
def record(
    places: IntArray, values: FloatArray, counts: FloatArray, squares: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add ``values`` [n, 2] to entries of ``counts`` and ``squares`` [rows, bins^2]."""
    count = np.uint64(counts.shape[1])
    for i in range(places.shape[0]):
        row, entry = np.uint64(places[i]) // count, np.uint64(places[i]) % count
        counts[row, entry] += values[i, 0]
        squares[row, entry] += values[i, 1]
