"""The bounce of scenes where every surface is Lambertian and every light is a triangle: no frame, no lobe, no choice.

The value of such a bounce is the albedo times what arrives, and its weight is the albedo, so all of it but this factor
is done by two kernels, one before the rays are cast and one after. Its reference is
:func:`neurad.integrators.vertex.bounce_reference`, which draws the same directions from the same numbers.
"""

import math

import numpy as np
import torch
from torch import Tensor

from neurad.bsdf.sampling_kernels import concentric_disk
from neurad.core.records import BoolArray, FloatArray, Rays, Surface, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.integrators.lamp_gradient import by_lamps, found_light
from neurad.integrators.vertex import Bounce
from neurad.integrators.vertex_kernels_shared import (
    INV_PI,
    ONE,
    ZERO,
    ShadowRays,
    Triangles,
    Vertices,
    dot,
    emitter_pdf,
    pick_triangle,
    ray_offset,
    reads,
    sample_triangle,
    spawn_ray,
    spawn_shadow_ray,
)
from neurad.integrators.world import World
from neurad.runtime.jit import kernel
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
        np.float32(geometry.scale), lights, o.numpy(), d.numpy(), pdf.numpy(),
        ShadowRays(*(x.numpy() for x in shadow)),
    )  # fmt: skip
    counts = split(lambda low, high: (low, spawn_rays_diffuse(low, high, *spawned)), n, GRAIN)
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
    split(lambda low, high: resolve_hits_diffuse(low, high, *resolved), n, GRAIN)
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


@kernel
def spawn_rays_diffuse(
    low: int, high: int,
    vertices: Vertices, reflects: BoolArray, u: FloatArray, face_offset: FloatArray, radius: np.float32,
    lights: Triangles, o: FloatArray, d: FloatArray, pdf: FloatArray, shadow: ShadowRays,
) -> int:  # fmt: skip  # pragma: no cover - compiled
    """Rays that leave Lambertian vertices ``low .. high - 1``: one by the cosine from each, and one to a light where
    light could come.

    Args:
        vertices: all [m].
        reflects: whether they reflect towards ``wo`` [m].
        u: uniform numbers of the bounce [m, 7].
        face_offset: the geometry's offsets [F].
        radius: the geometry's scale.
        o, d: filled with the rays of the BSDF samples [m, 3].
        pdf: filled with their densities, 0 where nothing is reflected [m].
        shadow: filled from ``low`` on, for albedo 1.

    Returns:
        The number of shadow rays.
    """
    p, ng, n, wo, prim, _ = vertices
    count = low
    for i in range(low, high):
        # Frame: the shading normal on the viewer's side
        px, py, pz = p[i, 0], p[i, 1], p[i, 2]
        x, y, z = n[i, 0], n[i, 1], n[i, 2]
        toward = dot(x, y, z, wo[i, 0], wo[i, 1], wo[i, 2])
        if toward < ZERO:
            x, y, z = -x, -y, -z
        use = reflects[i] and toward != ZERO
        offset = ray_offset(px, py, pz, face_offset[max(prim[i], 0)], radius)

        # Emitter sampling
        if use:
            chosen = pick_triangle(lights.cdf, u[i, 2])
            f = lights.face[chosen]
            wx, wy, wz, distance, pdf_em = sample_triangle(
                px, py, pz, lights.table[chosen], lights.pdf_area[f], u[i, 0], u[i, 1]
            )  # fmt: skip
            bsdf_pdf = dot(wx, wy, wz, x, y, z) * INV_PI
            if bsdf_pdf > ZERO and pdf_em > ZERO:
                shadow.lane[count] = i
                shadow.t_max[count] = spawn_shadow_ray(
                    p[i], ng[i], wx, wy, wz, distance, offset, shadow.o[count], shadow.d[count]
                )  # fmt: skip
                scale = bsdf_pdf / (pdf_em + bsdf_pdf)  # value * MIS weight / pdf
                for k in range(3):
                    shadow.radiance[count, k] = lights.emission[f, k] * scale
                count += 1

        # BSDF sampling, by the cosine
        c0, c1 = concentric_disk(u[i, 4], u[i, 5])
        c2 = np.float32(math.sqrt(max(ONE - (c0 * c0 + c1 * c1), ZERO)))
        spawn_ray(p[i], ng[i], x, y, z, c0, c1, c2, offset, o[i], d[i])
        pdf[i] = c2 * INV_PI if use else ZERO
    return count - low


@kernel
def resolve_hits_diffuse(
    low: int, high: int,
    shadow: ShadowRays, blocked: BoolArray, p: FloatArray, pdf: FloatArray, ends: Vertices, lights: Triangles,
    direct: FloatArray, weight: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """What both techniques found at vertices ``low .. high - 1``, joined by MIS.

    Args:
        shadow: rays to lights [k].
        blocked: whether they met something [k].
        p: vertices [m, 3].
        pdf: of their BSDF samples [m].
        ends: where these ended [m].
        direct: filled with the light of both techniques, for albedo 1 [m, 3].
        weight: filled with the weight of the BSDF sample, for albedo 1 [m, 3].
    """
    # BSDF sampling: light where the samples ended
    for i in range(low, high):
        direct[i, 0], direct[i, 1], direct[i, 2] = ZERO, ZERO, ZERO
        own = ONE if pdf[i] > ZERO else ZERO
        weight[i, 0], weight[i, 1], weight[i, 2] = own, own, own
        if pdf[i] > ZERO and ends.valid[i]:
            f = ends.prim[i]
            pdf_em = emitter_pdf(f, ends.ng[i], ends.wo[i], ends.p[i], p[i], lights.pdf_area, lights.emission)
            if pdf_em >= ZERO:
                mis = pdf[i] / (pdf[i] + pdf_em)
                for k in range(3):
                    direct[i, k] = lights.emission[f, k] * mis

    # Emitter sampling: what unoccluded shadow rays carry
    for j in range(np.searchsorted(shadow.lane, low), np.searchsorted(shadow.lane, high)):
        if not blocked[j]:
            for k in range(3):
                direct[shadow.lane[j], k] += shadow.radiance[j, k]
