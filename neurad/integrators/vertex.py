"""One vertex of light transport: emitter sampling and BSDF sampling, joined by MIS. Every integrator is made of it."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.core.frame import Frame, faceforward
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.sampling import mis_weight
from neurad.integrators import vertex_diffuse as vertex_diffuse
from neurad.integrators import vertex_principled as vertex_principled
from neurad.integrators.bounce import Bounce, BSDFSampleStats
from neurad.integrators.guide import Guided
from neurad.integrators.world import World

DIMENSIONS = 7
"""Uniform numbers that one bounce consumes: three for the emitter, three for the BSDF, one for glass on the way."""


def shading_frame(si: SurfaceInteraction) -> Frame:
    """The frame whose z is the shading normal on the viewer's side."""
    return Frame.around(faceforward(si))


def bounce(
    world: World,
    si: SurfaceInteraction,
    surface: Surface,
    u: Tensor,
    control: bool = False,
    use_kernels: bool = True,
    guided: bool = True,
) -> Bounce:
    """Sample T at the lanes of ``si`` with uniform numbers ``u`` [n, DIMENSIONS].

    Lanes without a surface, or that look at a one-sided surface from behind, give zero. ``control`` asks for
    ``sample_stats`` as well; a model whose weights always are their mean gives none. ``use_kernels`` lets the compiled
    :mod:`neurad.integrators.vertex_diffuse` and :mod:`neurad.integrators.vertex_principled` do what they can do,
    ``guided`` uses the world's guide where there is one.
    """
    if use_kernels and vertex_diffuse.has_kernel(world, si):
        return vertex_diffuse.bounce_diffuse(world, si, surface, u)
    if use_kernels and vertex_principled.has_kernel(world, si, surface):
        return vertex_principled.bounce_principled(world, si, surface, u, control, guided)
    frame = shading_frame(si)
    wo = frame.to_local(si.wo)
    reflects = world.reflects(si)

    # Emitter sampling
    light = world.lights.sample(si.p, u[:, :3])
    towards = frame.to_local(light.wi)
    value, bsdf_pdf = world.bsdf.eval_pdf(surface, wo, towards)
    guide = None
    if guided and world.guide is not None:
        guide = Guided(world.guide, world.guide.rows(si, frame.n), world.bsdf.diffuse_fraction(surface, wo))
        bsdf_pdf = bsdf_pdf + guide.pdf_delta(towards)
    useful = reflects & (light.pdf > 0) & (value.detach().amax(-1) > 0)
    shadow, t_max = world.geometry.spawn_towards(si, light.wi, light.distance)
    lit = useful.clone()
    index = useful.nonzero().squeeze(-1)
    lit[index] = ~world.occluded(shadow[index], t_max[index])
    scale = torch.where(lit, mis_weight(light.pdf, bsdf_pdf) / light.pdf.clamp_min(1e-30), 0.0)
    direct = value * (light.radiance * scale.unsqueeze(-1))

    # BSDF sampling
    numbers = u[:, 3:6] if guide is None else guide.warp(u[:, 3:6])
    sample = world.bsdf.sample(surface, wo, numbers)
    if guide is not None:
        sample = guide.corrected(sample)
    first = world.trace_past_delta(world.geometry.spawn(si, frame.to_world(sample.wi)), u[:, 6])
    own = sample.weight * reflects.unsqueeze(-1)
    sample_stats = None
    if control and world.bsdf.varying_weight:
        mean = world.bsdf.mean_weight(surface, wo) * reflects.unsqueeze(-1)
        fixed = mean.detach()
        sample_stats = BSDFSampleStats(own - mean, torch.where(fixed > 0, own.detach() / fixed, 0.0), sample.wi)
    weight = first.attenuate(own)
    mis = mis_weight(sample.pdf, world.lights.pdf(si.p, first.si))
    if first.via_delta is not None:  # emitter sampling cannot look through smooth surfaces
        mis = torch.where(first.via_delta, 1.0, mis)
    direct = direct + weight * (world.lights.eval(first.si) * mis.unsqueeze(-1))
    return Bounce(direct, weight, first.si, sample_stats)
