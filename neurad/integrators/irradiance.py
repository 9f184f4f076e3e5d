"""What arrives at surfaces from one light alone."""

from collections.abc import Iterator

import torch
from torch import Tensor

from neurad.core.frame import dot, faceforward
from neurad.core.protocols import Emitter
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.world import World


def irradiance_samples(
    world: World, light: Emitter, si: SurfaceInteraction, count: int, stream: Stream
) -> Iterator[tuple[Tensor, Tensor]]:
    """Unit directions towards a light [n, 3], and the irradiance that each brings [n, 3]: their sum is the light's.

    Args:
        world: what lies in the way; its own lights do not count.
        si: where it arrives, on the side that is looked at [n].
        stream: random numbers, three a point and sample.
    """
    n = faceforward(si)
    for _ in range(count):
        ds = light.sample(si.p, stream.uniform(len(si), 3))
        rays, t_max = world.geometry.spawn_towards(si, ds.wi, ds.distance)
        seen = torch.where(ds.pdf > 0, dot(n, ds.wi).clamp_min(0.0), 0.0) * world.visibility(rays, t_max)
        yield ds.wi, ds.radiance * (seen / (count * ds.pdf.clamp_min(1e-30)))[:, None]
