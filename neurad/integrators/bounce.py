"""A bounce by whatever does it fastest: the one place that chooses between the reference and its kernels."""

from torch import Tensor

from neurad.core.frame import faceforward
from neurad.core.protocols import SampledBSDF
from neurad.core.records import Surface, SurfaceInteraction
from neurad.integrators import vertex_diffuse, vertex_principled
from neurad.integrators.guide import GuidedBSDF
from neurad.integrators.vertex import Bounce, bounce_reference
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
    numbers, where there are some for the lights, the surfaces and the device.

    Args:
        world: the scene.
        si: vertices [n].
        surface: what they are made of; carries the gradient.
        u: uniform numbers [n, DIMENSIONS].
        sample_stats: compare the weights with their mean, where the BSDF's weights vary.
        guided: draw BSDF samples with the world's guide, where there is one.
        use_kernels: False always takes the reference.
    """
    if vertex_diffuse.has_kernel(use_kernels, world, si):
        return vertex_diffuse.bounce_diffuse(world, si, surface, u)
    if vertex_principled.has_kernel(use_kernels, world, si, surface):
        return vertex_principled.bounce_principled(world, si, surface, u, sample_stats, guided)
    bsdf: SampledBSDF = world.bsdf
    if guided and world.guide is not None:
        bsdf = GuidedBSDF(world.bsdf, world.guide, world.guide.rows(si, faceforward(si)))
    return bounce_reference(world, bsdf, si, surface, u, sample_stats)
