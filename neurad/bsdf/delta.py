"""Smooth conductors and dielectrics: one direction in, one (or one of two) directions out."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.bsdf.microfacet import fresnel_dielectric


@dataclass(frozen=True)
class Smooth:
    """What some smooth surfaces are."""

    dielectric: Tensor
    """Lanes that are dielectrics [n], bool; the others are conductors."""
    thin: Tensor
    """Dielectrics that are thin sheets, both faces in one [n], bool."""
    eta: Tensor
    """Refractive index, inside over outside [n]."""
    tint: Tensor
    """Reflectance of a conductor; factor on both ways of a dielectric [n, 3]."""

    def reflectance(self, z: Tensor) -> Tensor:
        """What a dielectric reflects [n] of light at cosines ``z`` [n], below 0 from inside. A sheet's has all
        reflections between its faces in it: ``F + (1 - F)^2 F / (1 - F^2) = 2 F / (1 + F)``.
        """
        ratio = torch.where((z > 0) | self.thin, self.eta, 1.0 / self.eta)
        face = fresnel_dielectric(z.abs().clamp_min(1e-6), ratio)
        return torch.where(self.thin, 2.0 * face / (1.0 + face), face)


def scatter(smooth: Smooth, wo: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Draw the direction that light comes from at a smooth surface, as Mitsuba's ``conductor``, ``dielectric`` and
    ``thindielectric`` do.

    A conductor is a mirror with a tint. A dielectric reflects with the probability of its Fresnel factor; what it
    transmits is radiance, which is squeezed by ``1 / eta^2`` on entering and stretched by ``eta^2`` on leaving. A thin
    sheet does both at once.

    Args:
        wo: unit directions towards the viewer, where the normal points outside: z < 0 is inside [n, 3].
        u: uniform numbers [n].

    Returns:
        ``wi`` [n, 3], local, and the weight ``f cos / probability`` [n, 3]. Exactly grazing lanes weigh 0.
    """
    x, y, z = wo.unbind(-1)
    transmitted = smooth.dielectric & (u > smooth.reflectance(z))

    inverse = torch.where(z > 0, 1.0 / smooth.eta, smooth.eta)  # viewer's side over the far one
    inverse = torch.where(smooth.thin, 1.0, inverse)
    cos = z.abs().clamp_min(1e-6)
    cos_t = (1.0 - (1.0 - cos * cos) * (inverse * inverse)).clamp_min(0.0).sqrt()
    bend = torch.where(transmitted, -inverse, -1.0)
    wi = torch.stack((bend * x, bend * y, torch.where(transmitted, -torch.copysign(cos_t, z), z)), -1)
    scale = torch.where(transmitted, inverse * inverse, 1.0) * (z != 0)
    return wi, smooth.tint * scale.unsqueeze(-1)
