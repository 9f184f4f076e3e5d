"""One vertex of light transport: emitter sampling and BSDF sampling, joined by MIS. Every integrator is made of it."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.core.frame import Frame, facing
from neurad.core.records import Interaction, Surface
from neurad.core.sampling import mis_weight
from neurad.integrators import glossy, matte
from neurad.integrators.bounced import Bounce, Weighed
from neurad.integrators.guiding import Guided
from neurad.integrators.world import World

DIMENSIONS = 7
"""Uniform numbers that one bounce consumes: three for the emitter, three for the BSDF, one for glass on the way."""


def shading_frame(it: Interaction) -> Frame:
    """The frame whose z is the shading normal on the viewer's side."""
    return Frame.around(facing(it))


def bounce(
    world: World,
    it: Interaction,
    surface: Surface,
    u: Tensor,
    control: bool = False,
    fast: bool = True,
    guided: bool = True,
) -> Bounce:
    """Sample T at the lanes of ``it`` with uniform numbers ``u`` [n, DIMENSIONS].

    Lanes without a surface, or that look at a one-sided surface from behind, give zero. ``control`` asks for
    ``weighed`` as well; a model whose weights always are their mean gives none. ``fast`` lets the compiled
    :mod:`neurad.integrators.matte` and :mod:`neurad.integrators.glossy` do what they can do, ``guided`` uses the
    world's guide where there is one.
    """
    if fast and matte.applies(world, it):
        return matte.arrive(world, it, surface, u)
    if fast and glossy.applies(world, it, surface):
        return glossy.arrive(world, it, surface, u, control, guided)
    frame = shading_frame(it)
    wo = frame.to_local(it.wo)
    reflects = world.reflects(it)

    # Emitter sampling
    light = world.lights.sample(it.p, u[:, :3])
    towards = frame.to_local(light.wi)
    value, bsdf_pdf = world.bsdf.eval_pdf(surface, wo, towards)
    guide = None
    if guided and world.guide is not None:
        guide = Guided(world.guide, world.guide.rows(it, frame.n), world.bsdf.diffuse_share(surface))
        bsdf_pdf = bsdf_pdf + guide.excess(towards)
    useful = reflects & (light.pdf > 0) & (value.detach().amax(-1) > 0)
    shadow, t_max = world.geometry.spawn_towards(it, light.wi, light.distance)
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
    reached = world.reach(world.geometry.spawn(it, frame.to_world(sample.wi)), u[:, 6])
    own = sample.weight * reflects.unsqueeze(-1)
    weighed = None
    if control and world.bsdf.deviates:
        mean = world.bsdf.mean_weight(surface, wo) * reflects.unsqueeze(-1)
        fixed = mean.detach()
        weighed = Weighed(own - mean, torch.where(fixed > 0, own.detach() / fixed, 0.0), sample.wi)
    weight = reached.through(own)
    mis = mis_weight(sample.pdf, world.lights.pdf(it.p, reached.it))
    if reached.passed is not None:  # emitter sampling cannot look through smooth surfaces
        mis = torch.where(reached.passed, 1.0, mis)
    direct = direct + weight * (world.lights.eval(reached.it) * mis.unsqueeze(-1))
    return Bounce(direct, weight, reached.it, weighed)
