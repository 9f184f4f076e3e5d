"""The bounce at principled surfaces under area lights, in a few compiled passes instead of some hundred tensor ones.

With the BSDF's two lobes ``albedo d + s`` all that a bounce gives is linear in the albedo and known in closed form, so
the passes find its derivatives as well, and autograd sees one operation. Its twin in plain torch is
:func:`neurad.integrators.vertex.bounce` without ``use_kernels``, which draws the same directions from the same numbers.
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
from neurad.integrators import vertex_kernels as kernels
from neurad.integrators.bounce import Bounce, BSDFSampleStats, compilable
from neurad.integrators.guide import Guided
from neurad.integrators.world import World


def has_kernel(world: World, si: SurfaceInteraction, surface: Surface) -> bool:
    """Whether the compiled passes do all that a bounce needs: one kind of surface, and fast parts."""
    return (
        compilable(world, si)
        and world.bsdf.kernels(surface) is not None
        and (world.guide is None or world.guide.use_kernels)
    )


def bounce_principled(
    world: World, si: SurfaceInteraction, surface: Surface, u: Tensor, control: bool, guided: bool
) -> Bounce:
    """One bounce at the lanes of ``si``, with uniform numbers ``u`` [n, 7]; ``control`` asks for ``sample_stats``."""
    lights, bsdf, geometry, m = world.lights, world.bsdf.kernels(surface), world.geometry, len(si)
    assert isinstance(lights, AreaLights)
    assert bsdf is not None
    p, ng, n, wo, prim, numbers = (x.contiguous().numpy() for x in (si.p, si.ng, si.n, si.wo, si.prim, u))
    roughness = surface.roughness.detach()

    normal, view, towards, ds_d = torch.empty(4, m, 3).unbind()
    ds_dist_pdf, ds_prim = torch.empty(m, 2), torch.empty(m, dtype=torch.int64)
    kernels.sample_emitter(
        p, n, wo, numbers, lights.cdf.numpy(), lights.table.numpy(), lights.face.numpy(),
        *(x.numpy() for x in (lights.pdf_area, normal, view, towards, ds_d, ds_dist_pdf, ds_prim)),
    )  # fmt: skip
    guide = None
    if guided and world.guide is not None:
        guide = Guided(world.guide, world.guide.rows(si, normal), world.bsdf.diffuse_fraction(surface, view))
    bsdf_em = _lobes(bsdf, guide, roughness, view, towards)
    wi = bsdf.direction(roughness, view, u[:, 3:6] if guide is None else guide.warp(u[:, 3:6]))
    bsdf_wi = _lobes(bsdf, guide, roughness, view, wi)

    reflects = world.reflects(si) & (view[:, 2] > 0)
    o, d, shadow_o, shadow_d, light = torch.empty(5, m, 3).unbind()
    lane, t_max = torch.empty(m, dtype=torch.int64), torch.empty(m)
    count = kernels.spawn_rays_principled(
        p, ng, prim, reflects.numpy(), geometry.face_offset.numpy(), np.float32(geometry.scale),
        *(x.numpy() for x in (normal, ds_d, ds_dist_pdf, ds_prim, bsdf_em, wi, lights.emission)),
        *(x.numpy() for x in (o, d, lane, shadow_o, shadow_d, t_max, light)),
    )  # fmt: skip
    blocked = world.occluded(Rays(shadow_o[:count], shadow_d[:count]), t_max[:count])
    reached = world.trace_past_delta(Rays(o, d), u[:, 6])
    end = reached.si

    mean = bsdf.mean_lobes(roughness, view[:, 2]) if control else torch.empty(4, 0)
    via_delta = torch.empty(0, dtype=torch.bool) if reached.via_delta is None else reached.via_delta
    through = torch.empty(0, 3) if reached.throughput is None else reached.throughput
    found = _collect(
        m, control, lane[:count], light[:count], blocked, bsdf_em, si.p, reflects, surface.albedo.detach(), bsdf_wi,
        mean, end.p, end.ng, end.wo, end.prim, end.valid, via_delta, through, lights.pdf_area, lights.emission,
    )  # fmt: skip
    values = found.values
    if torch.is_grad_enabled() and (surface.albedo.requires_grad or surface.roughness.requires_grad):
        values = _Known.apply(surface.albedo, surface.roughness, found)  # type: ignore[no-untyped-call]
    return Bounce(
        values[0], values[1], end, BSDFSampleStats(values[2], found.relative, wi) if len(values) > 2 else None
    )


@dataclass(frozen=True)
class _Found:
    """What a bounce gives, and its derivatives."""

    values: tuple[Tensor, ...]
    """Direct light, weight and, with a control variate, the weight's deviation from its mean, each [n, 3]."""
    by_albedo: Tensor
    """Derivatives by the albedo's same channel [2 or 3, n, 3]."""
    by_roughness: Tensor
    """Derivatives by the roughness [2 or 3, n, 3]."""
    relative: Tensor
    """Weight over its mean [n, 3]; empty without a control variate."""


def _collect(m: int, control: bool, *given: Tensor) -> _Found:
    """What both techniques found at ``m`` vertices, with or without a control variate; ``given`` is what the kernel
    reads.
    """
    values, by_albedo, by_roughness = torch.empty(3, 3 if control else 2, m, 3).unbind()
    relative = torch.empty(m if control else 0, 3)
    arrays = (x.contiguous().numpy() for x in given)
    kernels.resolve_hits_principled(*arrays, *(x.numpy() for x in (values, by_albedo, by_roughness, relative)))
    return _Found(values.unbind(), by_albedo, by_roughness, relative)


def _lobes(bsdf: LobeKernels, guide: Guided | None, roughness: Tensor, wo: Tensor, wi: Tensor) -> Tensor:
    """Rows d, s, pdf, dd/droughness, ds/droughness [5, n], the pdf with the guide's part."""
    out = bsdf.lobes(roughness, wo, wi)
    if guide is not None:
        density = guide.guide.density(guide.rows, wi)
        kernels.add_guide_pdf(np.float32(float(guide.share)), wi.numpy(), density.numpy(), out.numpy())
    return out


class _Known(torch.autograd.Function):
    """Values whose derivatives by albedo, channel by channel, and roughness are known."""

    @staticmethod
    def forward(ctx: Any, albedo: Tensor, roughness: Tensor, found: _Found) -> tuple[Tensor, ...]:
        ctx.slopes = found.by_albedo, found.by_roughness
        ctx.set_materialize_grads(False)
        return found.values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        by_albedo, by_roughness = ctx.slopes
        albedo, roughness = torch.zeros(by_albedo.shape[1:]), torch.zeros(by_albedo.shape[1], 1)
        for part, gradient in enumerate(gradients):
            if gradient is not None:
                outer = gradient.contiguous().numpy()
                kernels.vjp(
                    outer, by_albedo[part].numpy(), by_roughness[part].numpy(), albedo.numpy(), roughness.numpy()
                )
        wanted = ctx.needs_input_grad
        return albedo if wanted[0] else None, roughness if wanted[1] else None, None
