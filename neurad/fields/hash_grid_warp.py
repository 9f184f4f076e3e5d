"""Kernels of :mod:`neurad.fields.hash_grid` for a GPU, by NVIDIA Warp: two features an entry, float32.

Imported where a tensor on a GPU needs it. A thread serves a point and a level. The table's gradient is dense and adds
up by atomics, in no fixed order, so two runs agree but for rounding.
"""
# mypy: disable-error-code="attr-defined, valid-type, misc, no-untyped-def, no-untyped-call, untyped-decorator"
# No postponed annotations here: Warp reads the argument types when a kernel is declared.

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.runtime.warp import launch

wp.set_module_options({"max_unroll": 1, "enable_backward": False})  # the compiler unrolls; long code compiles slowly

COPIES = 32
"""Copies of the gradient of coarse levels, a power of two: so many points add to as many places instead of one, as
atomics on the same place wait for each other. They are added up at the end."""
MAX_COPIED = 1 << 12
"""Entries of the largest level whose gradient is copied."""

PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))

_ADD = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float2*>(&wp::index(to, row)), make_float2(value[0], value[1]));  // one in place of two
#else
    wp::atomic_add(to, row, value);
#endif
"""


@wp.func_native(_ADD)
def add(to: wp.array(dtype=wp.vec2), row: int, value: wp.vec2):  # noqa: ANN201  Warp reads no None here
    """Add a vector to a row of an array, aligned to 8 bytes, that other threads add to as well."""
    ...


@wp.func
def cell(position: wp.vec3, last: float) -> wp.vec3:
    """Cell of a position in units of cells; inside the grid for any input, NaN included."""
    return wp.vec3(
        wp.max(wp.min(wp.floor(position[0]), last), 0.0),
        wp.max(wp.min(wp.floor(position[1]), last), 0.0),
        wp.max(wp.min(wp.floor(position[2]), last), 0.0),
    )


@wp.func
def entry(corner: int, low: wp.vec3, key: int, stride: wp.uint32, mask: wp.uint32) -> int:
    """Entry of a cell's corner, at x = corner & 1, y = (corner >> 1) & 1, z = corner >> 2, within its level."""
    x = wp.uint32(int(low[0]) + (corner & 1))
    y = wp.uint32(int(low[1]) + ((corner >> 1) & 1))
    z = wp.uint32(int(low[2]) + (corner >> 2))
    if stride > wp.uint32(0):
        return int(x + stride * (y + stride * z))
    return int((x ^ (y * PRIME_Y) ^ (z * PRIME_Z) ^ wp.uint32(key)) & mask)  # products wrap around


@wp.func
def trilinear(corner: int, t: wp.vec3) -> float:
    """Weight of a corner for the fractions ``t`` along x, y and z."""
    wx = wp.where((corner & 1) == 1, t[0], 1.0 - t[0])
    wy = wp.where(((corner >> 1) & 1) == 1, t[1], 1.0 - t[1])
    wz = wp.where((corner >> 2) == 1, t[2], 1.0 - t[2])
    return float(wx * wy * wz)


@wp.kernel
def encode(
    x: wp.array(dtype=wp.vec3),
    key: wp.array(dtype=wp.int32),
    table: wp.array(dtype=wp.vec2),
    levels: wp.array2d(dtype=wp.int64),
    out: wp.array2d(dtype=wp.vec2),
) -> None:
    """Trilinear features ``out`` [n, levels] at ``x`` [n] on surfaces of a ``key`` [n]."""
    i, level = wp.tid()
    r = float(levels[level, 0])
    stride, mask = wp.uint32(levels[level, 1]), wp.uint32(levels[level, 3] - wp.int64(1))
    position = x[i] * r
    low = cell(position, r - 1.0)
    total = wp.vec2(0.0, 0.0)
    for corner in range(8):
        row = int(levels[level, 2]) + entry(corner, low, key[i], stride, mask)
        total += trilinear(corner, position - low) * table[row]
    out[i, level] = total


@wp.kernel
def table_gradient(
    x: wp.array(dtype=wp.vec3),
    key: wp.array(dtype=wp.int32),
    gradient: wp.array2d(dtype=wp.vec2),
    levels: wp.array2d(dtype=wp.int64),
    rows: int,
    copied: int,
    copies: int,
    out: wp.array(dtype=wp.vec2),
) -> None:
    """Add the gradient of the table for ``gradient`` [n, levels] to ``out``, whose first ``rows`` are the table's; then
    come ``copies - 1`` copies of the first ``copied``.
    """
    i, level = wp.tid()
    g = gradient[i, level]
    if g[0] == 0.0 and g[1] == 0.0:  # lanes that a mask has switched off, many of them at one place
        return
    r = float(levels[level, 0])
    stride, mask = wp.uint32(levels[level, 1]), wp.uint32(levels[level, 3] - wp.int64(1))
    first = int(levels[level, 2])
    copy = i & (copies - 1)
    if copy > 0 and first < copied:
        first += rows + (copy - 1) * copied
    position = x[i] * r
    low = cell(position, r - 1.0)
    for corner in range(8):
        add(out, first + entry(corner, low, key[i], stride, mask), trilinear(corner, position - low) * g)


class Encode(torch.autograd.Function):
    """The encoding as one operation whose gradient is dense."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, key: Tensor, table: Tensor, level_table: Tensor, sizes: tuple[int, ...]) -> Tensor:
        """Features [n, levels * 2]; ``sizes`` are the levels' entries, not descending."""
        x = x.detach().float().contiguous()
        ctx.save_for_backward(x, key, level_table)
        ctx.rows, ctx.copied = len(table), sum(size for size in sizes if size <= MAX_COPIED)
        n, levels = len(x), len(level_table)
        out = x.new_empty(n, levels, 2)
        launch(encode, (n, levels), x.device, x, key, table.detach(), level_table, out)
        return out.flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, None, Tensor, None, None]:
        """Gradient of the table."""
        x, key, level_table = ctx.saved_tensors
        n, levels, rows, copied = len(x), len(level_table), ctx.rows, ctx.copied
        gradient = gradients[0].contiguous().view(n, levels, 2)
        out = x.new_zeros(rows + (COPIES - 1) * copied, 2)
        launch(table_gradient, (n, levels), x.device, x, key, gradient, level_table, rows, copied, COPIES, out)
        found, copies = out[:rows], out[rows:].view(COPIES - 1, copied, 2)
        found[:copied] += copies.sum(0)
        return None, None, found, None, None
