"""The Lambertian reflector."""

import torch
from torch import Tensor

from neurad.core.protocols import BSDF
from neurad.core.records import BSDFSample, Surface
from neurad.core.sampling import INV_PI, cosine_hemisphere


class Diffuse(BSDF):
    """``f = albedo / pi``, sampled by the cosine; the roughness is not looked at."""

    is_diffuse = True
    varying_weight = False  # the weight is the albedo, whatever the direction

    def pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """``cos / pi`` [n]."""
        return torch.where(wo[:, 2] > 0, wi[:, 2].clamp_min(0.0) * INV_PI, 0.0)

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value ``albedo cos / pi`` [n, 3] and density [n]; 0 where ``wi`` or ``wo`` lies below the surface."""
        pdf = self.pdf(surface, wo, wi)
        return surface.albedo * pdf.unsqueeze(-1), pdf

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` by the cosine; the weight is the albedo. The first of the numbers ``u`` [n, 3] is not used."""
        wi = cosine_hemisphere(u[:, 1:])
        pdf = self.pdf(surface, wo, wi)
        return BSDFSample(wi, pdf, surface.albedo * (pdf > 0).unsqueeze(-1))

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> float:
        """All samples are drawn by the cosine."""
        return 1.0

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights of :meth:`sample` [n, 3]: the albedo."""
        return surface.albedo * (wo[:, 2:] > 0)
