"""Differentiable bounces of random number: the truncated derivative made unbiased, whatever the field says."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from neurad.core.ranges import Count, OpenFraction, PositiveFraction, Range, checked
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import Method, RadianceEstimate, SceneModel
from neurad.integrators.radiometric import field_radiance
from neurad.integrators.walk import scatter, walk

Exponent = Annotated[float, Range(0.0, 2.0, above=True, below=True)]
"""Power of a weight in a probability to go on; from 2 on the variance is infinite."""


class Debiased(Method):
    """``I = I_k + sum_{i >= k} (I_{i+1} - I_i) / P(i + 1)`` with ``I_i`` the estimate by i differentiable bounces.

    On one path ``I_{i+1} - I_i = beta_i (T_hat(E + L) - L)(x_i)``: the residual of the rendering equation at vertex i,
    dimmed by the path so far. The series telescopes, so values and derivatives are those of full transport also with a
    wrong field; a good field makes all but the first term small noise, which is why few paths need to follow it.

    The i-th term has a variance like ``rho^(2 i) / P(i)``, rho the albedo. So the probability to go on must exceed
    rho^2. It is ``weight^exponent`` at most ``rr_prob``, the weight of a diffuse bounce being its albedo: every
    exponent below 2 will do, and 1 makes variance times cost least for a residual that is the same everywhere. Where
    albedo is above ``sqrt(rr_prob)`` the variance is infinite.

    Args:
        k: bounces that every path has.
        first_prob: probability to follow a path beyond them, on a white surface.
        exponent: of the weight in later probabilities to go on, in (0, 2).
        rr_prob: largest of these.
        control_variate: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: a setting outside its range.
    """

    def __init__(
        self,
        k: Count = 1,
        first_prob: PositiveFraction = 0.5,
        exponent: Exponent = 1.0,
        rr_prob: OpenFraction = 0.995,
        control_variate: bool = True,
    ) -> None:
        self.k, self.first_prob, self.exponent, self.rr_prob = k, first_prob, exponent, rr_prob
        self.control_variate = control_variate
        checked(self)

    def continuation(self, bounces: int, throughput: Tensor, weight: Tensor) -> Tensor | None:
        """Probability to add the next term of the series [n]; None before the first term after ``I_k``."""
        if bounces < self.k:
            return None
        ratio = weight.amax(-1)
        if bounces == self.k:
            return ratio.clamp_max(1.0) * self.first_prob
        return ratio.pow(self.exponent).clamp_max(self.rr_prob)

    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """The telescoped series at the lanes of ``si``."""
        assert scene.radiance is not None
        stats = self.wants_sample_stats(scene.world)
        vertices = walk(scene, si, surface, u, stream, self.continuation, None, sample_stats=stats)
        terms: list[tuple[Tensor, Tensor]] = []
        sample = RadianceEstimate(si.p)
        light_before = si.p  # sg[L_theta] where the bounce before ended, at the lanes of the next one [n, 3]
        for i, v in enumerate(vertices):
            # ---------------------- The field where this bounce ended ----------------------

            if i == 0 or i >= self.k - 1:
                light = field_radiance(scene.materials, scene.radiance, v.bounce.next)  # [m, 3]
                value = v.bounce.reflected(light)  # T_hat(E + L) [m, 3]
            if i == 0:
                # Any baseline keeps the mean, and the field's has no noise.
                sample = RadianceEstimate(value, value, light, v.bounce.sample_stats, v.bounce.next)

            # ---------------------- T_hat(E), then I_k, then residuals ----------------------

            if i < self.k - 1:
                value = v.bounce.direct
            else:
                if i >= self.k:
                    value = value - light_before[v.lane]
                light_before = torch.zeros_like(si.p).index_copy_(0, v.lane, light)
            terms.append((v.lane, v.throughput * value))
        return replace(sample, value=scatter(terms, si.p))
