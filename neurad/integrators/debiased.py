"""Differentiable bounces of random number: the truncated derivative made unbiased, whatever the field says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import Method, Parts, Reflected
from neurad.integrators.radiometric import field_radiance
from neurad.integrators.walk import scatter, walk


@dataclass(frozen=True)
class Continuation:
    """Probability to add the next term of the series.

    Attributes:
        start: of the first term after ``I_k``.
        first: bounces done before it.
        exponent: of the last bounce's weight in all later ones.
        most: largest probability of a later one.
    """

    start: float
    first: int
    exponent: float
    most: float

    def __call__(self, bounces: int, throughput: Tensor, weight: Tensor) -> Tensor | None:
        """Probability to go on [n]; None before the first term."""
        if bounces < self.first:
            return None
        ratio = weight.amax(-1)
        if bounces == self.first:
            return ratio.clamp_max(1.0) * self.start
        return ratio.pow(self.exponent).clamp_max(self.most)


class Debiased(Method):
    """``I = I_k + sum_{i >= k} (I_{i+1} - I_i) / P(i + 1)`` with ``I_i`` the estimate by i differentiable bounces.

    On one path ``I_{i+1} - I_i = beta_i (T_hat(E + L) - L)(x_i)``: the residual of the rendering equation at vertex i,
    dimmed by the path so far. The series telescopes, so values and derivatives are those of full transport also with a
    wrong field; a good field makes all but the first term small noise, which is why few paths need to follow it.

    The i-th term has a variance like ``rho^(2 i) / P(i)``, rho the albedo. So the probability to go on must exceed
    rho^2. It is ``weight^exponent`` at most ``most``, the weight of a diffuse bounce being its albedo: every exponent
    below 2 will do, and 1 makes variance times cost least for a residual that is the same everywhere. Where albedo is
    above ``sqrt(most)`` the variance is infinite.

    Args:
        k: bounces that every path has.
        start: probability to follow a path beyond them, on a white surface.
        exponent: of the weight in later probabilities to go on, in (0, 2).
        most: largest of these.
        control: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: a setting outside its range.
    """

    def __init__(
        self, k: int = 1, start: float = 0.5, exponent: float = 1.0, most: float = 0.995, control: bool = True
    ) -> None:
        if k < 1:
            raise InputError("model.method (Debiased): k must be at least 1")
        if not 0.0 < start <= 1.0 or not 0.0 < most < 1.0:
            raise InputError("model.method (Debiased): start must lie in (0, 1] and most in (0, 1)")
        if not 0.0 < exponent < 2.0:
            raise InputError("model.method (Debiased): exponent must lie in (0, 2), or the variance is infinite")
        self.k = k
        self.control = control
        self.continuation = Continuation(start, k, exponent, most)

    def reflected(self, parts: Parts, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream) -> Reflected:
        """The telescoped series at the lanes of ``si``."""
        assert parts.radiance is not None
        control = self.tells(parts.world)
        steps = walk(parts.world, parts.materials, si, surface, u, stream, self.continuation, None, control=control)
        terms: list[tuple[Tensor, Tensor]] = []
        sample = Reflected(si.p)
        before = si.p  # sg[L] where the bounce before ended, at the lanes of the next one
        for index, v in enumerate(steps):
            if index == 0 or index >= self.k - 1:
                light = field_radiance(parts.materials, parts.radiance, v.step.next)
                value = v.step.reflected(light)
            if index == 0:
                # Any guess of the light keeps the mean, and the field's has no noise.
                sample = Reflected(value, value, light, v.step.sample_stats, v.step.next)
            if index < self.k - 1:
                value = v.step.direct
            else:
                if index >= self.k:
                    value = value - before[v.lane]
                before = torch.zeros_like(si.p).index_copy_(0, v.lane, light)
            terms.append((v.lane, v.throughput * value))
        return replace(sample, value=scatter(terms, si.p))
