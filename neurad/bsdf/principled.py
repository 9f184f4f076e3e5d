"""Burley's reflection model with base colour, roughness and metalness: Mitsuba's ``principled`` with ``eta``, all else
left at its default; or that of Cycles, whose diffuse lobe is Lambert's and whose masking and shadowing are correlated.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.bsdf import principled_kernels as kernels
from neurad.bsdf.burley import lobes_pdf
from neurad.bsdf.directional import COSINES, ROUGHNESSES, directional_albedo, mean_lobes, table
from neurad.bsdf.microfacet import alpha_of, mirror, visible_normal
from neurad.core.records import BSDFSample, FloatArray, Surface
from neurad.core.reflection import PrincipledModel
from neurad.core.sampling import cosine_hemisphere
from neurad.runtime.dispatch import use_kernel


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

    @classmethod
    def of(cls, surface: Surface, eta: float, specular_fraction: float | Tensor, lambert: float) -> Self:
        """Those of a surface, by the part of Lambert's lobe that it has if it has one."""
        if surface.lambert is not None and len(surface) > 0:
            lambert = float(surface.lambert.detach()[0])
        return cls(eta, specular_fraction, lambert)

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
        """Draw ``wi`` [n, 3].

        Args:
            surface: [n].
            wo: towards the viewer, local [n, 3].
            u: uniform numbers [n, 3]: the first picks the lobe, the others a direction, as in Mitsuba.
        """
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


class _LobesPdfKernel(torch.autograd.Function):
    """:func:`lobes_pdf` by compiled kernels that find the derivatives in the same pass."""

    @staticmethod
    def forward(
        ctx: Any, surface: Surface, wo: Tensor, wi: Tensor, compiled: PrincipledKernels, *scalars: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        d, s, pdf, *derivatives = compiled.lobes(surface, wo, wi).unbind(0)
        ctx.save_for_backward(*derivatives)
        ctx.mark_non_differentiable(pdf)
        return d, s, pdf

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        by = ctx.saved_tensors
        pairs = zip(by[::2], by[1::2], strict=True)
        return (None, None, None, None, *((grads[0] * d + grads[1] * s).unsqueeze(-1) for d, s in pairs))


def principled_lobes_pdf(
    surface: Surface, wo: Tensor, wi: Tensor, compiled: PrincipledKernels
) -> tuple[Tensor, Tensor, Tensor]:
    """The kernel of :func:`lobes_pdf` for float32 on the CPU; differentiable once, in the surface's scalars only.

    Raises:
        ValueError: the arguments have different numbers of lanes; the kernel would read past their ends.
    """
    scalars = surface.scalars
    d, s, pdf = _LobesPdfKernel.apply(surface, wo.detach(), wi.detach(), compiled, *scalars)  # type: ignore[no-untyped-call]
    return d, s, pdf


class Principled:
    """A retro-reflecting diffuse lobe under a GGX lobe, samples drawn from either, and metal by its part.

    ``f cos(wi) = albedo d + s`` with scalars d and s, as :meth:`lobes` gives them.

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
        """``specular_fraction`` is 0.5 in Mitsuba."""
        self.eta = eta
        self.use_kernels = use_kernels
        self.specular_fraction = specular_fraction
        self.lambert = lambert

    @classmethod
    def of(cls, model: PrincipledModel, specular_fraction: float) -> Self:
        """The implementation of a description."""
        return cls(model.eta, specular_fraction=specular_fraction, lambert=float(model.diffuse == "lambert"))

    def kernels(self, surface: Surface) -> PrincipledKernels | None:
        """The compiled lobes, where ``surface`` is float32 on the CPU and all of one model."""
        enabled = self.use_kernels and surface.model is None
        if use_kernel(enabled, surface.albedo, surface.roughness, differentiable=True):
            return self._compiled(surface)
        return None

    def _compiled(self, surface: Surface) -> PrincipledKernels:
        return PrincipledKernels.of(surface, self.eta, self._fraction(surface), self.lambert)

    def _fraction(self, surface: Surface) -> float | Tensor:
        """Probability of the specular lobe, [n] where lanes have one of their own or are of metal."""
        own = surface.specular_fraction
        fraction = self.specular_fraction if own is None else own.squeeze(-1)
        if surface.metallic is None:
            return fraction
        return fraction / (fraction + (1.0 - fraction) * (1.0 - surface.metallic.detach().squeeze(-1)))

    def _lobes_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if use_kernel(self.use_kernels, wo, differentiable=True):
            return principled_lobes_pdf(surface, wo, wi, self._compiled(surface))
        lambert = self.lambert if surface.lambert is None else surface.lambert
        return lobes_pdf(surface.roughness, wo, wi, self.eta, self._fraction(surface), surface.metallic, lambert)

    def _direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        if use_kernel(self.use_kernels, wo, differentiable=True):
            return self._compiled(surface).direction(surface, wo, u)
        mirrored = mirror(wo, visible_normal(wo, alpha_of(surface.roughness.detach()), u[:, 1:]))
        by_cosine = (u[:, 0] < 1.0 - self._fraction(surface)).unsqueeze(-1)
        return torch.where(by_cosine, cosine_hemisphere(u[:, 1:]), mirrored)

    def lobes(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Lobe for albedo 1 and lobe without colour, cosine included: d [n] and s [n], differentiable in roughness and
        metalness.
        """
        return self._lobes_pdf(surface, wo, wi)[:2]

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
        return directional_albedo(surface, wo[:, 2], self.eta, self.lambert) * (wo[:, 2:] > 0)
