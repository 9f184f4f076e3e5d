"""The bounce at principled surfaces under area lights, in a few compiled passes instead of some hundred tensor ones.

With the BSDF's two lobes ``albedo d + s`` all that a bounce gives is linear in the albedo and known in closed form, so
the passes find its derivatives as well, and autograd sees one operation. Its twin in plain torch is
:func:`neurad.integrators.vertex.bounce` without ``fast``, which draws the same directions from the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.bsdf.directional import mean_lobes
from neurad.bsdf.principled import Principled, compiled_lobes
from neurad.core.records import Interaction, Rays, Surface
from neurad.emitters.area import AreaLights
from neurad.integrators import bounce_kernels as kernels
from neurad.integrators.bounced import Bounce, Weighed, compilable
from neurad.integrators.guiding import Guided
from neurad.integrators.world import World


def applies(world: World, it: Interaction, surface: Surface) -> bool:
    """Whether the compiled passes do all that a bounce needs: one kind of surface, and fast parts."""
    return (
        compilable(world, it)
        and isinstance(world.bsdf, Principled)
        and world.bsdf.fast
        and (world.guide is None or world.guide.fast)
        and type(surface) is Surface
        and surface.albedo.dtype == torch.float32 == surface.roughness.dtype
    )


def arrive(world: World, it: Interaction, surface: Surface, u: Tensor, control: bool, guided: bool) -> Bounce:
    """One bounce at the lanes of ``it``, with uniform numbers ``u`` [n, 7]; ``control`` asks for ``weighed``."""
    lights, bsdf, geometry, m = world.lights, world.bsdf, world.geometry, len(it)
    assert isinstance(lights, AreaLights)
    assert isinstance(bsdf, Principled)
    p, ng, n, wo, prim, numbers = (x.contiguous().numpy() for x in (it.p, it.ng, it.n, it.wo, it.prim, u))
    roughness = surface.roughness.detach()

    normal, view, towards, way = torch.empty(4, m, 3).unbind()
    sent, source = torch.empty(m, 2), torch.empty(m, dtype=torch.int64)
    kernels.look(
        p, n, wo, numbers, lights.cdf.numpy(), lights.table.numpy(), lights.face.numpy(),
        *(x.numpy() for x in (lights.pdf_area, normal, view, towards, way, sent, source)),
    )  # fmt: skip
    guide = None
    if guided and world.guide is not None:
        guide = Guided(world.guide, world.guide.rows(it, normal), bsdf.diffuse_share(surface))
    asked = _lobes(bsdf, guide, roughness, view, towards)
    wi = bsdf.direction(roughness, view, u[:, 3:6] if guide is None else guide.warp(u[:, 3:6]))
    drawn = _lobes(bsdf, guide, roughness, view, wi)

    reflects = world.reflects(it) & (view[:, 2] > 0)
    o, d, shadow_o, shadow_d, light = torch.empty(5, m, 3).unbind()
    lane, t_max = torch.empty(m, dtype=torch.int64), torch.empty(m)
    count = kernels.send(
        p, ng, prim, reflects.numpy(), geometry.face_offset.numpy(), np.float32(geometry.scale),
        *(x.numpy() for x in (normal, way, sent, source, asked, wi, lights.emission)),
        *(x.numpy() for x in (o, d, lane, shadow_o, shadow_d, t_max, light)),
    )  # fmt: skip
    blocked = world.occluded(Rays(shadow_o[:count], shadow_d[:count]), t_max[:count])
    reached = world.reach(Rays(o, d), u[:, 6])
    end = reached.it

    mean = mean_lobes(roughness, view[:, 2], bsdf.eta) if control else torch.empty(4, 0)
    passed = torch.empty(0, dtype=torch.bool) if reached.passed is None else reached.passed
    through = torch.empty(0, 3) if reached.throughput is None else reached.throughput
    found = _collect(
        m, control, lane[:count], light[:count], blocked, asked, it.p, reflects, surface.albedo.detach(), drawn, mean,
        end.p, end.ng, end.wo, end.prim, end.valid, passed, through, lights.pdf_area, lights.emission,
    )  # fmt: skip
    values = found.values
    if torch.is_grad_enabled() and (surface.albedo.requires_grad or surface.roughness.requires_grad):
        values = _Known.apply(surface.albedo, surface.roughness, found)  # type: ignore[no-untyped-call]
    return Bounce(values[0], values[1], end, Weighed(values[2], found.relative, wi) if len(values) > 2 else None)


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
    kernels.collect(*arrays, *(x.numpy() for x in (values, by_albedo, by_roughness, relative)))
    return _Found(values.unbind(), by_albedo, by_roughness, relative)


def _lobes(bsdf: Principled, guide: Guided | None, roughness: Tensor, wo: Tensor, wi: Tensor) -> Tensor:
    """Rows d, s, pdf, dd/droughness, ds/droughness [5, n], the pdf with the guide's part."""
    out = compiled_lobes(roughness, wo, wi, bsdf.eta, bsdf.specular_share)
    if guide is not None:
        density = guide.guide.density(guide.rows, wi)
        kernels.bend(np.float32(float(guide.share)), wi.numpy(), density.numpy(), out.numpy())
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
                kernels.pull_back(
                    outer, by_albedo[part].numpy(), by_roughness[part].numpy(), albedo.numpy(), roughness.numpy()
                )
        wanted = ctx.needs_input_grad
        return albedo if wanted[0] else None, roughness if wanted[1] else None, None
