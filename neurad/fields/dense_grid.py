"""A dense grid whose vertices are the field's values: the baseline that hash grid and network are compared with.

At 256^3 vertices a table of three channels takes 201 MB in float32, and 604 MB with the two moments of Adam; albedo,
roughness and radiance together 1.41 GB (a checkpoint as much), of which only the vertices next to surfaces are ever
read. 128^3 takes an eighth.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from neurad.fields.sparse import from_rows
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import cut, split, threads

SLAB = 2048
"""Smallest number of positions whose gradient gets a thread of its own."""


class DenseGrid(nn.Module):
    """Trilinear interpolation between ``size^3`` vertices of the unit cube, each with its own values.

    Values start at 0. They are what a field's output activation reads (sigmoid or softplus), so they are unbounded and
    the field stays in its range without clamping.

    Args:
        size: vertices along a side, at least 2.
        channels: values of a vertex.
        use_kernels: use the compiled kernels where they apply (CPU, float32), whose gradient is sparse.
    """

    def __init__(self, size: int, channels: int, use_kernels: bool = True) -> None:
        super().__init__()
        self.size = size
        self.channels = channels
        self.use_kernels = use_kernels
        self._marks: tuple[Any, ...] = ()
        self.table = nn.Parameter(torch.zeros(size**3, channels))  # vertex (x, y, z) is row x + size (y + size z)

    def forward(self, x: Tensor) -> Tensor:
        """Values [n, channels] at positions [n, 3] in [0, 1]^3; the table alone gets a gradient.

        Raises:
            ValueError: ``x`` requires a gradient, which this encoding does not give.
        """
        if x.requires_grad:
            raise ValueError("DenseGrid: positions get no gradient; detach them")
        if use_kernel(self.use_kernels, self.table, differentiable=True):
            out: Tensor = _Read.apply(x, self.table, self)  # type: ignore[no-untyped-call]
            return out
        return self.reference(x)

    def marks(self) -> tuple[Any, ...]:
        """Bit fields that mark the vertices touched by a backward pass; kept, as allocating costs more than marking."""
        if not self._marks:
            words = self.size**3 // 64 + 1
            self._marks = np.zeros(words, np.uint64), np.zeros(words // 64 + 1, np.uint64), np.empty(words, np.int64)
        return self._marks

    def reference(self, x: Tensor) -> Tensor:
        """Values of :meth:`forward` in plain torch, with a dense gradient."""
        position = x * float(self.size - 1)  # [n, 3]
        cell = position.floor().clamp(0.0, self.size - 2.0)
        ends = torch.stack((cell, cell + 1.0), -1).long()  # [n, 3, 2]
        entry = ends[:, 0, None, None, :] + self.size * (
            ends[:, 1, None, :, None] + self.size * ends[:, 2, :, None, None]
        )
        t = (position - cell).unsqueeze(-1)
        w = torch.cat((1.0 - t, t), -1)  # [n, 3, 2]
        weight = w[:, 0, None, None, :] * w[:, 1, None, :, None] * w[:, 2, :, None, None]
        corners = embedding(entry.flatten(1), self.table)  # [n, 8, c]
        return (corners * weight.flatten(1).unsqueeze(-1)).sum(1)


class _Read(torch.autograd.Function):
    """The compiled interpolation as one operation whose gradient is sparse."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, table: Tensor, grid: DenseGrid) -> Tensor:
        """Values [n, c]."""
        from neurad.fields import dense_grid_kernels as kernels  # imported at first use: numba is slow to load

        x = x.detach().float().contiguous()
        ctx.save_for_backward(x)
        ctx.grid, ctx.shape = grid, table.shape
        out = torch.empty(len(x), table.shape[1])
        arrays = x.numpy(), table.detach().numpy(), grid.size, out.numpy()
        split(lambda *ends: kernels.encode_dense(*arrays, *kernels.corners(), *ends), len(x), 1024)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None]:
        """Sparse gradient of the table, its rows ascending."""
        from neurad.fields import dense_grid_kernels as kernels

        (x,) = ctx.saved_tensors
        arrays = x.numpy(), gradients[0].contiguous().numpy(), ctx.grid.size
        edges = _slabs(x, ctx.grid.size, threads(len(x), SLAB), kernels.ENTRIES_PER_WORD)
        marks = ctx.grid.marks()

        def slab(low: int, high: int) -> tuple[Tensor, Tensor]:
            touched = min(8 * len(x), high - low)
            rows, values = torch.empty(touched, dtype=torch.int64), torch.empty(touched, ctx.shape[1])
            written = *marks, rows.numpy(), values.numpy()
            room = np.empty(len(x), np.int64), *kernels.corners(len(x))
            count = kernels.dense_gradient(*arrays, low, high, *room, *written)
            return rows[:count], values[:count]

        slabs = list(pairwise(edges))
        parts = split(lambda begin, end: [slab(*ends) for ends in slabs[begin:end]], len(slabs), 1)
        return None, from_rows([found for part in parts for found in part], ctx.shape), None


def _slabs(x: Tensor, size: int, count: int, whole: int) -> list[int]:
    """Entries at which ``count`` ranges of the table begin, and the end; multiples of ``whole`` in between. They hold
    about as many of the positions ``x`` as the ranges of :func:`neurad.runtime.threads.cut`.
    """
    if count == 1:
        return [0, size**3]
    # A few hundred positions place the cuts well enough; NaN may fall anywhere.
    stride = max(1, len(x) // 256)
    some = np.nan_to_num(x[::stride, 2].numpy())
    places = [edge // stride for edge in cut(len(x), count, SLAB)[1:-1]]
    heights = np.partition(some, places)[places].clip(0.0, 1.0)
    cuts = [int(z * (size - 1)) * size * size // whole * whole for z in heights]
    return [0, *cuts, size**3]
