"""Compiled kernels of the dense grid: float32 on the CPU, any number of channels."""

from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import IntArray
from neurad.fields.hash_grid_kernels import BIT, BLOCK, ONE, STEP, ZERO, Bits, Floats, _cell, _place
from neurad.fields.intrinsics import lowest_bit, prefetch
from neurad.runtime.jit import inlined, kernel, subroutine

ENTRIES_PER_WORD = 4096
"""Table entries that one word of the second bit field covers."""


def corners(count: int = BLOCK) -> tuple[npt.NDArray[np.uint32], Floats]:
    """Room for what :func:`_corners` finds of so many positions."""
    return np.empty((count, 8), np.uint32), np.empty((count, 3), np.float32)


@inlined
def _corners(x: Any, y: Any, z: Any, r: Any, stride: Any) -> tuple[Any, ...]:
    """Entries of the eight corners around a position in ``r`` cells along each side (corner c lies at x = c & 1,
    y = (c >> 1) & 1, z = c >> 2) and the fractions along x, y and z.
    """
    px, py, pz = x * r, y * r, z * r
    cx, cy, cz = _cell(px, r - ONE), _cell(py, r - ONE), _cell(pz, r - ONE)
    a = np.uint32(np.int32(cx)) + stride * (np.uint32(np.int32(cy)) + stride * np.uint32(np.int32(cz)))
    b, c = a + stride, a + stride * stride
    d = c + stride
    return a, a + STEP, b, b + STEP, c, c + STEP, d, d + STEP, px - cx, py - cy, pz - cz


@kernel
def encode_dense(
    x: Floats, table: Floats, size: int, out: Floats, entry: Any, fraction: Floats, low: int, high: int
) -> None:
    """Trilinear values ``out[low:high]`` [n, c] at ``x[low:high]`` [n, 3] of ``table`` [size^3, c].

    A table is far larger than a cache, so entries are prefetched a block of points ahead. ``entry`` and ``fraction``
    are :func:`corners` of one block.
    """
    width = table.shape[1]
    base = np.uint64(table.ctypes.data)
    r, stride = np.float32(size - 1), np.uint32(size)
    for start in range(low, high, BLOCK):
        count = min(BLOCK, high - start)
        for k in range(count):
            e, f = entry[k], fraction[k]
            e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], f[0], f[1], f[2] = _corners(
                x[start + k, 0], x[start + k, 1], x[start + k, 2], r, stride
            )
            for c in range(0, 8, 2):  # neighbours along x stand next to each other
                prefetch(base + np.uint64(4 * width) * np.uint64(e[c]))
        for k in range(count):
            fx, fy, fz = fraction[k, 0], fraction[k, 1], fraction[k, 2]
            e = entry[k]
            for j in range(width):
                a = table[e[0], j] + fx * (table[e[1], j] - table[e[0], j])
                b = table[e[2], j] + fx * (table[e[3], j] - table[e[2], j])
                c0 = table[e[4], j] + fx * (table[e[5], j] - table[e[4], j])
                d = table[e[6], j] + fx * (table[e[7], j] - table[e[6], j])
                near, far = a + fy * (b - a), c0 + fy * (d - c0)
                out[start + k, j] = near + fz * (far - near)


@subroutine
def _list_used(bits: Bits, used: Bits, begin: int, end: int, rows: IntArray, rank: IntArray) -> int:
    """Write the entries that ``used[begin:end]`` marks, in order, to ``rows``; their number. ``rank[word]`` becomes the
    place of the word's first entry, in each word that is marked.
    """
    count = 0
    for group in range(begin, end):
        u = used[group]
        while u != 0:
            word = 64 * group + np.int64(lowest_bit(u))
            u &= u - BIT
            rank[word] = count
            b = bits[word]
            while b != 0:
                rows[count] = 64 * word + np.int64(lowest_bit(b))
                count += 1
                b &= b - BIT
    return count


@kernel
def dense_gradient(
    x: Floats, gradient: Floats, size: int, low: int, high: int, lane: IntArray, entry: Any, fraction: Floats,
    bits: Bits, used: Bits, rank: IntArray, rows: IntArray, values: Floats,
) -> int:  # fmt: skip
    """Gradient of the entries ``low .. high - 1`` of the table for ``gradient`` [n, c]: the number of those that are
    touched, which stand in ascending order at the front of ``rows``, with their gradients in ``values`` [k, c].

    Ranges that begin and end at multiples of :data:`ENTRIES_PER_WORD` share no word of the bit fields. As
    :func:`neurad.fields.hash_grid_kernels.table_gradient`: marked in a bit field, numbered by counting bits, no
    sorting. A second bit field marks the words of the first that are in use, since nearly all are empty. Both, ``bits``
    [size^3 / 64 + 1] and ``used`` [words / 64 + 1], are zero before and after. To work in: ``rank`` [words], ``lane``
    [n], and ``entry`` and ``fraction``, :func:`corners` of all positions.
    """
    n, width = gradient.shape
    r, stride = np.float32(size - 1), np.uint32(size)
    # ---------------------- Mark the entries of this range ----------------------
    inside = 0
    for i in range(n):
        e, f = entry[inside], fraction[inside]
        e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], f[0], f[1], f[2] = _corners(
            x[i, 0], x[i, 1], x[i, 2], r, stride
        )
        if e[7] < low or e[0] >= high:
            continue
        lane[inside] = i
        inside += 1
        for c in range(8):
            if low <= e[c] < high:
                word = e[c] >> 6
                bits[word] |= BIT << np.uint64(e[c] & 63)
                used[word >> 6] |= BIT << np.uint64(word & 63)
    # ---------------------- Number them in ascending order ----------------------
    count = _list_used(bits, used, low // ENTRIES_PER_WORD, -(-high // ENTRIES_PER_WORD), rows, rank)
    # ---------------------- Add up the gradients ----------------------
    values[:count] = ZERO
    for i in range(inside):
        fx, fy, fz = fraction[i, 0], fraction[i, 1], fraction[i, 2]
        for c in range(8):
            if not low <= entry[i, c] < high:
                continue
            wx = fx if c & 1 else ONE - fx
            wy = fy if c & 2 else ONE - fy
            wz = fz if c & 4 else ONE - fz
            w = wx * (wy * wz)
            k = _place(entry[i, c], bits, rank)
            for j in range(width):
                values[k, j] += w * gradient[lane[i], j]
    # ---------------------- Clear the marks ----------------------
    for i in range(count):
        bits[rows[i] >> 6] = 0
        used[rows[i] >> 12] = 0
    return count
