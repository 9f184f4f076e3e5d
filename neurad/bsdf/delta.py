"""Smooth conductors and dielectrics: one direction in, one (or one of two) directions out."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.bsdf.microfacet import fresnel_dielectric


def scatter(dielectric: Tensor, wo: Tensor, eta: Tensor, tint: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Draw the direction that light comes from at a smooth surface, as Mitsuba's ``conductor`` and ``dielectric`` do.

    A conductor is a mirror with a tint. A dielectric reflects with the probability of its Fresnel factor; what it
    transmits is radiance, which is squeezed by ``1 / eta^2`` on entering and stretched by ``eta^2`` on leaving.

    Args:
        dielectric: lanes that are dielectrics [n], bool; the others are conductors.
        wo: unit directions towards the viewer, where the normal points outside: z < 0 is inside [n, 3].
        eta: refractive index, inside over outside [n].
        tint: reflectance of a conductor; factor on both ways of a dielectric [n, 3].
        u: uniform numbers [n].

    Returns:
        ``wi`` [n, 3], local, and the weight ``f cos / probability`` [n, 3]. Exactly grazing lanes weigh 0.
    """
    x, y, z = wo.unbind(-1)
    ratio = torch.where(z > 0, eta, 1.0 / eta)  # far side over the viewer's
    cos = z.abs().clamp_min(1e-6)
    transmitted = dielectric & (u > fresnel_dielectric(cos, ratio))

    inverse = 1.0 / ratio
    cos_t = (1.0 - (1.0 - cos * cos) * (inverse * inverse)).clamp_min(0.0).sqrt()
    bend = torch.where(transmitted, -inverse, -1.0)
    wi = torch.stack((bend * x, bend * y, torch.where(transmitted, -torch.copysign(cos_t, z), z)), -1)
    scale = torch.where(transmitted, inverse * inverse, 1.0) * (z != 0)
    return wi, tint * scale.unsqueeze(-1)
