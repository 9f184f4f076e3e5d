"""The bounce of scenes where every surface is Lambertian and every light is a triangle: no frame, no lobe, no choice.

The value of such a bounce is the albedo times what arrives, and its weight is the albedo, so all of it but this factor
is done by two compiled passes, one before the rays are cast and one after. Its twin in plain torch is
:func:`neurad.integrators.vertex.bounce` without ``use_kernels``, which draws the same directions from the same numbers.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import Rays, Surface, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.integrators import vertex_kernels as kernels
from neurad.integrators.bounce import Bounce, compilable
from neurad.integrators.world import World
from neurad.runtime.threads import GRAIN, split


def has_kernel(world: World, si: SurfaceInteraction) -> bool:
    """Whether the compiled passes do all that a bounce in ``world`` needs."""
    return compilable(world, si) and world.bsdf.lambertian and world.delta is None and world.guide is None


def bounce_diffuse(world: World, si: SurfaceInteraction, surface: Surface, u: Tensor) -> Bounce:
    """One bounce at the lanes of ``si``, with uniform numbers ``u`` [n, 7]."""
    lights, geometry, m = world.lights, world.geometry, len(si)
    assert isinstance(lights, AreaLights)
    p, ng, n, wo, prim = (x.contiguous().numpy() for x in (si.p, si.ng, si.n, si.wo, si.prim))
    emission, pdf_area = lights.emission.numpy(), lights.pdf_area.numpy()
    o, d, shadow_o, shadow_d, light = torch.empty(5, m, 3).unbind()
    (pdf, t_max), lane = torch.empty(2, m), torch.empty(m, dtype=torch.int64)
    shadow = lane, shadow_o, shadow_d, t_max, light
    leaving = (
        p, ng, n, wo, prim, world.reflects(si).numpy(), u.contiguous().numpy(), geometry.face_offset.numpy(),
        np.float32(geometry.scale), lights.cdf.numpy(), lights.table.numpy(), lights.face.numpy(), pdf_area, emission,
        o.numpy(), d.numpy(), pdf.numpy(), *(x.numpy() for x in shadow),
    )  # fmt: skip
    counts = split(lambda low, high: (low, kernels.spawn_rays_diffuse(low, high, *leaving)), m, GRAIN)
    lane, shadow_o, shadow_d, t_max, light = _joined(shadow, counts)
    blocked = world.occluded(Rays(shadow_o, shadow_d), t_max)
    end = world.intersect(Rays(o, d))
    direct, through = torch.empty(2, m, 3).unbind()
    end_p, end_ng, end_wo, end_prim = (x.contiguous().numpy() for x in (end.p, end.ng, end.wo, end.prim))
    arriving = (
        lane.numpy(), light.numpy(), blocked.numpy(), p, pdf.numpy(), end_p, end_ng, end_wo, end_prim,
        end.valid.numpy(), pdf_area, emission, direct.numpy(), through.numpy(),
    )  # fmt: skip
    split(lambda low, high: kernels.resolve_hits_diffuse(low, high, *arriving), m, GRAIN)
    return Bounce(direct, through, end, albedo=surface.albedo)


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
