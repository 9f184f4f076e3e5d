"""Rendering with a radiance field: the left and right side of the rendering equation (paper Eq. 12 and 13)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Interaction, Rays, Surface
from neurad.core.rng import Stream
from neurad.integrators.vertex import DIMENSIONS, bounce
from neurad.integrators.world import World

ReflectedRadiance = Callable[[Interaction, Tensor], Tensor]
"""``L_theta(it, albedo)``: reflected radiance towards ``it.wo`` [n, 3]; emission is not part of it."""


@dataclass(frozen=True)
class RadiometricLHS:
    """``I_lhs = E + L_theta``: what the radiance field itself shows."""

    world: World
    materials: Materials
    radiance: ReflectedRadiance

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Radiance along camera rays [n, 3]; without noise, but for the choice at glass that ``seed`` makes."""
        first = self.world.reach(rays, Stream(seed, device=rays.o.device).uniform(len(rays)))
        it = first.it
        seen = self.radiance(it, self.materials.albedo(it))
        return first.through(self.world.emitted(it) + seen * it.valid.unsqueeze(-1))


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
        first = self.world.reach(rays, stream.uniform(len(rays)))
        it = first.it
        u = stream.uniform(len(it), DIMENSIONS)
        reflected = transport(self.world, self.materials, self.radiance, it, self.materials(it), u)
        return first.through(self.world.emitted(it) + reflected)


def transport(
    world: World,
    materials: Materials,
    radiance: ReflectedRadiance,
    it: Interaction,
    surface: Surface,
    u: Tensor,
) -> Tensor:
    """``T_hat(E + sg[L_theta])`` at the lanes of ``it`` [n, 3], differentiable in ``surface``.

    ``u`` are uniform numbers [n, DIMENSIONS].
    """
    step = bounce(world, it, surface, u)
    return step.direct + step.weight * incident(materials, radiance, step.next)


@torch.no_grad()
def incident(materials: Materials, radiance: ReflectedRadiance, it: Interaction) -> Tensor:
    """``sg[L_theta]`` where BSDF samples ended [n, 3]; zero where they left the scene."""
    return radiance(it, materials.albedo(it)) * it.valid.unsqueeze(-1)
