"""Compiled kernels of the hash grid and its optimizer: float32 on the CPU, two features an entry.

A level is a row (resolution, stride, first entry, entries) of ``levels``; see :mod:`neurad.fields.hash_grid`.
All of them give the same result for any number of threads. They are compiled at first use and cached on disk.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import IntArray
from neurad.fields.intrinsics import interpolate, lowest_bit, popcount, prefetch
from neurad.runtime.jit import inlined, kernel

Floats = npt.NDArray[np.float32]
Bits = npt.NDArray[np.uint64]

ONE = np.float32(1)
ZERO = np.float32(0)
STEP = np.uint32(1)
BIT = np.uint64(1)
PRIME_Y = np.uint32(2654435761)
PRIME_Z = np.uint32(805459861)
CACHED = 1 << 17
"""Entries of the largest level that a processor's own cache is expected to hold (1 MiB)."""
BLOCK = 128
"""Points whose entries are prefetched together, in larger levels."""
AHEAD = 24
"""How many rows ahead the optimizer prefetches."""


@kernel
def _cell(p: Any, last: Any) -> Any:
    """Cell of a position in units of cells; inside the grid for any input, NaN included."""
    c = np.floor(p)
    c = c if c < last else last
    return c if c > ZERO else ZERO


@inlined
def _corners(x: Any, y: Any, z: Any, r: Any, stride: Any, mask: Any) -> tuple[Any, ...]:
    """Entries of the eight corners around a position in a level (corner c lies at x = c & 1, y = (c >> 1) & 1,
    z = c >> 2) and the fractions along x, y and z.
    """
    px, py, pz = x * r, y * r, z * r
    cx, cy, cz = _cell(px, r - ONE), _cell(py, r - ONE), _cell(pz, r - ONE)
    fx, fy, fz = px - cx, py - cy, pz - cz
    hashed = stride == 0
    my = PRIME_Y if hashed else stride
    mz = PRIME_Z if hashed else np.uint32(stride * stride)
    x0, y0, z0 = np.uint32(np.int32(cx)), np.uint32(np.int32(cy)) * my, np.uint32(np.int32(cz)) * mz
    x1, y1, z1 = x0 + STEP, y0 + my, z0 + mz
    if hashed:
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        e0, e1, e2, e3 = (x0 ^ a) & mask, (x1 ^ a) & mask, (x0 ^ b) & mask, (x1 ^ b) & mask
        e4, e5, e6, e7 = (x0 ^ c) & mask, (x1 ^ c) & mask, (x0 ^ d) & mask, (x1 ^ d) & mask
    else:
        a, b, c, d = y0 + z0, y1 + z0, y0 + z1, y1 + z1
        e0, e1, e2, e3 = x0 + a, x1 + a, x0 + b, x1 + b
        e4, e5, e6, e7 = x0 + c, x1 + c, x0 + d, x1 + d
    return e0, e1, e2, e3, e4, e5, e6, e7, fx, fy, fz


@kernel
def unit_cube(p: Floats, corner: Floats, scale: Any, shell: Any, out: Floats, low: int, high: int) -> None:
    """Fill ``out[low:high]`` with positions ``p`` [n, 3] in the unit cube that begins at ``corner`` [3]: what lies
    outside is contracted into a ``shell`` along its sides, or clamped for a shell of 0.
    """
    end, double, square = ONE - shell, shell + shell, shell * shell
    for i in range(low, high):
        for k in range(3):
            value = (p[i, k] - corner[k]) * scale
            if value < shell:
                value = square / (double - value)
            elif value > end:
                value = ONE - square / (double - (ONE - value))
            out[i, k] = value  # NaN stays NaN


@kernel
def encode(x: Floats, table: Floats, levels: IntArray, out: Floats, low: int, high: int) -> None:
    """Trilinear features at ``x[low:high]`` [n, 3], in the first ``2 * levels`` columns of ``out[low:high]``.

    Level by level, so that one level's entries stay in the cache. Entries of a level too large for that are
    prefetched a block of points ahead.
    """
    row = np.uint64(4 * out.shape[1])
    entry = np.empty((BLOCK, 8), np.uint32)
    fraction = np.empty((BLOCK, 3), np.float32)
    for level in range(levels.shape[0]):
        base = np.uint64(table.ctypes.data) + np.uint64(8 * levels[level, 2])
        target = np.uint64(out.ctypes.data) + np.uint64(8 * level)
        r, stride, mask = np.float32(levels[level, 0]), np.uint32(levels[level, 1]), np.uint32(levels[level, 3] - 1)
        if levels[level, 3] <= CACHED:
            for i in range(low, high):
                e0, e1, e2, e3, e4, e5, e6, e7, fx, fy, fz = _corners(x[i, 0], x[i, 1], x[i, 2], r, stride, mask)
                interpolate(base, target + row * np.uint64(i), e0, e1, e2, e3, e4, e5, e6, e7, fx, fy, fz)
            continue
        for start in range(low, high, BLOCK):
            size = min(BLOCK, high - start)
            for k in range(size):
                e, f = entry[k], fraction[k]
                e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], f[0], f[1], f[2] = _corners(
                    x[start + k, 0], x[start + k, 1], x[start + k, 2], r, stride, mask
                )
                for c in range(8):
                    prefetch(base + np.uint64(8) * np.uint64(e[c]))
            for k in range(size):
                e, f = entry[k], fraction[k]
                to = target + row * np.uint64(start + k)
                interpolate(base, to, e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], f[0], f[1], f[2])


