"""One vertex of light transport: the rendering equation (paper Eq. 1) by one sample of each technique.

``T_hat(E + L) = direct + weight * L(next)`` estimates the integral of Eq. 1: emission is found by emitter sampling and
by BSDF sampling, joined by MIS; other light L is read along the BSDF sample alone. Every integrator is made of it. What
is here is the reference; :func:`neurad.integrators.bounce.bounce` takes kernels instead where they do the same.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.frame import Frame, faceforward
from neurad.core.protocols import SampledBSDF
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.sampling import mis_weight
from neurad.integrators.world import World

DIMENSIONS = 7
"""Uniform numbers that one bounce consumes: three for the emitter, three for the BSDF, one for glass on the way."""


@dataclass(frozen=True)
class BSDFSampleStats:
    """Weights of BSDF samples compared with their mean: what a control variate and a guide are made from."""

    deviation: Tensor
    """Weight of the sample, without smooth surfaces on the way, less its mean: zero on average whatever light there is,
    with the gradient of the surface [n, 3]."""
    relative: Tensor
    """Weight over its mean, without gradient [n, 3]: 1 on average."""
    wi: Tensor
    """Direction of the sample in the shading frame, without gradient [n, 3]."""


@dataclass(frozen=True)
class Bounce:
    """One sample of the transport operator at a vertex: ``T_hat(E + L) = direct + weight * L(next)``.

    ``direct`` and ``weight`` carry the gradient of the surface (paper Eq. 8 at one vertex); directions and pdfs are
    held fixed (detached sampling).
    """

    direct_demodulated: Tensor
    """``direct`` without the factor ``albedo`` [n, 3]."""
    weight_demodulated: Tensor
    """``weight`` without the factor ``albedo`` [n, 3]."""
    next: SurfaceInteraction
    """Where the BSDF sample ended."""
    sample_stats: BSDFSampleStats | None = None
    """None unless asked for, or where all weights are the same."""
    albedo: Tensor | None = None
    """What a bounce at Lambertian surfaces is proportional to [n, 3]; None where there is no such factor. Only it
    has a gradient then, and one product with it is enough."""

    @property
    def direct(self) -> Tensor:
        """One-sample estimate of T(E): both techniques, MIS-weighted [n, 3]."""
        return self._modulated(self.direct_demodulated)

    @property
    def weight(self) -> Tensor:
        """Weight of the BSDF sample: f cos / pdf [n, 3]."""
        return self._modulated(self.weight_demodulated)

    def reflected(self, light: Tensor) -> Tensor:
        """``T_hat(E + L)`` [n, 3] for the ``light`` L [n, 3] that comes from ``next``."""
        return self._modulated(self.direct_demodulated + self.weight_demodulated * light)

    def _modulated(self, value: Tensor) -> Tensor:
        return value if self.albedo is None else self.albedo * value


def shading_frame(si: SurfaceInteraction) -> Frame:
    """The frame whose z is the shading normal on the viewer's side."""
    return Frame.around(faceforward(si))


def bounce_reference(
    world: World, bsdf: SampledBSDF, si: SurfaceInteraction, surface: Surface, u: Tensor, sample_stats: bool = False
) -> Bounce:
    """Sample T at the lanes of ``si`` (Eq. 1) in plain torch, on any device.

    Args:
        si: vertices [n]; one without a surface, or behind a one-sided surface, gives zero.
        surface: what they are made of; carries the gradient.
        u: uniform numbers [n, DIMENSIONS].
        sample_stats: compare the weights with their mean, where the BSDF's weights vary.
    """
    # ---------------------- Local frame ----------------------

    frame = shading_frame(si)
    wo = frame.to_local(si.wo)  # [n, 3]
    active = world.reflects(si)  # [n]

    # ---------------------- Emitter sampling ----------------------

    ds = world.lights.sample(si.p, u[:, :3])
    wi_em = frame.to_local(ds.wi)  # [n, 3]
    bsdf_value_em, bsdf_pdf_em = bsdf.eval_pdf(surface, wo, wi_em)  # f cos(wi) [n, 3] and its pdf [n]

    # Shadow rays only where light could arrive
    active_em = active & (ds.pdf > 0) & (bsdf_value_em.detach().amax(-1) > 0)  # [n]
    visible = world.unblocked(si, ds.wi, ds.distance, active_em)  # [n]

    mis_em = mis_weight(ds.pdf, bsdf_pdf_em)  # [n]
    if ds.is_delta is not None:  # BSDF sampling cannot find lights without extent
        mis_em = torch.where(ds.is_delta, 1.0, mis_em)
    scale = visible * (mis_em / ds.pdf.clamp_min(1e-30))
    direct_em = bsdf_value_em * (ds.radiance * scale.unsqueeze(-1))  # [n, 3]

    # ---------------------- Detached BSDF sampling ----------------------

    bsdf_sample = bsdf.sample(surface, wo, u[:, 3:6])
    bsdf_weight = bsdf_sample.weight * active.unsqueeze(-1)  # f cos / pdf [n, 3]

    hit = world.trace_past_delta(world.geometry.spawn(si, frame.to_world(bsdf_sample.wi)), u[:, 6])
    weight = hit.attenuate(bsdf_weight)  # [n, 3]

    mis_bsdf = mis_weight(bsdf_sample.pdf, world.lights.pdf(si.p, hit.si))  # [n]
    if hit.via_delta is not None:  # emitter sampling cannot look through all smooth surfaces
        mis_bsdf = torch.where(hit.via_delta, 1.0, mis_bsdf)
    direct_bsdf = weight * (world.lights.eval(hit.si) * mis_bsdf.unsqueeze(-1))  # [n, 3]

    # ---------------------- Weights against their mean ----------------------

    stats = None
    if sample_stats and bsdf.varying_weight:
        mean = bsdf.mean_weight(surface, wo) * active.unsqueeze(-1)  # [n, 3]
        fixed = mean.detach()
        relative = torch.where(fixed > 0, bsdf_weight.detach() / fixed, 0.0)
        stats = BSDFSampleStats(bsdf_weight - mean, relative, bsdf_sample.wi)

    return Bounce(direct_em + direct_bsdf, weight, hit.si, stats)
