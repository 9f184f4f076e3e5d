"""Choosing the reflection model that a scene needs."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.bsdf.diffuse import Diffuse
from neurad.bsdf.principled import Principled
from neurad.core.protocols import BSDF
from neurad.core.records import Surface, TypedSurface
from neurad.core.sampling import INV_PI
from neurad.scene.description import Features


class BSDFTable(Principled):
    """:class:`Principled`, except on those lanes of a ``TypedSurface`` that are Lambertian.

    A plain ``Surface``, such as fitted materials give, is principled throughout and costs nothing extra.
    """

    def _lobes_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        d, s, pdf = super()._lobes_pdf(surface, wo, wi)
        if isinstance(surface, TypedSurface):
            matte = surface.diffuse
            lambert = torch.where(wo[:, 2] > 0, wi[:, 2].clamp_min(0.0) * INV_PI, 0.0)
            d, s, pdf = torch.where(matte, lambert, d), torch.where(matte, 0.0, s), torch.where(matte, lambert, pdf)
        return d, s, pdf

    def _direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        if isinstance(surface, TypedSurface):  # a first number of 0 always picks the cosine
            u = torch.cat((torch.where(surface.diffuse, 0.0, u[:, 0]).unsqueeze(-1), u[:, 1:]), -1)
        return super()._direction(surface, wo, u)

    def diffuse_fraction(self, surface: Surface) -> float | Tensor:
        """As in :class:`Principled`; 1 on Lambertian lanes."""
        share = 1.0 - self.specular_fraction
        return torch.where(surface.diffuse, 1.0, share) if isinstance(surface, TypedSurface) else share

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """As in :class:`Principled`; the albedo on Lambertian lanes."""
        mean = super().mean_weight(surface, wo)
        if isinstance(surface, TypedSurface):
            mean = torch.where(surface.diffuse.unsqueeze(-1), surface.albedo * (wo[:, 2:] > 0), mean)
        return mean


def make_bsdf(features: Features, specular_fraction: float = 0.5) -> BSDF:
    """The least reflection model for what a scene has: Lambertian scenes get no specular lobe.

    ``specular_fraction`` is the share of the samples that the specular lobe draws.
    """
    return Diffuse() if features.is_diffuse else BSDFTable(specular_fraction=specular_fraction)
