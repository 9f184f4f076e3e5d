"""Compiled kernels of the hash grid and its optimizer: float32 on the CPU, two features an entry.

A level is a row (resolution, stride, first entry, entries) of ``levels``; see :mod:`neurad.fields.hash_grid`.
All of them give the same result for any number of threads. They are compiled at first use and cached on disk.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import IntArray
from neurad.fields.intrinsics import interpolate, lowest_bit, popcount, prefetch
from neurad.runtime.jit import inlined, kernel, subroutine

Floats = npt.NDArray[np.float32]
Bits = npt.NDArray[np.uint64]

ONE = np.float32(1)
ZERO = np.float32(0)
STEP = np.uint32(1)
BIT = np.uint64(1)
SIX, LOW_SIX = np.uint32(6), np.uint32(63)
PRIME_Y = np.uint32(2654435761)
PRIME_Z = np.uint32(805459861)
CACHED = 1 << 17
"""Entries of the largest level that a processor's own cache is expected to hold (1 MiB)."""
BLOCK = 128
"""Points whose entries are found together, and in larger levels prefetched."""
_ONE, _TWO, _THREE = np.uint64(1), np.uint64(2), np.uint64(3)
_B1, _B2, _B3, _B4, _B5, _B6, _B7 = (np.uint64(c * BLOCK) for c in range(1, 8))
AHEAD = 24
"""How many rows ahead the optimizer prefetches."""


@subroutine
def _cell(p: Any, last: Any) -> Any:
    """Cell of a position in units of cells; inside the grid for any input, NaN included."""
    c = np.floor(p)
    c = c if c < last else last
    return c if c > ZERO else ZERO


