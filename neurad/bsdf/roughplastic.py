"""Mitsuba's ``roughplastic``: a diffuse base below a dielectric GGX surface, of one width everywhere."""

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.bsdf.microfacet import (
    fresnel_dielectric,
    ggx_reflection,
    interpolated,
    mirror,
    reflectance,
    transmittance,
    visible_normal,
)
from neurad.core.protocols import BSDF
from neurad.core.records import BSDFSample, Surface
from neurad.core.reflection import RoughPlasticModel
from neurad.core.sampling import INV_PI, cosine_hemisphere

COSINES = 64
"""Entries of the table of transmittances, evenly over the cosine, as in Mitsuba."""


class RoughPlastic(BSDF):
    """``f cos(wi) = specular F g + base T(wo) T(wi) cos(wi) / (pi eta^2)``.

    F is the Fresnel factor, g the reflection of the microfacets without it, and T what they transmit. The base is the
    albedo over ``1 - R``, or over ``1 - albedo R`` if ``nonlinear``, where R is the part of the base's light that the
    surface sends back to it. Lobes are drawn in proportion to what they reflect. The roughness of the surface is not
    read.

    Attributes:
        model: refractive index, width and tint of the surface.
        specular_fraction: odds of the specular lobe against the diffuse one; 0.5 is Mitsuba's.
    """

    is_diffuse = False
    varying_weight = True

    def __init__(self, model: RoughPlasticModel, specular_fraction: float = 0.5) -> None:
        self.model = model
        self.specular_fraction = specular_fraction
        self._surface = _interface(model.eta, model.alpha)

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value [n, 3], differentiable in the albedo, and detached density [n]."""
        model = self.model
        ggx, ggx_pdf, cos = ggx_reflection(wo, wi, torch.full_like(wo[:, 2], model.alpha))
        specular = (fresnel_dielectric(cos.clamp(1e-6, 1.0), model.eta) * ggx).unsqueeze(-1)
        cosine = torch.where(wo[:, 2] > 0, wi[:, 2].clamp_min(0.0) * INV_PI, 0.0)
        through = cosine * self._transmittance(wo) * self._transmittance(wi) / (model.eta * model.eta)
        value = wo.new_tensor(model.specular) * specular + self._base(surface) * through.unsqueeze(-1)
        diffuse = self.diffuse_fraction(surface, wo)
        return value, diffuse * cosine + (1.0 - diffuse) * ggx_pdf

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` from ``u`` [n, 3]; the weight is differentiable in ``surface``, direction and pdf are not."""
        mirrored = mirror(wo, visible_normal(wo, torch.full_like(wo[:, :1], self.model.alpha), u[:, 1:]))
        by_cosine = u[:, 0] < self.diffuse_fraction(surface, wo)
        wi = torch.where(by_cosine.unsqueeze(-1), cosine_hemisphere(u[:, 1:]), mirrored)
        return BSDFSample.of(wi, *self.eval_pdf(surface, wo, wi))

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> Tensor:
        """Probability of the diffuse lobe [n]."""
        through = self._transmittance(wo)
        tint = sum(self.model.specular) / 3.0
        diffuse = (1.0 - self.specular_fraction) * through * surface.albedo.detach().mean(-1)
        return diffuse / (diffuse + self.specular_fraction * (1.0 - through) * tint).clamp_min(1e-12)

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights of :meth:`sample` [n, 3]: the directional albedo."""
        mirrored = interpolated(self._surface.reflected.to(wo), wo[:, 2])
        specular = mirrored * wo.new_tensor(self.model.specular)
        through = self._transmittance(wo).unsqueeze(-1) / (self.model.eta * self.model.eta)
        base = self._base(surface) * through * self._surface.mean_transmitted
        return (specular + base) * (wo[:, 2:] > 0)

    def _transmittance(self, w: Tensor) -> Tensor:
        """T [n] of directions [n, 3] on the outside."""
        return interpolated(self._surface.transmitted.to(w), w[:, 2]).squeeze(-1)

    def _base(self, surface: Surface) -> Tensor:
        """Reflectance of the base, with what is reflected back to it [n, 3]."""
        back = self._surface.inside
        return surface.albedo / (1.0 - (surface.albedo * back if self.model.nonlinear else back))


@dataclass(frozen=True)
class _Interface:
    """How the surface of a plastic passes light, tabulated; cosines are even over 0 to 1."""

    transmitted: Tensor
    """From outside, T [COSINES, 1]."""
    reflected: Tensor
    """From outside [COSINES, 1]; both together lose what hits a second facet."""
    mean_transmitted: float
    """T over the hemisphere, by the cosine."""
    inside: float
    """What it reflects of light from within, over the hemisphere by the cosine: R."""


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _interface(eta: float, alpha: float) -> _Interface:
    cosine = torch.linspace(0.0, 1.0, COSINES, dtype=torch.float64)
    transmitted = transmittance(cosine, alpha, eta)
    ends = transmitted.squeeze(-1) * cosine
    middle = 0.25 * (transmitted[1:] + transmitted[:-1]).squeeze(-1) * (cosine[1:] + cosine[:-1])
    mean = 2.0 * float((ends[1:] + 4.0 * middle + ends[:-1]).sum()) / (6.0 * (COSINES - 1))  # exact, as T is linear
    inside = reflectance(cosine, alpha, lambda cos: fresnel_dielectric(cos, 1.0 / eta).unsqueeze(-1), 64)
    return _Interface(
        transmitted,
        reflectance(cosine, alpha, lambda cos: fresnel_dielectric(cos, eta).unsqueeze(-1)),
        mean,
        2.0 * float((inside.squeeze(-1) * cosine).mean()),
    )
