"""Mitsuba's ``roughconductor``: metal with a GGX surface, of one width everywhere."""

import functools

import torch
from torch import Tensor

from neurad.bsdf.microfacet import fresnel_conductor, ggx_reflection, interpolated, mirror, reflectance, visible_normal
from neurad.core.protocols import BSDF
from neurad.core.records import BSDFSample, Surface
from neurad.core.reflection import RoughConductorModel

COSINES = 64
"""Entries of the table of directional albedos, evenly over the root of the viewer's cosine."""


class RoughConductor(BSDF):
    """``f cos(wi) = albedo F / F0 g``: F is the Fresnel factor, F0 the same at normal incidence, and g the reflection
    of microfacets without it. The roughness of the surface is not read.

    Attributes:
        model: refractive index and width.
    """

    is_diffuse = False
    varying_weight = True

    def __init__(self, model: RoughConductorModel) -> None:
        self.model = model

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """``albedo F / F0 g`` [n, 3], differentiable in the albedo, and density [n]."""
        ggx, pdf, cos = ggx_reflection(wo, wi, torch.full_like(wo[:, 2], self.model.alpha))
        return surface.albedo * (_relative_fresnel(self.model, cos) * ggx.unsqueeze(-1)), pdf

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` by the visible normals. The first of the numbers ``u`` [n, 3] is not used."""
        alpha = torch.full_like(wo[:, :1], self.model.alpha)
        wi = mirror(wo, visible_normal(wo, alpha, u[:, 1:]))
        return BSDFSample.of(wi, *self.eval_pdf(surface, wo, wi))

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> float:
        """No sample is drawn by the cosine."""
        return 0.0

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights of :meth:`sample` [n, 3]: the directional albedo."""
        table = _directional(self.model).to(wo)
        return surface.albedo * interpolated(table, wo[:, 2].clamp_min(0.0).sqrt()) * (wo[:, 2:] > 0)


def _relative_fresnel(model: RoughConductorModel, cos: Tensor) -> Tensor:
    """Fresnel factor over that at normal incidence [n, 3] for cosines [n]."""
    eta, k, normal = (cos.new_tensor(x) for x in (model.eta, model.k, model.normal_reflectance))
    return fresnel_conductor(cos, eta, k) / normal


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _directional(model: RoughConductorModel) -> Tensor:
    """Directional albedo for an albedo of 1 [COSINES, 3]."""
    cosine = torch.linspace(0.0, 1.0, COSINES, dtype=torch.float64).square()
    return reflectance(cosine, model.alpha, lambda cos: _relative_fresnel(model, cos))
