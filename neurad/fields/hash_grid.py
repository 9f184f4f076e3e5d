"""Multiresolution hash encoding (Mueller et al. 2022, "Instant Neural Graphics Primitives").

One table, three implementations that share it: plain torch, vectorised over levels, for any device and for the tests,
and compiled kernels for float32, on the CPU (:mod:`neurad.fields.hash_grid_kernels`) and on a GPU
(:mod:`neurad.fields.hash_grid_warp`).
"""

import math
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from neurad.core.records import FloatArray
from neurad.fields.settings import GridConfig
from neurad.fields.sparse import from_rows
from neurad.runtime.dispatch import use_kernel, use_warp
from neurad.runtime.threads import split

PRIMES = (1, 2654435761, 805459861)
"""Factors of the spatial hash ``(x ^ y * 2654435761 ^ z * 805459861) mod size`` (Mueller et al., Eq. 4)."""
FEATURES = 2
"""Channels of an entry."""
KEY_PRIME = 2654435769
"""Factor of the numbers of surfaces in their keys: 2^32 over the golden ratio, so that low bits differ, too."""


def keys_of(count: int) -> Tensor:
    """Keys [count] of so many surfaces, each of which has entries of its own in hashed levels, int32."""
    keys = (np.arange(count, dtype=np.uint64) * np.uint64(KEY_PRIME)).astype(np.uint32)
    return torch.from_numpy(keys.view(np.int32))


def _bits(key: Tensor | None, count: int) -> npt.NDArray[np.uint32]:
    """Keys [count] as kernels read them; 0 where there are none."""
    return np.zeros(count, np.uint32) if key is None else key.numpy().view(np.uint32)


