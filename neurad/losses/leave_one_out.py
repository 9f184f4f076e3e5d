"""Relative L2 with an unbiased gradient in one pass: each group of a pixel's samples against the mean of the others.
Of photographs at their ceiling the target is a lower bound, and only a render below it is wrong.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.losses import leave_one_out_kernels as kernels
from neurad.losses.relative import Loss, weighted
from neurad.runtime.dispatch import use_kernel, use_warp
from neurad.runtime.threads import GRAIN, split


@dataclass(frozen=True)
class ControlVariate:
    """A control variate for samples of independent groups: ``deviation`` has mean zero whatever light there is."""

    Li: Tensor
    """Incident radiance that each sample found, without gradient [b, n, c]."""
    deviation: Tensor
    """Weight of each sample less the weight's mean, with the same gradient as the samples' [b, n, c]."""
    groups: int
    """Independent groups of as many samples each, at least 2; ``n`` of them where all samples are independent."""

    def baseline(self) -> Tensor:
        """Incident radiance at each sample by the other groups of its pixel [b, n, c]."""
        light = grouped(self.Li, self.groups)
        others = (light.sum(1, keepdim=True) - light) / (self.groups - 1)
        return others.repeat_interleave(self.Li.shape[1] // self.groups, 1)

    def residual(self) -> Tensor:
        """Excess of each sample if the light of the other groups came from everywhere [b, n, c]; its mean is 0."""
        return self.baseline() * self.deviation

    def residual_of_others(self) -> Tensor:
        """Mean over all groups but i of their :meth:`residual` by the light of all but i [b, groups, c], detached.

        Nothing of group i is in it, so a residual less it stays independent of group i. Zero for two groups.
        """
        n = self.groups
        light, z = grouped(self.Li, n), grouped(self.deviation.detach(), n)
        if n < 3:
            return torch.zeros_like(z)
        both = light * z
        light, z, both = (x.sum(1, keepdim=True) - x for x in (light, z, both))
        return (light * z - both) / ((n - 1) * (n - 2))


def grouped(samples: Tensor, groups: int) -> Tensor:
    """Means over groups of neighbouring samples: [b, n, c] -> [b, groups, c]."""
    count = samples.shape[1]
    return samples if count == groups else samples.reshape(len(samples), groups, count // groups, -1).mean(2)


def leave_one_out(
    samples: Tensor,
    target: Tensor,
    weight: Tensor,
    control: ControlVariate | None = None,
    groups: int | None = None,
    use_kernels: bool = True,
    chroma: float = 1.0,
) -> Loss:
    """Relative L2 (paper Eq. 5) of a pixel mean from n >= 2 independent groups of samples, in one pass.

    With ``s_i`` the mean of a group, the gradient is ``(2/n) sum_i W (mean_{j != i} s_j - GT) ds_i``, averaged over
    pixels and channels.

    Args:
        samples: samples of every pixel, group by group [b, n * samples of a group, c].
        target: photographed value [b, c].
        weight: ``1 / (normaliser^2 + eps)``, independent of the samples [b, 1] or [b, c].
        control: takes noise from samples and residuals; the mean of the gradient stays the same.
        groups: how many; None where every sample is independent of all others.
        use_kernels: let a compiled kernel find the gradient where it can (float32).
        chroma: by how much more differences of the channels count, :func:`neurad.losses.relative.weighted`.

    Raises:
        ValueError: groups of the samples, or of the control variate, are not as many or not equally long.
    """
    n = samples.shape[1] if groups is None else groups
    if n < 2 or samples.shape[1] % n or (control is not None and control.groups != n):
        raise ValueError(
            f"leave_one_out: {samples.shape[1]} samples, {n} groups; the control variate must have as many"
        )
    on_device = use_warp(use_kernels and samples.shape[2] == 3, samples)
    if on_device or use_kernel(use_kernels, samples, differentiable=True):
        return _by_kernel(samples, target, weight, None, control, n, chroma)
    # The mean of the other groups is the residual's independent estimate.
    own, others = _means(samples, control, n)
    scaled = weighted(others - target.unsqueeze(1), weight.unsqueeze(1), chroma)
    surrogate = (2.0 * scaled * own).mean()
    value = (scaled * (own.detach() - target.unsqueeze(1))).mean()
    return Loss(surrogate, value)


def leave_one_out_censored(
    samples: Tensor,
    target: Tensor,
    weight: Tensor,
    censored: Tensor | None,
    control: ControlVariate | None = None,
    groups: int | None = None,
    chroma: float = 1.0,
) -> Loss:
    """:func:`leave_one_out`, one-sided where the photograph is clipped.

    There the residual that multiplies the derivative of a group is ``min(mean of the others - target, 0)``, still
    independent of that group. Its mean lies below the minimum of the means, so noise of the size of the distance to the
    ceiling draws a render up; where a prediction without noise lies above the ceiling, the caller sets the weight to 0.

    Args:
        censored: where the target is a lower bound [b, c], bool, and counts by channel; None for nowhere. All others
            are those of :func:`leave_one_out`.
    """
    if censored is None:
        return leave_one_out(samples, target, weight, control, groups, chroma=chroma)
    n = samples.shape[1] if groups is None else groups
    if use_warp(samples.shape[2] == 3, samples):
        return _by_kernel(samples, target, weight, censored, control, n, chroma)
    exact = leave_one_out(samples, target, weight * ~censored, control, groups, chroma=chroma)
    rows = censored.any(-1).nonzero().squeeze(-1)
    if len(rows) == 0:
        return exact
    mine = None if control is None else ControlVariate(control.Li[rows], control.deviation[rows], n)
    own, others = _means(samples[rows], mine, n)  # [r, groups, c]
    bound = target[rows].unsqueeze(1)
    residual = (weight * censored)[rows].unsqueeze(1) * (others - bound).clamp_max(0.0)
    terms = len(samples) * n * samples.shape[2]
    surrogate = (2.0 * residual * own).sum() / terms
    value = (residual * (own.detach() - bound)).sum() / terms
    return Loss(exact.surrogate + surrogate, exact.value + value)


def _means(samples: Tensor, control: ControlVariate | None, n: int) -> tuple[Tensor, Tensor]:
    """Means of the groups [b, n, c], and of all groups but each, without gradient; a control variate takes noise from
    both.
    """
    fixed = grouped(samples.detach(), n)
    others = (fixed.sum(1, keepdim=True) - fixed) / (n - 1)
    if control is not None:
        others = others - control.residual_of_others()
        samples = samples - control.residual()
    return grouped(samples, n), others


def _by_kernel(
    samples: Tensor, target: Tensor, weight: Tensor, censored: Tensor | None, control: ControlVariate | None, n: int,
    chroma: float,
) -> Loss:  # fmt: skip
    deviation = None if control is None else control.deviation
    return Loss(*_Kernel.apply(samples, deviation, target, weight, censored, control, n, chroma))  # type: ignore[no-untyped-call]


class _Kernel(torch.autograd.Function):
    """:func:`leave_one_out` as one operation: its gradient is found together with its value."""

    @staticmethod
    def forward(
        ctx: Any,
        samples: Tensor,
        deviation: Tensor | None,
        target: Tensor,
        weight: Tensor,
        censored: Tensor | None,
        control: ControlVariate | None,
        groups: int,
        chroma: float,
    ) -> tuple[Tensor, Tensor]:
        by_sample = torch.empty_like(samples, memory_format=torch.contiguous_format)
        light, around, by_deviation = (samples.new_empty(0, 0, samples.shape[2]) for _ in range(3))
        if control is not None and deviation is not None:
            light, around, by_deviation = control.Li, deviation, torch.empty_like(by_sample)
        given = samples, target, weight.expand_as(target), light, around
        samples, target, weight, light, around = (x.detach().contiguous() for x in given)
        if use_warp(samples.shape[2] == 3, samples):
            from neurad.losses.leave_one_out_warp import find  # Warp is optional

            surrogate, value = find(
                samples, around, target, weight, censored, light, by_sample, by_deviation, groups, chroma
            )
        else:
            arrays = [x.numpy() for x in (samples, target, weight, light, around, by_sample, by_deviation)]
            grain, rows = -(-GRAIN // samples.shape[1]), 3 + 4 * samples.shape[2]

            def work(low: int, high: int) -> tuple[float, float]:
                return kernels.leave_one_out(low, high, groups, chroma, np.empty((rows, groups), np.float32), *arrays)

            parts = split(work, len(samples), grain)
            surrogate, value = (samples.new_tensor(sum(part)) for part in zip(*parts, strict=True))
        ctx.gradients = by_sample, by_deviation
        ctx.mark_non_differentiable(value)
        return surrogate, value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, outer: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        by_sample, by_deviation = ctx.gradients
        wanted = ctx.needs_input_grad
        return outer * by_sample, outer * by_deviation if wanted[1] else None, *[None] * 6
