"""A bounce by whatever does it fastest: the one place that chooses between the reference and its kernels."""

from dataclasses import replace

import torch
from torch import Tensor

from neurad.core.frame import faceforward
from neurad.core.protocols import SampledBSDF
from neurad.core.records import Surface, SurfaceInteraction
from neurad.integrators import vertex_diffuse, vertex_principled
from neurad.integrators.guide import GuidedBSDF
from neurad.integrators.vertex import Bounce, bounce_reference, shading_frame
from neurad.integrators.world import World


def bounce(
    world: World,
    si: SurfaceInteraction,
    surface: Surface,
    u: Tensor,
    sample_stats: bool = False,
    guided: bool = True,
    use_kernels: bool = True,
) -> Bounce:
    """:func:`neurad.integrators.vertex.bounce_reference`, or kernels that draw the same directions from the same
    numbers, where there are some for the lights, the surfaces and the device; and the light of a flash.

    Args:
        guided: draw BSDF samples with the world's guide, where there is one.
        use_kernels: False always takes the reference.
    """
    if world.flash is not None and si.flash is not None:
        found = bounce(world, replace(si, flash=None), surface, u, sample_stats, guided, use_kernels)
        return with_flash(world, si, surface, found)
    if vertex_diffuse.has_kernel(use_kernels, world, si):
        return vertex_diffuse.bounce_diffuse(world, si, surface, u)
    if vertex_principled.has_kernel(use_kernels, world, si, surface):
        return vertex_principled.bounce_principled(world, si, surface, u, sample_stats, guided)
    bsdf: SampledBSDF = world.bsdf
    if guided and world.guide is not None:
        bsdf = GuidedBSDF(world.bsdf, world.guide, world.guide.rows(si, faceforward(si)))
    return bounce_reference(world, bsdf, si, surface, u, sample_stats)


def with_flash(world: World, si: SurfaceInteraction, surface: Surface, found: Bounce) -> Bounce:
    """A bounce at ``si`` [n] with what the flash of its photograph adds to the direct light, ``f cos I / d^2`` where
    nothing lies in between; where the BSDF sample ended the same flash shines.
    """
    flash = si.flash
    assert world.flash is not None
    assert flash is not None
    assert flash.wi is not None
    assert flash.arriving is not None
    frame = shading_frame(si)
    if found.albedo is not None:
        surface = replace(surface, albedo=torch.ones_like(surface.albedo))
    value = world.bsdf.eval(surface, frame.to_local(si.wo), frame.to_local(flash.wi))  # f cos [n, 3]
    irradiance = world.flash.factor() * flash.intensity * (flash.arriving * world.reflects(si)).unsqueeze(-1)
    direct = found.direct_demodulated + value * irradiance
    return replace(found, direct_demodulated=direct, next=world.flashed(found.next, flash))
