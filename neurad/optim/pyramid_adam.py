"""Adam over an image pyramid, for lat-long maps whose texels each see little light."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neurad.optim.eager import EagerOptimizer

COARSEST_SIZE = 4
"""Fewest rows and columns of a level."""
RATE_RATIO = 0.5
"""Learning rate of a level relative to the next coarser one, whose gradients average over more texels: less noise."""
FLOOR = 1.0
"""Floor of the divisor, relative to its root mean square over a level: texels with small gradients take small steps."""


class PyramidAdam(EagerOptimizer):
    """Adam (Kingma and Ba 2015) of a map that is a sum of levels, from a few texels to full size.

    The map itself is the parameter. Its gradient is taken down to every level by the transpose of interpolation,
    each level has moments of its own, and the steps of all levels are interpolated up and added; so the map is the sum
    of the levels without their being kept. Coarse levels find the light within a few steps, although a
    single texel's gradient is mostly noise, and fine ones sharpen it. Detail without a gradient decays, as with
    weight decay: surfaces blur their light, so photographs say little of the fine structure of a map.

    Args:
        params: one map [height * width, c], row by row, or parameter groups of it.
        width: texels in a row of the map; columns wrap around.
        lr: largest change of the map by the coarsest level in a step.
        detail_decay: weight decay of a level's detail, relative to its learning rate: detail that photographs do not
            determine decays, where noise would let it grow. It stays below about ``1 / detail_decay`` a level.
    """

    def __init__(
        self,
        params: Iterable[Any],
        width: int,
        lr: float = 5e-2,
        betas: tuple[float, float] = (0.9, 0.99),
        detail_decay: float = 0.3,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas})
        self.width = width
        self.detail_decay = detail_decay
        self._levels: list[_Level] = []

    def update(self, index: int, group: dict[str, Any], params: list[Tensor]) -> None:
        """Update every map."""
        for p in params:
            self._update(p, group, group["lr"] if p.device.type == "cpu" else self.rates.of(index, p.device))

    def _update(self, p: Tensor, group: dict[str, Any], rate: Any) -> None:
        height = len(p) // self.width
        if not self._levels or self._levels[0].rows.device != p.device:
            self._levels = [_Level.of(rows.to(p), columns.to(p)) for rows, columns in levels(height, self.width)]
        state = self.state[p]
        if not state:
            state["step"] = torch.zeros((), device=p.device)
            for index, level in enumerate(self._levels):
                for name in ("exp_avg", "exp_avg_sq"):
                    state[f"{name}_{index}"] = p.new_zeros(p.shape[1], level.rows.shape[1], level.columns.shape[1])
        state["step"] = state["step"].to(p.device)  # torch leaves that of a checkpoint where it was read
        state["step"] += 1
        count = state["step"].double()
        beta1, beta2 = group["betas"]
        fast, slow = 1.0 - beta1**count, 1.0 - beta2**count
        image, gradient = (x.view(height, self.width, -1).permute(2, 0, 1) for x in (p, p.grad))  # type: ignore[union-attr]
        total = torch.zeros_like(gradient)  # [c, height, width]
        coarser = image
        for index, level in enumerate(self._levels):
            # ---------------------- Adam on this level's gradient ----------------------
            g = level.rows.T @ gradient @ level.columns  # [c, h, w]
            m, v = state[f"exp_avg_{index}"], state[f"exp_avg_sq_{index}"]
            m.lerp_(g, 1.0 - beta1)
            v.mul_(beta2).addcmul_(g, g, value=1.0 - beta2)
            root = (v / slow).sqrt()
            root = root + FLOOR * root.square().mean().sqrt() + torch.finfo(p.dtype).tiny
            total += level.rows @ (m * (rate / fast) / root) @ level.columns.T
            # ---------------------- Decay of the detail above this level ----------------------
            blurred = level.rows @ (level.mean_rows @ image @ level.mean_columns) @ level.columns.T
            if index > 0:
                total += (self.detail_decay * rate) * (blurred - coarser)
            coarser = blurred
            rate = rate * RATE_RATIO
        p -= total.permute(1, 2, 0).reshape(p.shape)


@dataclass(frozen=True)
class _Level:
    """Matrices of a level: interpolation up to the map, and means over the map down to it."""

    rows: Tensor
    columns: Tensor
    mean_rows: Tensor
    mean_columns: Tensor

    @classmethod
    def of(cls, rows: Tensor, columns: Tensor) -> _Level:
        """The level of two interpolation matrices."""
        return cls(rows, columns, (rows / rows.sum(0)).T, columns / columns.sum(0))


def levels(height: int, width: int) -> list[tuple[Tensor, Tensor]]:
    """Interpolation matrices for rows [height, h] and columns [width, w] of every level, the coarsest first.

    Coarse levels are cubic B-splines, as kinks of linear ones would show as lines; the last level is the map's texels.
    """
    sizes = [(height, width)]
    while sizes[-1][0] // 2 >= COARSEST_SIZE and sizes[-1][1] // 2 >= COARSEST_SIZE:
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    coarse = [(_rows(height, h), _columns(width, w)) for h, w in sizes[:0:-1]]
    return [*coarse, (torch.eye(height, dtype=torch.float64), torch.eye(width, dtype=torch.float64))]


def _rows(height: int, h: int) -> Tensor:
    """Interpolation between ``h`` rows that include both poles, as the map's own do [height, h]."""
    at = torch.linspace(0.0, h - 1.0, height, dtype=torch.float64)
    weight = _spline(at[:, None] - torch.arange(h))
    return weight / weight.sum(1, keepdim=True)  # at the poles the spline reaches beyond the map


def _columns(width: int, w: int) -> Tensor:
    """Interpolation between ``w`` columns of a circle [width, w]."""
    at = (torch.arange(width, dtype=torch.float64) + 0.5) * (w / width) - 0.5
    off = at[:, None] - torch.arange(w)
    return sum((_spline(off + turn * w) for turn in (-1, 1)), start=_spline(off))


def _spline(x: Tensor) -> Tensor:
    x = x.abs()
    near, far = 2.0 / 3.0 - x.square() * (1.0 - x / 2.0), (2.0 - x).clamp_min(0.0) ** 3 / 6.0
    return torch.where(x < 1.0, near, far)
