"""What a method is: an estimate of the light that a vertex reflects, differentiable in what the scene is made of."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.vertex import BSDFSampleStats
from neurad.integrators.world import World

ReflectedRadiance = (
    Callable[[SurfaceInteraction, Tensor], Tensor] | Callable[[SurfaceInteraction, Tensor | None], Tensor]
)
"""``L_theta(si, albedo)``: reflected radiance towards ``si.wo`` [n, 3]; emission is not part of it."""


def query_radiance(radiance: ReflectedRadiance, materials: Materials, si: SurfaceInteraction) -> Tensor:
    """``L_theta`` at the lanes of ``si`` [n, 3]. It reads the albedo, without gradient, unless the field's attribute
    ``reads_albedo`` is False.
    """
    if not getattr(radiance, "reads_albedo", True):
        return radiance(si, None)  # type: ignore[arg-type]
    with torch.no_grad():
        albedo = materials.albedo(si)
    return radiance(si, albedo)


@dataclass(frozen=True)
class SceneModel:
    """What light meets: a world, its materials and, for the methods that read one, a radiance field."""

    world: World
    materials: Materials
    radiance: ReflectedRadiance | None = None


@dataclass(frozen=True)
class RadianceEstimate:
    """One-sample estimates at the lanes of first vertices."""

    value: Tensor
    """Reflected radiance [n, 3], differentiable in materials and lights by the method's rule, never in the field."""
    transported: Tensor | None = None
    """``T_hat(E + sg[L_theta])`` [n, 3], with the gradient of the materials: the right side of the radiometric prior.
    None from a method without a field."""
    Li_bsdf: Tensor | None = None
    """Reflected radiance that arrived along the first BSDF samples, without gradient [n, 3]; None from a method that
    has no such estimate."""
    sample_stats: BSDFSampleStats | None = None
    """Statistics of the first BSDF samples: with ``Li_bsdf`` the control variate of
    :class:`neurad.losses.leave_one_out.ControlVariate`, and what a guide is made from."""
    next: SurfaceInteraction | None = None
    """Where the first BSDF samples ended; None from a method without a field."""


class Method(ABC):
    """A way to estimate reflected light and its derivative. One file each, for what is its own."""

    needs_field: ClassVar[bool] = True
    """Whether a radiance field is read; without it none is built, and no term of the objective trains one."""

    blends: ClassVar[bool] = False
    """Whether weights of the radiance field are read, which then has some, trained by the method's own estimate."""
    control_variate: bool = False
    """Whether :class:`neurad.losses.leave_one_out.ControlVariate` takes noise from the samples."""
    estimates_Li: ClassVar[bool] = True
    """Whether estimates come with the radiance that arrived, ``Li_bsdf``, which a guide is made from."""

    @property
    def reflects(self) -> bool:
        """Whether it shows surfaces at all, and not emitters alone."""
        return True

    def wants_sample_stats(self, world: World) -> bool:
        """Whether statistics of the first BSDF samples are needed: in training, by a control variate or a guide."""
        return torch.is_grad_enabled() and (self.control_variate or world.guide is not None)

    @abstractmethod
    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """Reflected radiance towards ``si.wo``, one sample a lane; lanes without a surface give zero.

        Args:
            scene: what light meets.
            si: first vertices [n].
            surface: what the scene is made of there, with its gradient.
            u: uniform numbers of the first bounce [n, DIMENSIONS].
            stream: random numbers of all further ones.
        """

    def regulariser(self, si: SurfaceInteraction, surface: Surface) -> Tensor | None:
        """A loss of one's own at first hits [n], whose mean over pixels is a term of the objective; None for none.

        Args:
            si: first hits of a batch [n]; lanes without a surface are not ``valid``.
            surface: what the scene is made of there, with its gradient.
        """
        return None
