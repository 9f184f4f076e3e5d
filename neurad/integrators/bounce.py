"""What a bounce gives, whichever way it is made."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from neurad.core.records import SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.integrators.world import World
from neurad.runtime.dispatch import use_kernel


@dataclass(frozen=True)
class BSDFSampleStats:
    """How BSDF samples weigh, compared with their mean: what a control variate and a guide ask for."""

    deviation: Tensor
    """Weight of the sample, without smooth surfaces on the way, less its mean: zero on average whatever light there is,
    with the gradient of the surface [n, 3]."""
    relative: Tensor
    """Weight over its mean, without gradient [n, 3]: 1 on average."""
    wi: Tensor
    """Direction of the sample in the shading frame, without gradient [n, 3]."""


@dataclass(frozen=True)
class Bounce:
    """One sample of the transport operator at a vertex: ``T_hat(E + L) = direct + weight * L(next)``.

    ``direct`` and ``weight`` carry the gradient of the surface; directions and pdfs are held fixed (detached sampling).
    """

    direct_demodulated: Tensor
    """``direct`` without the factor ``albedo`` [n, 3]."""
    weight_demodulated: Tensor
    """``weight`` without the factor ``albedo`` [n, 3]."""
    next: SurfaceInteraction
    """Where the BSDF sample ended."""
    sample_stats: BSDFSampleStats | None = None
    """None unless asked for, or where all weights are the same."""
    albedo: Tensor | None = None
    """What a bounce at Lambertian surfaces is proportional to [n, 3]; None where there is no such factor. Only it
    has a gradient then, and one product with it is enough."""

    @property
    def direct(self) -> Tensor:
        """One-sample estimate of T(E): both techniques, MIS-weighted [n, 3]."""
        return self._complete(self.direct_demodulated)

    @property
    def weight(self) -> Tensor:
        """Of the BSDF sample: f cos / pdf [n, 3]."""
        return self._complete(self.weight_demodulated)

    def reflected(self, light: Tensor) -> Tensor:
        """``T_hat(E + L)`` [n, 3] for the ``light`` L [n, 3] that comes from ``next``."""
        return self._complete(self.direct_demodulated + self.weight_demodulated * light)

    def _complete(self, value: Tensor) -> Tensor:
        return value if self.albedo is None else self.albedo * value


def compilable(world: World, si: SurfaceInteraction) -> bool:
    """Whether compiled passes can make bounces at ``si``, as far as light and vertices go: known area lights, and
    float32 on the CPU without gradients.
    """
    lights = world.lights
    return (
        type(si) is SurfaceInteraction  # one that carries more has to hand it on
        and isinstance(lights, AreaLights)
        and use_kernel(True, si.p, lights.emission)
    )
