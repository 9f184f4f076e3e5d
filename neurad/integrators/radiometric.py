"""Rendering with a radiance field: the left and right side of the rendering equation (paper Eq. 12 and 13)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.protocols import Materials
from neurad.core.records import Rays, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import Method, Parts, Reflected, ReflectedRadiance, query_radiance
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.walk import scatter, walk
from neurad.integrators.world import World

__all__ = ["Radiometric", "RadiometricLHS", "RadiometricRHS", "ReflectedRadiance", "field_radiance", "transport"]


class Radiometric(Method):
    """The paper's Eq. 12: ``sum_{i <= k} T^i E + T^k sg[L_theta]``, ``k`` differentiable bounces and then the field.

    Args:
        k: bounces before the field is read; 1 in the paper.
        control: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: there is no such k.
    """

    def __init__(self, k: int = 1, control: bool = True) -> None:
        if k < 1:
            raise InputError("model.method (Radiometric): k must be at least 1")
        self.k = k
        self.control = control

    def reflected(self, parts: Parts, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream) -> Reflected:
        """The estimate at the lanes of ``si``. The first bounce is the prior's as well."""
        assert parts.radiance is not None
        control = self.tells(parts.world)
        steps = walk(parts.world, parts.materials, si, surface, u, stream, lambda *_: None, self.k, control=control)
        first = next(steps)
        light = field_radiance(parts.materials, parts.radiance, first.step.next)
        value = first.step.reflected(light)
        sample = Reflected(value, value, light, first.step.sample_stats, first.step.next)
        if self.k == 1:
            return sample
        terms = [(first.lane, first.step.direct)]
        for index, v in enumerate(steps, 2):
            if index == self.k:
                term = v.step.reflected(field_radiance(parts.materials, parts.radiance, v.step.next))
            else:
                term = v.step.direct
            terms.append((v.lane, v.throughput * term))
        return replace(sample, value=scatter(terms, si.p))


@dataclass(frozen=True)
class RadiometricLHS:
    """``I_lhs = E + L_theta`` (paper Eq. 13): what the radiance field itself shows."""

    world: World
    materials: Materials
    radiance: ReflectedRadiance

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Radiance along camera rays [n, 3]; without noise, but for the choice at glass that ``seed`` makes."""
        first = self.world.trace_past_delta(rays, Stream(seed, device=rays.o.device).uniform(len(rays)))
        si = first.si
        seen = query_radiance(self.radiance, self.materials, si)
        return first.attenuate(self.world.emitted(si) + si.where_hit(seen))


@dataclass(frozen=True)
class RadiometricRHS:
    """``I_rhs = E + T_hat(E + L_theta)``: one bounce by sampling, all further ones by the radiance field."""

    world: World
    materials: Materials
    radiance: ReflectedRadiance

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """One-sample estimate of the radiance along camera rays [n, 3]."""
        stream = Stream(seed, device=rays.o.device)
        first = self.world.trace_past_delta(rays, stream.uniform(len(rays)))
        si = first.si
        u = stream.uniform(len(si), DIMENSIONS)
        reflected = transport(self.world, self.materials, self.radiance, si, self.materials(si), u)
        return first.attenuate(self.world.emitted(si) + reflected)


def transport(
    world: World,
    materials: Materials,
    radiance: ReflectedRadiance,
    si: SurfaceInteraction,
    surface: Surface,
    u: Tensor,
) -> Tensor:
    """``T_hat(E + sg[L_theta])`` at the lanes of ``si`` [n, 3], differentiable in ``surface``.

    ``u`` are uniform numbers [n, DIMENSIONS].
    """
    step = bounce(world, si, surface, u)
    return step.reflected(field_radiance(materials, radiance, step.next))


@torch.no_grad()
def field_radiance(materials: Materials, radiance: ReflectedRadiance, si: SurfaceInteraction) -> Tensor:
    """``sg[L_theta]`` where BSDF samples ended [n, 3]; zero where they left the scene."""
    return si.where_hit(query_radiance(radiance, materials, si))
