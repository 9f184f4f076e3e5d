"""The prior's target where light bounces often: the slow mode taken out.

Training with the prior is a fixed-point iteration ``L <- T(E + L)``. In a closed scene of albedo rho its slowest mode,
nearly the solution itself, shrinks by rho a sweep, so it takes ``1 / (1 - rho)`` sweeps; all others are mixed by the
geometry within a few. A coarse correction of one unknown removes it: of all multiples ``s L`` of the field take the one
whose residual has no mean, ``<T E> = s <L - T L>``, and let the target be ``T(E + s L)``. At the fixed point s is 1, so
the solution is the same; a biased s only slows down.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

HORIZON = 200
"""Steps over which averages reach back."""
SMALLEST, LARGEST = 0.1, 1e4
"""Limits of the factor."""


class Level(nn.Module):
    """Estimates the factor ``s`` [3], a number for each colour channel, from what training steps compute anyway.

    ``s = <T E> / (<L> (1 - q))`` with ``q = <T L> / <L>``, the share of light that a bounce keeps. The mean of the
    field is that of the step at hand; ``q`` and ``<T E>`` hardly change and are averaged over many steps. Near q = 1
    the difference is no larger than its standard error, which then takes its place: the factor falls back towards
    plain iteration.

    Args:
        horizon: steps over which the averages reach back.
    """

    kept: Tensor
    variance: Tensor
    direct: Tensor
    count: Tensor

    def __init__(self, horizon: int = HORIZON) -> None:
        super().__init__()
        self.horizon = horizon
        for name in ("kept", "variance", "direct"):
            self.register_buffer(name, torch.zeros(3))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def forward(self, field: Tensor, direct: Tensor, carried: Tensor, mask: Tensor) -> Tensor:
        """Take in a step and return the factor for its ``carried`` [3].

        Args:
            field: ``L_theta`` at the vertices [n, 3].
            direct: samples of ``T E`` there [n, 3].
            carried: samples of ``T L_theta`` there [n, 3].
            mask: lanes that count [n], bool.
        """
        if not bool(mask.any()):
            return torch.ones_like(self.kept)
        mean, light, reflected = (x.detach()[mask].mean(0) for x in (field, direct, carried))
        tiny = torch.finfo(mean.dtype).tiny
        self.count += 1
        w = max(1.0 / int(self.count), 1.0 / self.horizon)
        off = reflected / mean.clamp_min(tiny) - self.kept
        self.variance.copy_((1.0 - w) * (self.variance + w * off * off))
        self.kept += w * off
        self.direct += w * (light - self.direct)
        deviation = (self.variance * (w / (2.0 - w))).sqrt()  # of the running mean
        gap = torch.maximum(1.0 - self.kept, deviation).clamp_min(1e-5)
        factor = (self.direct / (mean * gap).clamp_min(tiny)).clamp(SMALLEST, LARGEST)
        return torch.where(self.direct > 0, factor, 1.0)

    def level(self) -> Tensor:
        """The mean reflected radiance that the averages stand for, ``<T E> / (1 - q)`` [3]."""
        return self.direct / (1.0 - self.kept).clamp_min(1e-5)
