"""One vertex of light transport: emitter sampling and BSDF sampling, joined by MIS. Every integrator is made of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.frame import Frame, facing
from neurad.core.records import BSDFSample, Interaction, Surface
from neurad.core.sampling import INV_PI, mis_weight
from neurad.integrators import glossy, matte
from neurad.integrators.guiding import Guide
from neurad.integrators.world import World

DIMENSIONS = 7
"""Uniform numbers that one bounce consumes: three for the emitter, three for the BSDF, one for glass on the way."""


@dataclass(frozen=True)
class Weighed:
    """How BSDF samples weigh, compared with their mean: what a control variate and a guide ask for."""

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

    ``direct`` and ``weight`` carry the gradient of the surface; directions and pdfs are held fixed (detached sampling).
    """

    direct: Tensor
    """One-sample estimate of T(E): both techniques, MIS-weighted [n, 3]."""
    weight: Tensor
    """f cos / pdf of the BSDF sample [n, 3]."""
    next: Interaction
    """Where the BSDF sample ended."""
    weighed: Weighed | None = None
    """None unless asked for, or where all weights are the same."""


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
        found = matte.arrive(world, it, u)
        return Bounce(surface.albedo * found.direct, surface.albedo * found.through, found.next)
    if fast and glossy.applies(world, it, surface):
        known = glossy.arrive(world, it, surface, u, control, guided)
        told = None
        if known.deviation is not None and known.relative is not None and known.wi is not None:
            told = Weighed(known.deviation, known.relative, known.wi)
        return Bounce(known.direct, known.weight, known.next, told)
    frame = shading_frame(it)
    wo = frame.to_local(it.wo)
    reflects = world.reflects(it)

    # Emitter sampling
    light = world.lights.sample(it.p, u[:, :3])
    towards = frame.to_local(light.wi)
    value, bsdf_pdf = world.bsdf.eval_pdf(surface, wo, towards)
    guide = None
    if guided and world.guide is not None:
        guide = _Guided(world.guide, world.guide.rows(it, frame.n), world.bsdf.diffuse_share(surface))
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


@dataclass(frozen=True)
class _Guided:
    """A guide at the lanes of a bounce. It bends the diffuse lobe's samples only; the density is that of both lobes."""

    guide: Guide
    rows: Tensor
    share: float | Tensor

    def excess(self, wi: Tensor) -> Tensor:
        """What the guide adds to the density of local directions [n]; it integrates to 0."""
        return self.share * (wi[:, 2].clamp_min(0.0) * INV_PI) * (self.guide.density(self.rows, wi) - 1.0)

    def warp(self, u: Tensor) -> Tensor:
        """Numbers for the BSDF [n, 3] from uniform ones."""
        by_cosine = u[:, 0] < self.share
        warped = torch.where(by_cosine.unsqueeze(-1), self.guide.warp(self.rows, u[:, 1:]), u[:, 1:])
        return torch.cat((u[:, :1], warped), -1)

    def corrected(self, sample: BSDFSample) -> BSDFSample:
        """The sample with the density that it was really drawn by."""
        pdf = torch.where(sample.pdf > 0, sample.pdf + self.excess(sample.wi), 0.0)
        ratio = torch.where(pdf > 0, sample.pdf / pdf, 0.0)
        return BSDFSample(sample.wi, pdf, sample.weight * ratio.unsqueeze(-1))
