"""What a method is: an estimate of the light that a vertex reflects, differentiable in what the scene is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Interaction, Rays, Surface
from neurad.core.rng import Stream
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World

ReflectedRadiance = Callable[[Interaction, Tensor], Tensor]
"""``L_theta(it, albedo)``: reflected radiance towards ``it.wo`` [n, 3]; emission is not part of it."""


@dataclass(frozen=True)
class Parts:
    """What light meets: a world, its materials and, for the methods that read one, a radiance field."""

    world: World
    materials: Materials
    radiance: ReflectedRadiance | None = None


@dataclass(frozen=True)
class Reflected:
    """One-sample estimates at the lanes of first vertices."""

    value: Tensor
    """Reflected radiance [n, 3], differentiable in materials and lights by the method's rule, never in the field."""
    transported: Tensor | None = None
    """``T_hat(E + sg[L_theta])`` [n, 3], with the gradient of the materials: the right side of the radiometric prior.
    None from a method without a field."""
    direct: Tensor | None = None
    """``T_hat(E)`` [n, 3], a part of ``transported``."""
    incident: Tensor | None = None
    """Reflected radiance that arrived along the first BSDF samples, without gradient [n, 3]: with ``deviation`` the
    control variate of :class:`neurad.losses.relative.Control`. None from a method that has none."""
    deviation: Tensor | None = None
    """As in :class:`neurad.integrators.vertex.Bounce` [n, 3]."""
    ends: Interaction | None = None
    """Where the first BSDF samples ended; None from a method without a field."""


class Method(ABC):
    """A way to estimate reflected light and its derivative. One file each, for what is its own."""

    needs_field: ClassVar[bool] = True
    """Whether a radiance field is read; without it none is built, and no term of the objective trains one."""

    @abstractmethod
    def reflected(self, parts: Parts, it: Interaction, surface: Surface, u: Tensor, stream: Stream) -> Reflected:
        """Reflected radiance towards ``it.wo``, one sample a lane; lanes without a surface give zero.

        Args:
            parts: the scene.
            it: first vertices [n].
            surface: what the scene is made of there, with its gradient.
            u: uniform numbers of the first bounce [n, DIMENSIONS].
            stream: random numbers of all further ones.
        """


@dataclass(frozen=True)
class MethodRHS:
    """The picture that a method compares with photographs: ``E`` plus its estimate of reflected light."""

    method: Method
    parts: Parts

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """One-sample estimate of the radiance along camera rays [n, 3]."""
        stream = Stream(seed, device=rays.o.device)
        world = self.parts.world
        first = world.reach(rays, stream.uniform(len(rays)))
        u = stream.uniform(len(rays), DIMENSIONS)
        sample = self.method.reflected(self.parts, first.it, self.parts.materials(first.it), u, stream)
        return first.through(world.emitted(first.it) + sample.value)
