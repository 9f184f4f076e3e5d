"""One vertex of light transport: emitter sampling and BSDF sampling, joined by MIS. Every integrator is made of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.frame import Frame, dot
from neurad.core.records import Interaction, Surface
from neurad.core.sampling import mis_weight
from neurad.integrators.world import World

DIMENSIONS = 7
"""Uniform numbers that one bounce consumes: three for the emitter, three for the BSDF, one for glass on the way."""


@dataclass(frozen=True)
class Bounce:
    """One sample of the transport operator at a vertex: ``T_hat(E + L) = direct + weight * L(next)``.

    ``direct`` and ``weight`` carry the gradient of the surface; directions and pdfs are held fixed (detached sampling).
    """

    direct: Tensor
    """One-sample estimate of T(E): both techniques, MIS-weighted [n, 3]."""
    weight: Tensor
    """f cos / pdf of the BSDF sample [n, 3]."""
    next: Interaction
    """Where the BSDF sample ended."""
    deviation: Tensor | None = None
    """Weight of the BSDF sample, without smooth surfaces on the way, less its mean: zero on average whatever light
    there is [n, 3]. None unless asked for."""


def shading_frame(it: Interaction) -> Frame:
    """The frame whose z is the shading normal on the viewer's side."""
    return Frame.around(torch.where(dot(it.n, it.wo).unsqueeze(-1) < 0, -it.n, it.n))


def bounce(world: World, it: Interaction, surface: Surface, u: Tensor, control: bool = False) -> Bounce:
    """Sample T at the lanes of ``it`` with uniform numbers ``u`` [n, DIMENSIONS].

    Lanes without a surface, or that look at a one-sided surface from behind, give zero. ``control`` asks for the
    ``deviation`` of the weights as well.
    """
    frame = shading_frame(it)
    wo = frame.to_local(it.wo)
    reflects = world.reflects(it)

    # Emitter sampling
    light = world.lights.sample(it.p, u[:, :3])
    value, bsdf_pdf = world.bsdf.eval_pdf(surface, wo, frame.to_local(light.wi))
    useful = reflects & (light.pdf > 0) & (value.detach().amax(-1) > 0)
    shadow, t_max = world.geometry.spawn_towards(it, light.wi, light.distance)
    lit = useful.clone()
    index = useful.nonzero().squeeze(-1)
    lit[index] = ~world.occluded(shadow[index], t_max[index])
    scale = torch.where(lit, mis_weight(light.pdf, bsdf_pdf) / light.pdf.clamp_min(1e-30), 0.0)
    direct = value * (light.radiance * scale.unsqueeze(-1))

    # BSDF sampling
    sample = world.bsdf.sample(surface, wo, u[:, 3:6])
    reached = world.reach(world.geometry.spawn(it, frame.to_world(sample.wi)), u[:, 6])
    own = sample.weight * reflects.unsqueeze(-1)
    deviation = own - world.bsdf.mean_weight(surface, wo) * reflects.unsqueeze(-1) if control else None
    weight = reached.through(own)
    mis = mis_weight(sample.pdf, world.lights.pdf(it.p, reached.it))
    if reached.passed is not None:  # emitter sampling cannot look through smooth surfaces
        mis = torch.where(reached.passed, 1.0, mis)
    direct = direct + weight * (world.lights.eval(reached.it) * mis.unsqueeze(-1))
    return Bounce(direct, weight, reached.it, deviation)
