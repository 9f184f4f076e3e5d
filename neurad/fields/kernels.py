"""Compiled hash-grid kernels for float32 on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import llvmlite.ir as ir
import numba
import numpy as np
import torch
from numba import types
from numba.extending import intrinsic
from torch import Tensor

if TYPE_CHECKING:
    from neurad.fields.hash_grid import HashGrid

PY = np.uint32(2654435761)
PZ = np.uint32(805459861)
ONE = np.float32(1)


@intrinsic
def popcount(typingctx, x):
    """Number of set bits of a uint64."""

    def codegen(context, builder, signature, args):
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


@intrinsic
def lowest_bit(typingctx, x):
    """Index of the lowest set bit of a uint64 that is not 0."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), codegen


@numba.njit(nogil=True, cache=True)
def _encode(x, table, resolution, stride, first, mask, out, low, high):
    for level in range(resolution.shape[0]):
        r = np.float32(resolution[level])
        s = np.uint32(stride[level])
        my = s if s > 0 else PY
        mz = s * s if s > 0 else PZ
        hashed = s == 0
        t = table[first[level] : first[level + 1]]
        for i in range(low, high):
            px, py, pz = x[i, 0] * r, x[i, 1] * r, x[i, 2] * r
            cx, cy, cz = min(np.floor(px), r - ONE), min(np.floor(py), r - ONE), min(np.floor(pz), r - ONE)
            fx, fy, fz = px - cx, py - cy, pz - cz
            ix, iy, iz = np.uint32(np.int32(cx)), np.uint32(np.int32(cy)) * my, np.uint32(np.int32(cz)) * mz
            a0 = np.float32(0.0)
            a1 = np.float32(0.0)
            for c in range(8):
                jx = ix + np.uint32(c & 1)
                jy = iy + np.uint32((c >> 1) & 1) * my
                jz = iz + np.uint32(c >> 2) * mz
                e = ((jx ^ jy ^ jz) & mask) if hashed else (jx + jy + jz)
                w = (fx if c & 1 else ONE - fx) * ((fy if c & 2 else ONE - fy) * (fz if c & 4 else ONE - fz))
                a0 += w * t[e, 0]
                a1 += w * t[e, 1]
            out[i, 2 * level] = a0
            out[i, 2 * level + 1] = a1


@numba.njit(nogil=True, cache=True)
def _table_gradient(x, gradient, resolution, stride, first, mask, begin, end, rows, values):
    n = x.shape[0]
    bits = np.zeros((int(mask) + 64) // 64 + 1, np.uint64)
    rank = np.empty(bits.shape[0], np.int64)
    entry = np.empty((n, 8), np.uint32)
    count = 0
    one = np.uint64(1)
    for level in range(begin, end):
        r = np.float32(resolution[level])
        s = np.uint32(stride[level])
        my = s if s > 0 else PY
        mz = s * s if s > 0 else PZ
        hashed = s == 0
        for i in range(n):
            cx = np.uint32(np.int32(min(np.floor(x[i, 0] * r), r - ONE)))
            cy = np.uint32(np.int32(min(np.floor(x[i, 1] * r), r - ONE))) * my
            cz = np.uint32(np.int32(min(np.floor(x[i, 2] * r), r - ONE))) * mz
            for c in range(8):
                jx = cx + np.uint32(c & 1)
                jy = cy + np.uint32((c >> 1) & 1) * my
                jz = cz + np.uint32(c >> 2) * mz
                e = ((jx ^ jy ^ jz) & mask) if hashed else (jx + jy + jz)
                entry[i, c] = e
                bits[e >> np.uint32(6)] |= one << np.uint64(e & np.uint32(63))
        size = first[level + 1] - first[level]
        for word in range((size + 63) // 64):
            rank[word] = count
            b = bits[word]
            while b != 0:
                rows[count] = first[level] + 64 * word + np.int64(lowest_bit(b))
                values[count, 0] = 0.0
                values[count, 1] = 0.0
                count += 1
                b &= b - one
        for i in range(n):
            px, py, pz = x[i, 0] * r, x[i, 1] * r, x[i, 2] * r
            fx = px - min(np.floor(px), r - ONE)
            fy = py - min(np.floor(py), r - ONE)
            fz = pz - min(np.floor(pz), r - ONE)
            g0 = gradient[i, 2 * level]
            g1 = gradient[i, 2 * level + 1]
            for c in range(8):
                e = entry[i, c]
                word = e >> np.uint32(6)
                below = (one << np.uint64(e & np.uint32(63))) - one
                k = rank[word] + np.int64(popcount(bits[word] & below))
                w = (fx if c & 1 else ONE - fx) * ((fy if c & 2 else ONE - fy) * (fz if c & 4 else ONE - fz))
                values[k, 0] += w * g0
                values[k, 1] += w * g1
        bits[: (size + 63) // 64] = 0
    return count


@numba.njit(nogil=True, cache=True)
def _adam_rows(p, m, v, rows, values, rate, root, beta1, beta2, eps):
    for i in range(rows.shape[0]):
        row = rows[i]
        for j in range(p.shape[1]):
            g = values[i, j]
            m_ = beta1 * m[row, j] + (ONE - beta1) * g
            v_ = beta2 * v[row, j] + (ONE - beta2) * g * g
            m[row, j] = m_
            v[row, j] = v_
            p[row, j] -= rate * m_ / (np.sqrt(v_) * root + eps)


def encode(x: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
    out = torch.empty(len(x), grid.channels)
    _encode(x.numpy(), table.numpy(), grid.resolution.numpy(), grid.stride.numpy(), grid.first.numpy(), np.uint32(int(grid.mask)), out.numpy(), 0, len(x))
    return out


def table_gradient(x: Tensor, gradient: Tensor, grid: HashGrid) -> Tensor:
    size = min(8 * len(x) * grid.levels, len(grid.table))
    rows = torch.empty(1, size, dtype=torch.int64)
    values = torch.empty(size, 2)
    k = _table_gradient(x.numpy(), gradient.numpy(), grid.resolution.numpy(), grid.stride.numpy(), grid.first.numpy(), np.uint32(int(grid.mask)), 0, grid.levels, rows[0].numpy(), values.numpy())
    return torch.sparse_coo_tensor(rows[:, :k], values[:k], grid.table.shape, check_invariants=False, is_coalesced=True)


def adam_rows(p: Tensor, m: Tensor, v: Tensor, rows: Tensor, values: Tensor, rate: float, root: float, beta1: float, beta2: float, eps: float) -> None:
    f = np.float32
    _adam_rows(p.detach().numpy(), m.numpy(), v.numpy(), rows.numpy(), values.numpy(), f(rate), f(1 / root), f(beta1), f(beta2), f(eps))
