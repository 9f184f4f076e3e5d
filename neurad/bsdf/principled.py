"""Burley's reflection model with base colour, roughness and metalness: Mitsuba's ``principled`` with ``eta``, all else
left at its default; or that of Cycles, whose diffuse lobe is Lambert's and whose masking and shadowing are correlated.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurad.bsdf import principled_kernels as kernels
from neurad.bsdf.directional import COSINES, ROUGHNESSES, by_scalars, coat_albedo, directional_albedo, mean_lobes, table
from neurad.bsdf.microfacet import alpha_of, fresnel_dielectric, ggx_reflection, mirror, visible_normal
from neurad.core.protocols import BSDF
from neurad.core.records import BSDFSample, FloatArray, Surface
from neurad.core.sampling import INV_PI, cosine_hemisphere
from neurad.runtime.dispatch import use_kernel


def _schlick(z: Tensor) -> Tensor:
    """``(1 - z)^5`` [n]."""
    m = (1.0 - z).clamp_min(0.0)
    m2 = m * m
    return m2 * m2 * m


def lobes_pdf(
    roughness: Tensor,
    wo: Tensor,
    wi: Tensor,
    eta: float,
    specular_fraction: float | Tensor = 0.5,
    metallic: Tensor | None = None,
    lambert: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Diffuse and specular lobe and the density; any device and dtype, differentiable in roughness and
    metallic.

    With h the normalised ``wo + wi`` and ``c = h.wo = |wo + wi| / 2``:
    ``d = cos / pi ((1 - Fo/2)(1 - Fi/2) + R (Fo + Fi + Fo Fi (R - 1)))``, ``R = 2 roughness c^2`` (Burley 2012, 5.3,
    with the retro-reflection of Burley 2015), ``s = F g`` with the GGX reflection g of
    :func:`~neurad.bsdf.microfacet.ggx_reflection`, and ``pdf = (1 - p) cos / pi + p pdf_ggx``.

    A part ``lambert`` is as in Cycles and, but for the coat's Fresnel factor, in glTF: ``d = cos / pi (1 - E)``,
    Lambert's lobe under a coat with the directional albedo E towards the viewer, and g correlated by height. With
    albedo 1 both lobes then send back all light.

    Metal blends in Schlick's ``albedo + (1 - albedo) (1 - c)^5`` in place of F and of the diffuse lobe, which is linear
    in the albedo, too: ``f cos = albedo d + s`` holds for every ``metallic``.

    Args:
        roughness: [n, 1].
        wo: towards the viewer, local [n, 3].
        wi: towards the light, local [n, 3].
        eta: refractive index, inside over outside.
        specular_fraction: probability p of the specular lobe, of all lanes or of each [n].
        metallic: 0 is a dielectric, 1 a metal [n, 1]; None where all lanes are dielectrics.
        lambert: part that has Lambert's lobe, of all lanes or of each [n, 1].

    Returns:
        d [n] and s [n] with ``f cos(wi) = albedo d + s``, and the detached pdf [n].
    """
    r = roughness.squeeze(-1)
    part = lambert.squeeze(-1) if isinstance(lambert, Tensor) else lambert
    ggx, ggx_pdf, c = ggx_reflection(wo, wi, alpha_of(r), part)
    zo = wo[:, 2].clamp_min(0.0)
    zi = torch.where(wo[:, 2] > 0, wi[:, 2].clamp_min(0.0), 0.0)
    s = fresnel_dielectric(c, eta) * ggx

    fo, fi = _schlick(zo), _schlick(zi)
    both, cosine = fo * fi, zi * INV_PI
    retro = (2.0 * c * c) * r
    d = cosine * ((1.0 - 0.5 * fo) * (1.0 - 0.5 * fi) + retro * (fo + fi - both + retro * both))
    if isinstance(part, Tensor) or part > 0.0:
        d = d + part * (cosine * (1.0 - coat_albedo(roughness, zo, eta)) - d)
    if metallic is not None:
        m, grazing = metallic.squeeze(-1), _schlick(c)
        d = (1.0 - m) * d + m * (1.0 - grazing) * ggx
        s = (1.0 - m) * s + m * grazing * ggx
    pdf = torch.where(zi > 0, (1.0 - specular_fraction) * cosine + specular_fraction * ggx_pdf, 0.0)
    return d, s, pdf


