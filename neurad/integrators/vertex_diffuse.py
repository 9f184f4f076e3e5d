"""The bounce of scenes where every surface is Lambertian and every light is a triangle: no frame, no lobe, no choice.

The value of such a bounce is the albedo times what arrives, and its weight is the albedo, so all of it but this factor
is done by two kernels, one before the rays are cast and one after. Its reference is
:func:`neurad.integrators.vertex.bounce_reference`, which draws the same directions from the same numbers.
"""

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import Rays, Surface, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.integrators import vertex_diffuse_kernels as kernels
from neurad.integrators.lamp_gradient import by_lamps, found_light
from neurad.integrators.vertex import Bounce
from neurad.integrators.vertex_kernels_shared import RayArrays, ShadowRays, Triangles, Vertices, reads
from neurad.integrators.world import World
from neurad.runtime.threads import GRAIN, split


def has_kernel(enabled: bool, world: World, si: SurfaceInteraction) -> bool:
    """Whether the kernels do all that a bounce in ``world`` needs."""
    return reads(enabled and world.bsdf.is_diffuse and world.delta is None and world.guide is None, world, si)


def bounce_diffuse(world: World, si: SurfaceInteraction, surface: Surface, u: Tensor) -> Bounce:
    """One bounce at the lanes of ``si`` [n], with uniform numbers ``u`` [n, DIMENSIONS]."""
    assert isinstance(world.lights, AreaLights)
    geometry, n = world.geometry, len(si)
    vertices, lights = Vertices.of(si), Triangles.of(world.lights)

    # ---------------------- Rays of both techniques ----------------------

    o, d, shadow_o, shadow_d, radiance = torch.empty(5, n, 3).unbind()
    (pdf, t_max), lane = torch.empty(2, n), torch.empty(n, dtype=torch.int64)
    shadow = lane, shadow_o, shadow_d, t_max, radiance
    spawned = (
        vertices, world.reflects(si).numpy(), u.contiguous().numpy(), geometry.face_offset.numpy(),
        np.float32(geometry.scale), lights, RayArrays(o.numpy(), d.numpy()), pdf.numpy(),
        ShadowRays(*(x.numpy() for x in shadow)),
    )  # fmt: skip
    counts = split(lambda low, high: (low, kernels.spawn_rays_diffuse(low, high, *spawned)), n, GRAIN)
    lane, shadow_o, shadow_d, t_max, radiance = _joined(shadow, counts)  # [k, ...]

    # ---------------------- Tracing ----------------------

    blocked = world.tracer.occluded(Rays(shadow_o, shadow_d), t_max)  # [k]
    end = world.intersect(Rays(o, d))

    # ---------------------- Light that both found, joined by MIS ----------------------

    direct, weight = torch.empty(2, n, 3).unbind()
    resolved = (
        ShadowRays(*(x.numpy() for x in (lane, shadow_o, shadow_d, t_max, radiance))), blocked.numpy(), vertices.p,
        pdf.numpy(), Vertices.of(end), lights, direct.numpy(), weight.numpy(),
    )  # fmt: skip
    split(lambda low, high: kernels.resolve_hits_diffuse(low, high, *resolved), n, GRAIN)
    if isinstance(world.lights, FittedLamps) and world.lights.trains:
        shown = lane[~blocked], radiance[~blocked]
        direct = by_lamps(world.lights, direct, found_light(world, si, u, shown, pdf, end, weight))
    return Bounce(direct, weight, end, albedo=surface.albedo)


def _joined(arrays: tuple[Tensor, ...], parts: list[tuple[int, int]]) -> list[Tensor]:
    """The rows of ``arrays`` that ``parts`` (where one begins, how many it has) name, moved together to the front."""
    filled = 0
    for low, count in parts:
        if low > filled:
            for array in arrays:
                rows = array.numpy()  # which copies on this thread, also where the two overlap
                rows[filled : filled + count] = rows[low : low + count]
        filled += count
    return [array[:filled] for array in arrays]
