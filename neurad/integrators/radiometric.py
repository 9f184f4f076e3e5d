"""The paper's method: one bounce by sampling, all further ones by a radiance field (Eq. 12)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.ranges import Count, checked
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import Method, RadianceEstimate, ReflectedRadiance, SceneModel, query_radiance
from neurad.integrators.walk import scatter, walk


class Radiometric(Method):
    """The paper's Eq. 12: ``sum_{i <= k} T^i E + T^k sg[L_theta]``, ``k`` differentiable bounces and then the field.

    Args:
        k: bounces before the field is read; 1 in the paper.
        control_variate: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: there is no such k.
    """

    def __init__(self, k: Count = 1, control_variate: bool = True) -> None:
        self.k = k
        self.control_variate = control_variate
        checked(self)

    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """The estimate at the lanes of ``si``. The first bounce is the prior's as well."""
        assert scene.radiance is not None
        stats = self.wants_sample_stats(scene.world)
        vertices = walk(scene, si, surface, u, stream, None, self.k + 1, sample_stats=stats)

        # First bounce: T_hat(E + sg[L_theta]), the right side of Eq. 12 and, for the prior, of Eq. 10
        first = next(vertices)
        light = field_radiance(scene.materials, scene.radiance, first.bounce.next)  # [n, 3]
        value = first.bounce.reflected(light)  # [n, 3]
        sample = RadianceEstimate(value, value, light, first.bounce.sample_stats, first.bounce.next)
        if self.k == 1:
            return sample

        # Further bounces: T^i E, and in the end T^k sg[L_theta]
        terms = [(first.lane, first.bounce.direct)]
        for i, v in enumerate(vertices, 2):
            if i == self.k:
                term = v.bounce.reflected(field_radiance(scene.materials, scene.radiance, v.bounce.next))
            else:
                term = v.bounce.direct
            terms.append((v.lane, v.throughput * term))
        return replace(sample, value=scatter(terms, si.p))


@torch.no_grad()
def field_radiance(materials: Materials, radiance: ReflectedRadiance, si: SurfaceInteraction) -> Tensor:
    """``sg[L_theta]`` where BSDF samples ended [n, 3]; zero where they left the scene."""
    return si.where_hit(query_radiance(radiance, materials, si))
