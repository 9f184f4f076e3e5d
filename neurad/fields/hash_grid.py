"""Multiresolution hash encoding (Mueller et al. 2022, "Instant Neural Graphics Primitives").

One table, two implementations that share it: plain torch, vectorised over levels, for any device and for the tests, and
compiled kernels for float32 on the CPU (:mod:`neurad.fields.kernels`).
"""

from __future__ import annotations

import math
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from neurad.fields.settings import GridConfig

PRIMES = (1, 2654435761, 805459861)
"""Factors of the spatial hash ``(x ^ y * 2654435761 ^ z * 805459861) mod size`` (Mueller et al., Eq. 4)."""
MARGIN = 0.01
"""Free space around the scene in the unit cube, as a share of its longest side."""


class UnitCube(nn.Module):
    """Maps scene positions into the unit cube, the longest side filling it: grid cells are cubes in the scene.

    Args:
        bounds: smallest and largest corner of the scene [2, 3].
    """

    low: Tensor
    inverse_side: Tensor

    def __init__(self, bounds: Tensor) -> None:
        super().__init__()
        side = float((bounds[1] - bounds[0]).max()) * (1.0 + 2.0 * MARGIN)
        center = 0.5 * (bounds[0] + bounds[1]).double()
        self.register_buffer("low", (center - 0.5 * side).float(), persistent=False)
        self.register_buffer("inverse_side", torch.tensor(1.0 / max(side, 1e-30)), persistent=False)

    def forward(self, p: Tensor) -> Tensor:
        """Positions [n, 3] in [0, 1]^3, clamped, without gradient."""
        return ((p.detach() - self.low) * self.inverse_side).clamp_(0.0, 1.0)


class HashGrid(nn.Module):
    """Trilinear features of ``levels`` grids whose resolutions grow geometrically.

    A level of at most 2^log2_size vertices has an entry for each; finer ones are hashed and share entries.

    Args:
        levels: number of grids.
        coarsest: cells along a side of the first grid.
        finest: cells along a side of the last grid.
        features: channels of an entry.
        log2_size: logarithm of the largest number of entries of a level.
        fast: use the compiled kernels where they apply (CPU, float32, two features).
    """

    resolution: Tensor
    stride: Tensor
    first: Tensor
    mask: Tensor

    def __init__(
        self, levels: int, coarsest: int, finest: int, features: int = 2, log2_size: int = 17, fast: bool = True
    ) -> None:
        super().__init__()
        growth = (math.log(finest) - math.log(coarsest)) / max(levels - 1, 1)
        resolution = [math.floor(coarsest * math.exp(level * growth) + 1e-6) for level in range(levels)]
        dense = [(r + 1) ** 3 <= 1 << log2_size for r in resolution]
        entries = [(r + 1) ** 3 if d else 1 << log2_size for r, d in zip(resolution, dense, strict=True)]
        self.levels = levels
        self.features = features
        self.channels = levels * features
        self.fast = fast
        # Vertex (x, y, z) of a dense level is entry x + y stride + z stride^2; a hashed level has stride 0.
        table = torch.empty(sum(entries), features).uniform_(-1e-4, 1e-4)
        self.table = nn.Parameter(table)
        first = torch.tensor([0, *entries]).cumsum(0)
        self.register_buffer("resolution", torch.tensor(resolution), persistent=False)
        self.register_buffer(
            "stride", torch.tensor([r + 1 if d else 0 for r, d in zip(resolution, dense, strict=True)]), persistent=False
        )
        self.register_buffer("first", first, persistent=False)
        self.register_buffer("mask", torch.tensor((1 << log2_size) - 1), persistent=False)

    @classmethod
    def from_config(cls, config: GridConfig, fast: bool = True) -> Self:
        """A grid of the sizes in ``config``."""
        return cls(config.levels, config.coarsest, config.finest, config.features, config.log2_size, fast)

    def forward(self, x: Tensor) -> Tensor:
        """Features [n, levels * features] at positions [n, 3] in [0, 1]^3; the table alone gets a gradient.

        Raises:
            ValueError: ``x`` requires a gradient, which this encoding does not give.
        """
        if x.requires_grad:
            raise ValueError("HashGrid: positions get no gradient; detach them")
        if self.fast and self.table.device.type == "cpu" and self.table.dtype == torch.float32 and self.features == 2:
            out: Tensor = _Encode.apply(x, self.table, self)  # type: ignore[no-untyped-call]
            return out
        return self.plain(x)

    def plain(self, x: Tensor) -> Tensor:
        """The same in plain torch, with a dense gradient."""
        resolution = self.resolution.to(x.dtype).view(-1, 1)  # [l, 1]
        position = x.unsqueeze(1) * resolution  # [n, l, 3]
        cell = torch.minimum(position.floor(), resolution - 1.0)
        near, far = cell.long(), cell.long() + 1
        x_, y_, z_ = (torch.stack((near[..., i], far[..., i]), -1) for i in range(3))  # [n, l, 2] each
        x_, y_, z_ = x_[:, :, None, None, :], y_[:, :, None, :, None], z_[:, :, :, None, None]
        stride = self.stride.view(-1, 1, 1, 1)
        hashed = (x_ ^ (y_ * PRIMES[1]) ^ (z_ * PRIMES[2])) & self.mask
        entry = torch.where(stride > 0, x_ + stride * (y_ + stride * z_), hashed) + self.first[:-1].view(-1, 1, 1, 1)
        t = (position - cell).unsqueeze(-1)
        weight = torch.cat((1.0 - t, t), -1)  # [n, l, 3, 2]
        weight = weight[:, :, 2, :, None, None] * weight[:, :, 1, None, :, None] * weight[:, :, 0, None, None, :]
        corners = embedding(entry.flatten(2), self.table)  # [n, l, 8, f]
        return (corners * weight.flatten(2).unsqueeze(-1)).sum(2).flatten(1)


class _Encode(torch.autograd.Function):
    """The kernels of :mod:`neurad.fields.kernels` as one operation whose gradient is sparse."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, table: Tensor, grid: HashGrid) -> Tensor:
        from neurad.fields import kernels

        x = x.float().contiguous()
        ctx.save_for_backward(x)
        ctx.grid = grid
        return kernels.encode(x, table.detach(), grid)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor | None, None]:
        from neurad.fields import kernels

        (x,) = ctx.saved_tensors
        return None, kernels.table_gradient(x, gradients[0].contiguous(), ctx.grid), None