def corners(count: int = BLOCK) -> tuple[npt.NDArray[np.uint32], Floats]:
    """Room for what :func:`_corners` finds of so many positions."""
    blocks = -(-count // BLOCK)
    return np.empty(8 * BLOCK * blocks, np.uint32), np.empty(3 * BLOCK * blocks, np.float32)


def marks(entries: int) -> tuple[Bits, IntArray]:
    """A bit for each of so many entries, none set, and room for the place of each word's first."""
    words = entries // 64 + 1
    return np.zeros(words, np.uint64), np.empty(words, np.int64)


@inlined
def _corners(
    x: Floats, key: Any, start: int, size: int, r: Any, stride: Any, mask: Any, entry: Any, entry_at: int,
    fraction: Floats, fraction_at: int,
) -> None:  # fmt: skip
    """Entries in a level of the eight corners around at most ``BLOCK`` positions ``start .. start + size - 1`` of ``x``
    [3 n] on surfaces of a ``key`` [n], and the fractions between them along x, y and z.

    Corner c lies at x = c & 1, y = (c >> 1) & 1, z = c >> 2. Of position k it is put to ``entry[entry_at + c BLOCK +
    k]``, and the fraction along axis a to ``fraction[fraction_at + a BLOCK + k]``: the compiler takes sixteen positions
    at once as long as arrays are flat and indices have no sign.
    """
    last, mz = r - ONE, np.uint32(stride * stride)
    e, f = np.uint64(entry_at), np.uint64(fraction_at)
    for j in range(size):
        k = np.uint64(j)
        i = _THREE * (np.uint64(start) + k)
        px, py, pz = x[i] * r, x[i + _ONE] * r, x[i + _TWO] * r
        cx, cy, cz = _cell(px, last), _cell(py, last), _cell(pz, last)
        fraction[f + k], fraction[f + k + _B1], fraction[f + k + _B2] = px - cx, py - cy, pz - cz
        x0, y0, z0 = np.uint32(np.int32(cx)), np.uint32(np.int32(cy)), np.uint32(np.int32(cz))
        if stride == 0:
            y0, z0, x1 = y0 * PRIME_Y, z0 * PRIME_Z, x0 + STEP
            y1, z1 = y0 + PRIME_Y, z0 + PRIME_Z
            own = key[np.uint64(start) + k]
            y0, y1 = y0 ^ own, y1 ^ own
            a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
            entry[e + k], entry[e + k + _B1] = (x0 ^ a) & mask, (x1 ^ a) & mask
            entry[e + k + _B2], entry[e + k + _B3] = (x0 ^ b) & mask, (x1 ^ b) & mask
            entry[e + k + _B4], entry[e + k + _B5] = (x0 ^ c) & mask, (x1 ^ c) & mask
            entry[e + k + _B6], entry[e + k + _B7] = (x0 ^ d) & mask, (x1 ^ d) & mask
        else:
            a = x0 + y0 * stride + z0 * mz
            b, c, d = a + stride, a + mz, a + mz + stride
            entry[e + k], entry[e + k + _B1] = a, a + STEP
            entry[e + k + _B2], entry[e + k + _B3] = b, b + STEP
            entry[e + k + _B4], entry[e + k + _B5] = c, c + STEP
            entry[e + k + _B6], entry[e + k + _B7] = d, d + STEP


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
def encode(
    x: Floats, key: Any, table: Floats, levels: IntArray, out: Floats, entry: Any, fraction: Floats, low: int, high: int
) -> None:
    """Trilinear features at positions ``low .. high - 1`` of ``x`` [3 n] on surfaces of a ``key`` [n], in the first
    ``2 * levels`` columns of ``out[low:high]``.

    Level by level, so that one level's entries stay in the cache. Entries of a level too large for that are
    prefetched a block of points ahead. ``entry`` and ``fraction`` are :func:`corners` of one block.
    """
    row = np.uint64(4 * out.shape[1])
    for level in range(levels.shape[0]):
        base = np.uint64(table.ctypes.data) + np.uint64(8 * levels[level, 2])
        target = np.uint64(out.ctypes.data) + np.uint64(8 * level)
        r, stride, mask = np.float32(levels[level, 0]), np.uint32(levels[level, 1]), np.uint32(levels[level, 3] - 1)
        for start in range(low, high, BLOCK):
            size = min(BLOCK, high - start)
            _corners(x, key, start, size, r, stride, mask, entry, 0, fraction, 0)
            if levels[level, 3] > CACHED:
                for c in range(8):
                    for j in range(size):
                        prefetch(base + np.uint64(8) * np.uint64(entry[c * BLOCK + j]))
            for j in range(size):
                k = np.uint64(j)
                interpolate(
                    base, target + row * np.uint64(start + j),
                    entry[k], entry[k + _B1], entry[k + _B2], entry[k + _B3],
                    entry[k + _B4], entry[k + _B5], entry[k + _B6], entry[k + _B7],
                    fraction[k], fraction[k + _B1], fraction[k + _B2],
                )  # fmt: skip


@subroutine
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


@subroutine
def _place(e: int, bits: Bits, rank: IntArray) -> int:
    """Where :func:`_list_marked` put entry ``e``."""
    word = np.uint64(e >> SIX)
    below = (BIT << np.uint64(e & LOW_SIX)) - BIT
    return rank[word] + np.int64(popcount(bits[word] & below))  # type: ignore[no-any-return]


@kernel
def table_gradient(
    x: Floats, key: Any, gradient: Floats, levels: IntArray, begin: int, end: int, rows: IntArray, values: Floats,
    bits: Bits, rank: IntArray, entry: Any, fraction: Floats, weight: Floats,
) -> int:  # fmt: skip
    """Gradient of the table at positions ``x`` [3 n] on surfaces of a ``key`` [n] for ``gradient`` [n, levels * 2],
    levels ``begin`` to ``end``: the number of touched entries, which stand in ascending order at the front of ``rows``,
    with their gradients in ``values`` [k, 2].

    Touched entries are marked in a bit field small enough for the cache and numbered by counting bits, so they come out
    sorted and unique without sorting. Contributions add up in the order of the points: always the same sum.

    ``bits`` and ``rank`` are :func:`marks` of the largest level, ``entry`` and ``fraction`` :func:`corners` of all
    positions, ``weight`` has room for eight numbers of a block.
    """
    n = x.shape[0] // 3
    count: Any = np.int64(0)
    for level in range(begin, end):
        # ---------------------- Mark touched entries ----------------------
        r, stride, mask = np.float32(levels[level, 0]), np.uint32(levels[level, 1]), np.uint32(levels[level, 3] - 1)
        for start in range(0, n, BLOCK):
            size = min(BLOCK, n - start)
            _corners(x, key, start, size, r, stride, mask, entry, 8 * start, fraction, 3 * start)
            for j in range(size):
                for c in range(8):
                    e = entry[np.uint64(8 * start + c * BLOCK + j)]
                    bits[np.uint64(e >> SIX)] |= BIT << np.uint64(e & LOW_SIX)
        # ---------------------- Number them in ascending order ----------------------
        words = levels[level, 3] // 64 + 1
        before = count
        count = _list_marked(bits, words, levels[level, 2], rows, count, rank)
        # ---------------------- Add up the gradients ----------------------
        values[before:count] = ZERO
        for start in range(0, n, BLOCK):
            size, at, ft = min(BLOCK, n - start), np.uint64(8 * start), np.uint64(3 * start)
            for j in range(size):
                k = np.uint64(j)
                fx, fy, fz = fraction[ft + k], fraction[ft + k + _B1], fraction[ft + k + _B2]
                gx, gy, gz = ONE - fx, ONE - fy, ONE - fz
                weight[k], weight[k + _B1] = gx * (gy * gz), fx * (gy * gz)
                weight[k + _B2], weight[k + _B3] = gx * (fy * gz), fx * (fy * gz)
                weight[k + _B4], weight[k + _B5] = gx * (gy * fz), fx * (gy * fz)
                weight[k + _B6], weight[k + _B7] = gx * (fy * fz), fx * (fy * fz)
            for j in range(size):
                g0, g1 = gradient[start + j, 2 * level], gradient[start + j, 2 * level + 1]
                for c in range(8):
                    corner = np.uint64(c * BLOCK + j)
                    w, k = weight[corner], np.uint64(_place(entry[at + corner], bits, rank))
                    values[k, 0] += w * g0
                    values[k, 1] += w * g1
        bits[:words] = 0
    return count  # type: ignore[no-any-return]


@kernel
def is_ascending(rows: IntArray) -> bool:
    """Whether every row is larger than the one before, so that none occurs twice."""
    ascending = True
    for i in range(1, rows.shape[0]):  # no early exit: this way the loop is vectorised
        ascending &= rows[i - 1] < rows[i]
    return ascending


@kernel
def merge_rows(rows: IntArray, values: Floats, merged: IntArray, sums: Floats, bits: Bits, rank: IntArray) -> int:
    """Add up the ``values`` [k, c] of equal ``rows`` in their order: the number of different rows, which stand in
    ascending order at the front of ``merged``, with their sums in ``sums``. ``bits`` and ``rank`` are :func:`marks` of
    all entries.
    """
    for i in range(rows.shape[0]):
        bits[rows[i] >> 6] |= BIT << np.uint64(rows[i] & 63)
    zero: Any = np.int64(0)  # a literal would have a version of its own compiled
    count = _list_marked(bits, bits.shape[0], zero, merged, zero, rank)
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