@kernel
def _list_marked(bits: Bits, words: int, first: int, rows: IntArray, count: int, rank: IntArray) -> int:
    """Append the marked entries, in order, to ``rows`` from ``count`` on; the new count. ``rank[word]`` becomes the
    place of the word's first entry.
    """
    for word in range(words):
        rank[word] = count
        b = bits[word]
        while b != 0:
            rows[count] = first + 64 * word + np.int64(lowest_bit(b))
            count += 1
            b &= b - BIT
    return count


@kernel
def _place(e: int, bits: Bits, rank: IntArray) -> int:
    """Where :func:`_list_marked` put entry ``e``."""
    word = e >> 6
    below = (BIT << np.uint64(e & 63)) - BIT
    return rank[word] + np.int64(popcount(bits[word] & below))  # type: ignore[no-any-return]


@kernel
def table_gradient(
    x: Floats, gradient: Floats, levels: IntArray, begin: int, end: int, rows: IntArray, values: Floats
) -> int:  # fmt: skip
    """Gradient of the table for ``gradient`` [n, levels * 2], levels ``begin`` to ``end``: the number of touched
    entries, which stand in ascending order at the front of ``rows``, with their gradients in ``values`` [k, 2].

    Touched entries are marked in a bit field small enough for the cache and numbered by counting bits, so they come out
    sorted and unique without sorting. Contributions add up in the order of the points: always the same sum.
    """
    n = x.shape[0]
    largest = np.int64(0)
    for level in range(begin, end):
        largest = max(largest, levels[level, 3])
    bits = np.zeros(largest // 64 + 1, np.uint64)
    rank = np.empty(bits.shape[0], np.int64)
    entry = np.empty((n, 8), np.uint32)
    fraction = np.empty((n, 3), np.float32)
    count = np.int64(0)
    for level in range(begin, end):
        # ---------------------- Mark touched entries ----------------------
        r, stride, mask = np.float32(levels[level, 0]), np.uint32(levels[level, 1]), np.uint32(levels[level, 3] - 1)
        for i in range(n):
            e, f = entry[i], fraction[i]
            e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], f[0], f[1], f[2] = _corners(
                x[i, 0], x[i, 1], x[i, 2], r, stride, mask
            )
            for c in range(8):
                bits[e[c] >> 6] |= BIT << np.uint64(e[c] & 63)
        # ---------------------- Number them in ascending order ----------------------
        words = levels[level, 3] // 64 + 1
        before = count
        count = _list_marked(bits, words, levels[level, 2], rows, count, rank)
        # ---------------------- Add up the gradients ----------------------
        values[before:count] = ZERO
        for i in range(n):
            fx, fy, fz = fraction[i, 0], fraction[i, 1], fraction[i, 2]
            g0, g1 = gradient[i, 2 * level], gradient[i, 2 * level + 1]
            for c in range(8):
                wx = fx if c & 1 else ONE - fx
                wy = fy if c & 2 else ONE - fy
                wz = fz if c & 4 else ONE - fz
                w = wx * (wy * wz)
                k = _place(entry[i, c], bits, rank)
                values[k, 0] += w * g0
                values[k, 1] += w * g1
        bits[:words] = 0
    return count


@kernel
def is_ascending(rows: IntArray) -> bool:
    """Whether every row is larger than the one before, so that none occurs twice."""
    ascending = True
    for i in range(1, rows.shape[0]):  # no early exit: this way the loop is vectorised
        ascending &= rows[i - 1] < rows[i]
    return ascending


@kernel
def merge_rows(rows: IntArray, values: Floats, size: int, merged: IntArray, sums: Floats) -> int:
    """Add up the ``values`` [k, c] of equal ``rows`` (below ``size``) in their order: the number of different rows,
    which stand in ascending order at the front of ``merged``, with their sums in ``sums``.
    """
    bits = np.zeros(size // 64 + 1, np.uint64)
    rank = np.empty(bits.shape[0], np.int64)
    for i in range(rows.shape[0]):
        bits[rows[i] >> 6] |= BIT << np.uint64(rows[i] & 63)
    count = _list_marked(bits, bits.shape[0], np.int64(0), merged, np.int64(0), rank)
    sums[:count] = ZERO
    for i in range(rows.shape[0]):
        k = _place(rows[i], bits, rank)
        for j in range(values.shape[1]):
            sums[k, j] += values[i, j]
    return count


@kernel
def adam_rows(
    p: Floats, m: Floats, v: Floats, rows: IntArray, values: Floats, factors: Floats, low: int, high: int
) -> None:  # fmt: skip
    """Adam on the rows ``rows[low:high]`` of ``p`` [e, c] and its moments ``m`` and ``v``; no row may occur twice.

    ``factors`` are lr / (1 - beta1^t), 1 / sqrt(1 - beta2^t), beta1, beta2 and eps.
    """
    rate, inverse_root, beta1, beta2, eps = factors[0], factors[1], factors[2], factors[3], factors[4]
    width = p.shape[1]
    addresses = np.uint64(p.ctypes.data), np.uint64(m.ctypes.data), np.uint64(v.ctypes.data)
    for i in range(low, high):
        soon = np.uint64(4 * width * rows[min(i + AHEAD, high - 1)])
        prefetch(addresses[0] + soon)
        prefetch(addresses[1] + soon)
        prefetch(addresses[2] + soon)
        row = rows[i]
        for j in range(width):
            g = values[i, j]
            mean = m[row, j] + (ONE - beta1) * (g - m[row, j])
            square = beta2 * v[row, j] + (ONE - beta2) * g * g
            m[row, j] = mean
            v[row, j] = square
            p[row, j] -= rate * mean / (np.sqrt(square) * inverse_root + eps)