@dataclass(frozen=True)
class PrincipledKernels:
    """The compiled lobes, for float32 on the CPU. All arguments need the same number of lanes: kernels would read past
    their ends, so others are a ValueError.
    """

    eta: float
    """Refractive index of the dielectric's specular lobe, inside over outside."""
    specular_fraction: float | Tensor
    """Probability of the specular lobe, of all lanes or of each [n]."""
    lambert: float = 0.0
    """Part that has Lambert's lobe."""
    takes_any_lanes = True

    def _fraction(self, lanes: int) -> FloatArray:
        """It as an array [1] or [n]."""
        if not isinstance(self.specular_fraction, Tensor):
            return np.array([self.specular_fraction], np.float32)
        if len(self.specular_fraction) != lanes:
            raise ValueError(f"lanes differ: specular_fraction {len(self.specular_fraction)}, others {lanes}")
        found: FloatArray = self.specular_fraction.contiguous().numpy()
        return found

    def lobes(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """Rows d, s, pdf of :func:`lobes_pdf`, and the derivatives of d and s by each of the surface's scalars, the
        roughness first: [5, 7 or 9, n].
        """
        rough, metal, view, towards = _arrays(surface, wo, wi)
        out = torch.empty(3 + 2 * len(surface.scalars), len(wo))
        kernels.lobes_pdf(rough, view, towards, np.float32(self.eta), self._fraction(len(wo)), out.numpy())
        part, by_part = np.float32(self.lambert), (out[5:7] if surface.lambert is not None else out[5:7, :0]).numpy()
        if self.lambert > 0.0 or surface.lambert is not None:
            entries = table(self.eta, wo.device, lambert=True).numpy()
            kernels.blend_lambert(rough, view, towards, part, entries, ROUGHNESSES, COSINES, out.numpy(), by_part)
        if metal is not None:
            kernels.add_metal(rough, metal, view, towards, part, out.numpy(), by_part, out[-2:].numpy())
        return out

    def direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        """Draw ``wi`` [n, 3] from ``u`` [n, 3]: the first picks the lobe, the others a direction, as in Mitsuba."""
        rough, _, view, numbers = _arrays(surface, wo, u)
        wi = torch.empty(len(wo), 3)
        kernels.direction(rough, view, numbers, self._fraction(len(wo)), wi.numpy())
        return wi

    def mean_lobes(self, surface: Surface, cosine: Tensor) -> Tensor:
        """Integrals over wi of d, s and their derivatives [4 or 6, n], tabulated."""
        return mean_lobes(surface, cosine, self.eta, self.lambert)


def _arrays(surface: Surface, *directions: Tensor) -> tuple[Any, ...]:
    """Roughness, metalness and directions of the same lanes as arrays, the metalness None where there is none."""
    given = (surface.roughness, surface.metallic, *directions)
    lanes = [len(x) for x in given if x is not None]
    if len(set(lanes)) > 1:
        raise ValueError(f"lanes differ: {', '.join(map(str, lanes))} of roughness, metalness and directions")
    return tuple(None if x is None else x.detach().contiguous().numpy() for x in given)


class Principled(BSDF):
    """A retro-reflecting diffuse lobe under a GGX lobe, samples drawn from either, and metal by its part.

    ``f cos(wi) = albedo d + s`` with scalars d and s, as :meth:`lobes_pdf` gives them.

    Attributes:
        eta: refractive index of the dielectric's specular lobe, inside over outside; 1.5 is Mitsuba's ``specular`` 0.5.
        use_kernels: use the compiled kernels where they apply (float32 on the CPU).
        specular_fraction: probability that a sample is drawn from the specular lobe of a dielectric; metal draws less
            by the diffuse lobe.
        lambert: part that has Lambert's lobe, 1 in Cycles; it may change.
    """

    is_diffuse = False
    varying_weight = True

    def __init__(
        self, eta: float = 1.5, use_kernels: bool = True, specular_fraction: float = 0.5, lambert: float = 0.0
    ) -> None:
        self.eta = eta
        self.use_kernels = use_kernels
        self.specular_fraction = specular_fraction
        self.lambert = lambert

    def kernels(self, surface: Surface) -> PrincipledKernels | None:
        """The compiled lobes, where ``surface`` is float32 on the CPU and all of one model."""
        enabled = self.use_kernels and surface.model is None
        if use_kernel(enabled, surface.albedo, surface.roughness, differentiable=True):
            return self._compiled(surface)
        return None

    def _compiled(self, surface: Surface) -> PrincipledKernels:
        lambert = self.lambert
        if surface.lambert is not None and len(surface) > 0:
            lambert = float(surface.lambert.detach()[0])
        return PrincipledKernels(self.eta, self._fraction(surface), lambert)

    def _fraction(self, surface: Surface) -> float | Tensor:
        """Probability of the specular lobe, [n] where lanes have one of their own or are of metal."""
        own = surface.specular_fraction
        fraction = self.specular_fraction if own is None else own.squeeze(-1)
        if surface.metallic is None:
            return fraction
        return fraction / (fraction + (1.0 - fraction) * (1.0 - surface.metallic.detach().squeeze(-1)))

    def lobes_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Lobe for albedo 1 and lobe without colour, cosine included: d [n] and s [n], differentiable in the surface's
        scalars, and the detached density [n].
        """
        if use_kernel(self.use_kernels, wo, differentiable=True):
            rows = self._compiled(surface).lobes(surface, wo, wi)
            return *by_scalars(rows[:2], rows[3:], surface), rows[2]
        lambert = self.lambert if surface.lambert is None else surface.lambert
        return lobes_pdf(surface.roughness, wo, wi, self.eta, self._fraction(surface), surface.metallic, lambert)

    def _direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        if use_kernel(self.use_kernels, wo, differentiable=True):
            return self._compiled(surface).direction(surface, wo, u)
        mirrored = mirror(wo, visible_normal(wo, alpha_of(surface.roughness.detach()), u[:, 1:]))
        by_cosine = (u[:, 0] < 1.0 - self._fraction(surface)).unsqueeze(-1)
        return torch.where(by_cosine, cosine_hemisphere(u[:, 1:]), mirrored)

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """``albedo d + s`` [n, 3], differentiable in ``surface``, and detached density [n]; 0 below the surface."""
        d, s, pdf = self.lobes_pdf(surface, wo, wi)
        return torch.addcmul(s.unsqueeze(-1), surface.albedo, d.unsqueeze(-1)), pdf

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` from ``u`` [n, 3]; the weight is differentiable in ``surface``, direction and pdf are not."""
        wi = self._direction(surface, wo, u)
        return BSDFSample.of(wi, *self.eval_pdf(surface, wo, wi))

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> float | Tensor:
        """Probability of the diffuse lobe."""
        return 1.0 - self._fraction(surface)

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights of :meth:`sample` [n, 3], the directional albedo, differentiable in ``surface``."""
        return directional_albedo(surface, wo[:, 2], self.eta, self.lambert) * (wo[:, 2:] > 0)
