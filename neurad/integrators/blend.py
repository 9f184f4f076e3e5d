"""The radiance field and further sampled bounces, weighed against each other at every place by a learned field.

After Zhang, Vicini, Winberg, Garbin and Jakob, "Radiance Caching for Differentiable Path Tracing" (SIGGRAPH 2026), as
far as the abstract tells: "a spatial blending field that locally interpolates between the cache and standard unbiased
estimators", applied recursively, with "inter-estimator consistency losses". What the abstract leaves open is guessed:
weights begin at one half and follow the photometric loss alone, first hits are always sampled, a path goes on for one
more bounce, and the loss of consistency is the radiometric prior whose right side is this estimate.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neurad.core.ranges import Count
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import RadianceEstimate, SceneModel
from neurad.integrators.radiometric import Radiometric, field_radiance
from neurad.integrators.walk import scatter, walk


class Blend(Radiometric):
    """``T_hat(E + B_1)`` with ``B_i = w sg[L_theta] + (1 - w) T_hat(E + B_{i+1})`` and ``B_k = sg[L_theta]``.

    ``w`` in [0, 1] is the radiance field's :class:`~neurad.fields.radiance.BlendingWeights` at the place, one number
    for all directions; a field without any answers alone. With ``w = 1`` it is :class:`Radiometric` of one bounce, with
    ``w = 0`` that of ``k``. The derivative by ``w`` is that of the value, that by materials counts later bounces as far
    as they are sampled.

    Args:
        k: bounces before the field is read whatever the weights are, 2 for one more than :class:`Radiometric` has.
        control_variate: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: there is no such k.
    """

    blends = True

    def __init__(self, k: Count = 2, control_variate: bool = True) -> None:
        super().__init__(k, control_variate)

    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """The estimate at the lanes of ``si``; it is the right side of the prior as well."""
        assert scene.radiance is not None
        weights = getattr(scene.radiance, "weights", None)
        k = 1 if weights is None else self.k
        stats = self.wants_sample_stats(scene.world)
        vertices = walk(scene, si, surface, u, stream, None, k + 1, sample_stats=stats)
        sample = RadianceEstimate(si.p)
        sampled = torch.ones_like(si.p[:, :1])  # product of 1 - w along each path [n, 1]
        terms: list[tuple[Tensor, Tensor]] = []
        for i, v in enumerate(vertices, 1):
            light = field_radiance(scene.materials, scene.radiance, v.bounce.next)  # [m, 3]
            if i == 1:
                # Any baseline keeps the mean, and the field's has no noise.
                sample = replace(sample, Li_bsdf=light, sample_stats=v.bounce.sample_stats, next=v.bounce.next)
            here = sampled[v.lane]
            if i < k and weights is not None:
                w = weights(v.bounce.next)  # [m, 1]
                light = w * light
                sampled = sampled.index_copy(0, v.lane, here * (1.0 - w))
            terms.append((v.lane, v.throughput * here * v.bounce.reflected(light)))
        value = scatter(terms, si.p)
        return replace(sample, value=value, transported=value)
