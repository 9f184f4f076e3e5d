"""The bounce at principled surfaces under area lights, in a few kernels instead of some hundred tensor operations.

With the BSDF's two lobes ``albedo d + s`` all that a bounce gives is linear in the albedo and known in closed form, so
the kernels find its derivatives as well, and autograd sees one operation. Its reference is
:func:`neurad.integrators.vertex.bounce_reference`, which draws the same directions from the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.core.protocols import LobeKernels
from neurad.core.records import Rays, Surface, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.integrators import vertex_principled_kernels as kernels
from neurad.integrators.guide import Guided
from neurad.integrators.vertex import Bounce, BSDFSampleStats
from neurad.integrators.vertex_kernels_shared import RayArrays, ShadowRays, Triangles, Vertices, reads
from neurad.integrators.world import NonDeltaHit, World


def has_kernel(enabled: bool, world: World, si: SurfaceInteraction, surface: Surface) -> bool:
    """Whether the kernels do all that a bounce needs: one kind of surface, and parts with kernels of their own."""
    return (
        reads(enabled, world, si)
        and world.bsdf.kernels(surface) is not None
        and (world.guide is None or world.guide.use_kernels)
    )


def bounce_principled(
    world: World, si: SurfaceInteraction, surface: Surface, u: Tensor, sample_stats: bool, guided: bool
) -> Bounce:
    """One bounce at the lanes of ``si`` [n], with uniform numbers ``u`` [n, DIMENSIONS]; the arguments are those of
    :func:`~neurad.integrators.vertex.bounce_reference`.
    """
    assert isinstance(world.lights, AreaLights)
    bsdf, geometry, n = world.bsdf.kernels(surface), world.geometry, len(si)
    assert bsdf is not None
    vertices, lights = Vertices.of(si), Triangles.of(world.lights)
    roughness = surface.roughness.detach()  # [n, 1]

    # ---------------------- Frames and emitter sampling ----------------------

    normal, wo, wi_em, ds_d = torch.empty(4, n, 3).unbind()
    ds_dist_pdf, ds_prim = torch.empty(n, 2), torch.empty(n, dtype=torch.int64)
    local = kernels.LocalSamples(*(x.numpy() for x in (normal, wo, wi_em, ds_d, ds_dist_pdf, ds_prim)))
    kernels.sample_emitter(vertices, u.contiguous().numpy(), lights, local)

    # ---------------------- BSDF towards the lights, BSDF sampling ----------------------

    guide = None
    if guided and world.guide is not None:
        guide = Guided(world.guide, world.guide.rows(si, normal), world.bsdf.diffuse_fraction(surface, wo))
    bsdf_em = _lobes(bsdf, guide, roughness, wo, wi_em)  # [5, n]
    wi = bsdf.direction(roughness, wo, u[:, 3:6] if guide is None else guide.warp(u[:, 3:6]))  # [n, 3]
    bsdf_wi = _lobes(bsdf, guide, roughness, wo, wi)  # [5, n]

    # ---------------------- Rays of both techniques ----------------------

    active = world.reflects(si) & (wo[:, 2] > 0)  # [n]
    o, d, shadow_o, shadow_d, radiance = torch.empty(5, n, 3).unbind()
    lane, t_max = torch.empty(n, dtype=torch.int64), torch.empty(n)
    shadow = lane, shadow_o, shadow_d, t_max, radiance
    count = kernels.spawn_rays_principled(
        vertices, active.numpy(), geometry.face_offset.numpy(), np.float32(geometry.scale), local, bsdf_em.numpy(),
        wi.numpy(), lights.emission, RayArrays(o.numpy(), d.numpy()), ShadowRays(*(x.numpy() for x in shadow)),
    )  # fmt: skip
    lane, shadow_o, shadow_d, t_max, radiance = (x[:count] for x in shadow)  # [k, ...]

    # ---------------------- Tracing ----------------------

    blocked = world.occluded(Rays(shadow_o, shadow_d), t_max)  # [k]
    hit = world.trace_past_delta(Rays(o, d), u[:, 6])

    # ---------------------- Light that both found, joined by MIS ----------------------

    mean = bsdf.mean_lobes(roughness, wo[:, 2]) if sample_stats else torch.empty(4, 0)
    found = _resolve_hits(
        hit, lights, ShadowRays(*(x.numpy() for x in (lane, shadow_o, shadow_d, t_max, radiance))), blocked.numpy(),
        bsdf_em.numpy(), vertices.p, active.numpy(), surface.albedo.detach().contiguous().numpy(), bsdf_wi.numpy(),
        mean.numpy(),
    )  # fmt: skip
    values = found.values
    if torch.is_grad_enabled() and (surface.albedo.requires_grad or surface.roughness.requires_grad):
        values = _KnownDerivatives.apply(surface.albedo, surface.roughness, found)  # type: ignore[no-untyped-call]
    stats = BSDFSampleStats(values[2], found.relative, wi) if sample_stats else None
    return Bounce(values[0], values[1], hit.si, stats)


@dataclass(frozen=True)
class _Found:
    """What a bounce gives, and its derivatives."""

    values: tuple[Tensor, ...]
    """Direct light, weight and, with statistics, the weight's deviation from its mean, each [n, 3]."""
    by_albedo: Tensor
    """Derivatives by the albedo's same channel [2 or 3, n, 3]."""
    by_roughness: Tensor
    """Derivatives by the roughness [2 or 3, n, 3]."""
    relative: Tensor
    """Weight over its mean [n, 3]; empty without statistics."""


