"""Burley's reflection model with base colour and roughness: Mitsuba's ``principled`` with ``eta`` and
``metallic``, all else left at its default.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.bsdf import principled_kernels as kernels
from neurad.bsdf.burley import lobes_pdf
from neurad.bsdf.directional import directional_albedo, mean_lobes
from neurad.bsdf.microfacet import alpha_of, mirror, visible_normal
from neurad.core.records import BSDFSample, FloatArray, Surface
from neurad.core.reflection import PrincipledModel
from neurad.core.sampling import cosine_hemisphere
from neurad.runtime.dispatch import use_kernel


@dataclass(frozen=True)
class PrincipledKernels:
    """The compiled lobes, for float32 on the CPU."""

    eta: float
    """Refractive index of the specular lobe, inside over outside."""
    specular_fraction: float | Tensor
    """Probability of the specular lobe, of all lanes or of each [n]."""

    def _fraction(self, lanes: int) -> FloatArray:
        """It as an array [1] or [n]."""
        if not isinstance(self.specular_fraction, Tensor):
            return np.array([self.specular_fraction], np.float32)
        if len(self.specular_fraction) != lanes:
            raise ValueError(f"lanes differ: specular_fraction {len(self.specular_fraction)}, others {lanes}")
        found: FloatArray = self.specular_fraction.contiguous().numpy()
        return found

    def lobes(self, roughness: Tensor, wo: Tensor, wi: Tensor) -> Tensor:
        """Rows d, s, pdf of :func:`lobes_pdf` and dd/droughness, ds/droughness [5, n].

        Raises:
            ValueError: the arguments have different numbers of lanes; the kernel would read past their ends.
        """
        if not roughness.shape[0] == wo.shape[0] == wi.shape[0]:
            raise ValueError(f"lanes differ: roughness {roughness.shape[0]}, wo {wo.shape[0]}, wi {wi.shape[0]}")
        rough, view, towards = (x.detach().contiguous().numpy() for x in (roughness, wo, wi))
        out = torch.empty(5, len(wo))
        kernels.lobes_pdf(rough, view, towards, np.float32(self.eta), self._fraction(len(wo)), out.numpy())
        return out

    def direction(self, roughness: Tensor, wo: Tensor, u: Tensor) -> Tensor:
        """Draw ``wi`` [n, 3].

        Args:
            roughness: [n, 1].
            wo: towards the viewer, local [n, 3].
            u: uniform numbers [n, 3]: the first picks the lobe, the others a direction, as in Mitsuba.

        Raises:
            ValueError: the arguments have different numbers of lanes; the kernel would read past their ends.
        """
        if not roughness.shape[0] == wo.shape[0] == u.shape[0]:
            raise ValueError(f"lanes differ: roughness {roughness.shape[0]}, wo {wo.shape[0]}, u {u.shape[0]}")
        rough, view, numbers = (x.detach().contiguous().numpy() for x in (roughness, wo, u))
        wi = torch.empty(len(wo), 3)
        kernels.direction(rough, view, numbers, self._fraction(len(wo)), wi.numpy())
        return wi

    def mean_lobes(self, roughness: Tensor, cosine: Tensor) -> Tensor:
        """Integrals over wi of d, s and their derivatives by the roughness [4, n], tabulated."""
        return mean_lobes(roughness, cosine, self.eta)


class _LobesPdfKernel(torch.autograd.Function):
    """:func:`lobes_pdf` by a compiled kernel that finds the derivatives in the same pass."""

    @staticmethod
    def forward(
        ctx: Any, roughness: Tensor, wo: Tensor, wi: Tensor, compiled: PrincipledKernels
    ) -> tuple[Tensor, Tensor, Tensor]:
        d, s, pdf, d_by_roughness, s_by_roughness = compiled.lobes(roughness, wo, wi).unbind(0)
        ctx.save_for_backward(d_by_roughness, s_by_roughness)
        ctx.mark_non_differentiable(pdf)
        return d, s, pdf

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        d_by_roughness, s_by_roughness = ctx.saved_tensors
        return (grads[0] * d_by_roughness + grads[1] * s_by_roughness).unsqueeze(-1), None, None, None


def principled_lobes_pdf(
    roughness: Tensor, wo: Tensor, wi: Tensor, eta: float, specular_fraction: float | Tensor = 0.5
) -> tuple[Tensor, Tensor, Tensor]:
    """The kernel of :func:`lobes_pdf` for float32 on the CPU; differentiable once, in the roughness only.

    Raises:
        ValueError: the arguments have different numbers of lanes; the kernel would read past their ends.
    """
    compiled = PrincipledKernels(eta, specular_fraction)
    d, s, pdf = _LobesPdfKernel.apply(roughness, wo.detach(), wi.detach(), compiled)  # type: ignore[no-untyped-call]
    return d, s, pdf


class Principled:
    """A retro-reflecting diffuse lobe under a GGX lobe, samples drawn from either.

    ``f cos(wi) = albedo d + s`` with scalars d and s, as :meth:`lobes` gives them.

    Attributes:
        eta: refractive index of the specular lobe, inside over outside; 1.5 is Mitsuba's ``specular`` 0.5.
        metallic: 0 is a dielectric, 1 a metal, whose albedo is its reflectance at normal incidence.
        use_kernels: use the compiled kernels where they apply (float32 on the CPU, no metal).
        specular_fraction: probability that a sample is drawn from the specular lobe.
    """

    is_diffuse = False
    varying_weight = True

    def __init__(
        self, eta: float = 1.5, use_kernels: bool = True, specular_fraction: float = 0.5, metallic: float = 0.0
    ) -> None:
        """``specular_fraction`` is that of a dielectric, 0.5 as in Mitsuba; metal draws less by the diffuse lobe."""
        self.eta = eta
        self.metallic = metallic
        self.use_kernels = use_kernels and metallic == 0.0
        diffuse = (1.0 - specular_fraction) * (1.0 - metallic)
        self.specular_fraction = (
            specular_fraction if metallic == 0.0 else specular_fraction / (specular_fraction + diffuse)
        )

    @classmethod
    def of(cls, model: PrincipledModel, specular_fraction: float) -> Self:
        """The implementation of a description."""
        return cls(model.eta, specular_fraction=specular_fraction, metallic=model.metallic)

    def kernels(self, surface: Surface) -> PrincipledKernels | None:
        """The compiled lobes, where ``surface`` is float32 on the CPU and all of one model."""
        enabled = self.use_kernels and surface.model is None
        if use_kernel(enabled, surface.albedo, surface.roughness, differentiable=True):
            return PrincipledKernels(self.eta, self._fraction(surface))
        return None

    def _fraction(self, surface: Surface) -> float | Tensor:
        """Probability of the specular lobe, the lanes' own [n] where they have one."""
        return self.specular_fraction if surface.specular_fraction is None else surface.specular_fraction.squeeze(-1)

    def _lobes_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if use_kernel(self.use_kernels, wo, differentiable=True):
            return principled_lobes_pdf(surface.roughness, wo, wi, self.eta, self._fraction(surface))
        return lobes_pdf(surface.roughness, wo, wi, self.eta, self._fraction(surface), self.metallic)

    def _direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        roughness, fraction = surface.roughness.detach(), self._fraction(surface)
        if use_kernel(self.use_kernels, wo, differentiable=True):
            return PrincipledKernels(self.eta, fraction).direction(roughness, wo, u)
        mirrored = mirror(wo, visible_normal(wo, alpha_of(roughness), u[:, 1:]))
        by_cosine = (u[:, 0] < 1.0 - fraction).unsqueeze(-1)
        return torch.where(by_cosine, cosine_hemisphere(u[:, 1:]), mirrored)

    def lobes(self, roughness: Tensor, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Diffuse lobe for albedo 1 and specular lobe, cosine included: d [n] and s [n], differentiable in
        ``roughness`` [n, 1].
        """
        return self._lobes_pdf(Surface(roughness, roughness), wo, wi)[:2]

    def eval(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """``albedo d + s`` [n, 3]; 0 where ``wi`` or ``wo`` lies below the surface."""
        return self.eval_pdf(surface, wo, wi)[0]

    def pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """Density [n] of :meth:`sample`, detached."""
        return self._lobes_pdf(surface.detach(), wo, wi)[2]

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value [n, 3], differentiable in ``surface``, and detached density [n] in one go."""
        d, s, pdf = self._lobes_pdf(surface, wo, wi)
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
        return directional_albedo(surface, wo[:, 2], self.eta, self.metallic) * (wo[:, 2:] > 0)