class HashGrid(nn.Module):
    """Trilinear features of ``levels`` grids whose resolutions grow geometrically.

    A level of at most 2^log2_size vertices has an entry for each (a dense level); finer ones are hashed (Mueller et
    al., Eq. 4), so that vertices share entries.

    Args:
        coarsest: cells along a side of the first grid.
        finest: cells along a side of the last grid.
        log2_size: logarithm of the largest number of entries of a level.
        use_kernels: use the compiled kernels where they apply (float32).
    """

    level_table: Tensor

    def __init__(self, levels: int, coarsest: int, finest: int, log2_size: int = 17, use_kernels: bool = True) -> None:
        super().__init__()
        growth = math.log(finest / coarsest) / max(levels - 1, 1)
        rows = []
        first = 0
        for level in range(levels):
            resolution = math.floor(coarsest * math.exp(level * growth) + 1e-6)
            vertices = (resolution + 1) ** 3
            # Vertex (x, y, z) of a dense level is entry x + y stride + z stride^2; stride 0 marks a hashed level.
            stride = resolution + 1 if vertices <= 1 << log2_size else 0
            entries = vertices if stride else 1 << log2_size
            rows.append((resolution, stride, first, entries))
            first += entries
        self.levels = levels
        self.channels = levels * FEATURES
        self.use_kernels = use_kernels
        self.sizes = tuple(entries for _, _, _, entries in rows)
        self.register_buffer("level_table", torch.tensor(rows), persistent=False)  # [levels, 4], int64
        self.table = nn.Parameter(torch.empty(first, FEATURES).uniform_(-1e-4, 1e-4))

    @classmethod
    def from_config(cls, config: GridConfig) -> Self:
        """A grid of the sizes in ``config``.

        Raises:
            ValueError: ``finest`` is None: it has to be found from the photographs first.
        """
        if config.finest is None:
            raise ValueError("HashGrid: finest is not set; it comes from resolve_finest")
        return cls(config.levels, config.coarsest, config.finest, log2_size=config.log2_size)

    def forward(self, x: Tensor, key: Tensor | None = None) -> Tensor:
        """Features [n, levels * 2]; the table alone gets a gradient.

        Args:
            x: positions [n, 3] in [0, 1]^3.
            key: of the surfaces that they lie on, see :func:`keys_of` [n]; None for 0.

        Raises:
            ValueError: ``x`` requires a gradient, which this encoding does not give.
        """
        if x.requires_grad:
            raise ValueError("HashGrid: positions get no gradient; detach them")
        if use_warp(self.use_kernels, self.table):
            from neurad.fields.hash_grid_warp import Encode  # Warp is optional

            key = x.new_zeros(len(x), dtype=torch.int32) if key is None else key
            features: Tensor = Encode.apply(x, key, self.table, self.level_table, self.sizes)  # type: ignore[no-untyped-call]
            return features
        if self.has_kernel():
            out: Tensor = _Encode.apply(x, key, self.table, self)  # type: ignore[no-untyped-call]
            return out
        return self.reference(x, key)

    def has_kernel(self) -> bool:
        """Whether kernels compiled for the CPU read and train the table."""
        return use_kernel(self.use_kernels, self.table, differentiable=True)

    def encoder(self, x: FloatArray, key: Tensor | None, out: FloatArray) -> Callable[[int, int], None]:
        """A kernel that writes the features at ``x[low:high]`` [n, 3] on surfaces of a ``key`` [n], as :meth:`forward`
        has it, into the first columns of ``out[low:high]``.
        """
        from neurad.fields import hash_grid_kernels as kernels  # imported at first use: numba is slow to load

        arrays = x.reshape(-1), _bits(key, len(x)), self.table.detach().numpy(), self.level_table.numpy(), out
        return lambda low, high: kernels.encode(*arrays, *kernels.corners(), low, high)

    def table_gradient(self, x: FloatArray, key: Tensor | None, gradient: FloatArray) -> Tensor:
        """Sparse gradient of the table, its rows ascending, by a kernel.

        Args:
            x: positions [n, 3].
            key: of the surfaces that they lie on [n]; None for 0.
            gradient: by the features, in the first columns [n or more, levels * 2 or more].
        """
        from neurad.fields import hash_grid_kernels as kernels

        level_table = self.level_table
        arrays = x.reshape(-1), _bits(key, len(x)), gradient, level_table.numpy()

        def work(begin: int, end: int) -> tuple[Tensor, Tensor]:
            touched = int(level_table[begin:end, 3].clamp(max=8 * len(x)).sum())
            rows, values = torch.empty(touched, dtype=torch.int64), torch.empty(touched, 2)
            marks = kernels.marks(int(level_table[begin:end, 3].max()))
            room: tuple[Any, ...] = *marks, *kernels.corners(len(x)), np.empty(8 * kernels.BLOCK, np.float32)
            count = kernels.table_gradient(*arrays, begin, end, rows.numpy(), values.numpy(), *room)
            return rows[:count], values[:count]

        parts = split(work, self.levels, max(1, self.levels * 256 // max(len(x), 1)))
        return from_rows(parts, self.table.shape)

    def reference(self, x: Tensor, key: Tensor | None = None) -> Tensor:
        """Features of :meth:`forward` in plain torch, with a dense gradient."""
        # ---------------------- Cell of each level ----------------------
        resolution, stride, first, entries = (self.level_table[:, i].view(-1, 1, 1, 1) for i in range(4))
        cells = resolution[:, 0, 0].to(x.dtype)  # [l, 1]
        position = x.unsqueeze(1) * cells  # [n, l, 3]
        cell = torch.minimum(position.floor(), cells - 1.0).clamp(min=0.0)
        ends = torch.stack((cell, cell + 1.0), -1).long()  # [n, l, 3, 2]
        cx, cy, cz = ends[:, :, 0, None, None, :], ends[:, :, 1, None, :, None], ends[:, :, 2, :, None, None]
        # ---------------------- Entries of its eight corners ----------------------
        own = 0 if key is None else key.long().view(-1, 1, 1, 1, 1)
        hashed = (cx ^ (cy * PRIMES[1]) ^ (cz * PRIMES[2]) ^ own) & (entries - 1)  # [n, l, 2, 2, 2], by z, y, x
        entry = first + torch.where(stride > 0, cx + stride * (cy + stride * cz), hashed)
        # ---------------------- Trilinear weights ----------------------
        t = (position - cell).unsqueeze(-1)  # [n, l, 3, 1]
        w = torch.cat((1.0 - t, t), -1)  # [n, l, 3, 2]
        weight = w[:, :, 0, None, None, :] * w[:, :, 1, None, :, None] * w[:, :, 2, :, None, None]
        corners = embedding(entry.flatten(2), self.table)  # [n, l, 8, f]
        return (corners * weight.flatten(2).unsqueeze(-1)).sum(2).flatten(1)


class _Encode(torch.autograd.Function):
    """The compiled encoding as one operation whose gradient is sparse."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, key: Tensor | None, table: Tensor, grid: HashGrid) -> Tensor:
        """Features [n, levels * 2]."""
        x = x.detach().float().contiguous()
        ctx.grid, ctx.x, ctx.key = grid, x.numpy(), key
        out = torch.empty(len(x), grid.channels)
        split(grid.encoder(ctx.x, ctx.key, out.numpy()), len(x), 1024)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, None, Tensor, None]:
        """Sparse gradient of the table."""
        return None, None, ctx.grid.table_gradient(ctx.x, ctx.key, gradients[0].contiguous().numpy()), None