def _resolve_hits(hit: NonDeltaHit, lights: Triangles, *given: Any) -> _Found:
    """What both techniques found where BSDF samples ended at ``hit``; ``given`` is what the kernel reads beside it, the
    means of the lobes last.
    """
    n, rows = len(hit.si), 3 if given[-1].shape[1] > 0 else 2
    via_delta = torch.empty(0, dtype=torch.bool) if hit.via_delta is None else hit.via_delta
    throughput = torch.empty(0, 3) if hit.throughput is None else hit.throughput
    delta = kernels.DeltaChains(via_delta.numpy(), throughput.contiguous().numpy())
    values, by_albedo, by_roughness = torch.empty(3, rows, n, 3).unbind()
    relative = torch.empty(n if rows == 3 else 0, 3)
    out = kernels.Derivatives(*(x.numpy() for x in (values, by_albedo, by_roughness, relative)))
    arrays: list[Any] = [*given, Vertices.of(hit.si), delta, lights, out]
    kernels.resolve_hits_principled(*arrays)
    return _Found(values.unbind(), by_albedo, by_roughness, relative)


def _lobes(bsdf: LobeKernels, guide: Guided | None, roughness: Tensor, wo: Tensor, wi: Tensor) -> Tensor:
    """Rows d, s, pdf, dd/droughness, ds/droughness [5, n], the pdf with the guide's part."""
    out = bsdf.lobes(roughness, wo, wi)
    if guide is not None:
        density = guide.guide.density(guide.rows, wi)
        fraction = np.asarray(guide.fraction, np.float32).reshape(-1)
        kernels.add_guide_pdf(fraction, wi.numpy(), density.numpy(), out.numpy())
    return out


class _KnownDerivatives(torch.autograd.Function):
    """Values whose derivatives by albedo, channel by channel, and roughness are known."""

    @staticmethod
    def forward(ctx: Any, albedo: Tensor, roughness: Tensor, found: _Found) -> tuple[Tensor, ...]:
        ctx.derivatives = found.by_albedo, found.by_roughness
        ctx.set_materialize_grads(False)
        return found.values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        by_albedo, by_roughness = ctx.derivatives
        albedo, roughness = torch.zeros(by_albedo.shape[1:]), torch.zeros(by_albedo.shape[1], 1)
        for row, gradient in enumerate(gradients):
            if gradient is not None:
                outer = gradient.contiguous().numpy()
                kernels.vjp(outer, by_albedo[row].numpy(), by_roughness[row].numpy(), albedo.numpy(), roughness.numpy())
        wanted = ctx.needs_input_grad
        return albedo if wanted[0] else None, roughness if wanted[1] else None, None
