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
from neurad.bsdf.principled import Principled
from neurad.core.records import Interaction, Rays, Surface
from neurad.emitters.area import AreaLights
from neurad.integrators.guiding import Guide
from neurad.integrators.world import World


@dataclass(frozen=True)
class Arrived:
    """One sample of the transport operator at principled vertices, as :class:`neurad.integrators.vertex.Bounce`."""

    direct: Tensor
    weight: Tensor
    next: Interaction
    deviation: Tensor | None
    """None, as the two that follow, unless asked for [n, 3]."""
    relative: Tensor | None
    wi: Tensor | None


def applies(world: World, it: Interaction, surface: Surface) -> bool:
    """Whether the compiled passes do all that a bounce needs: float32 on the CPU, known light, one kind of surface."""
    lights, bsdf = world.lights, world.bsdf
    return (
        type(it) is Interaction  # one that carries more has to hand it on
        and isinstance(lights, AreaLights)
        and isinstance(bsdf, Principled)
        and bsdf.fast
        and type(surface) is Surface
        and (world.guide is None or world.guide.fast)
        and it.p.device.type == "cpu"
        and it.p.dtype == torch.float32 == lights.emission.dtype == surface.albedo.dtype == surface.roughness.dtype
        and not (it.p.requires_grad or lights.emission.requires_grad)
    )


def arrive(world: World, it: Interaction, surface: Surface, u: Tensor, control: bool, guided: bool) -> Arrived:
    """One bounce at the lanes of ``it``, with uniform numbers ``u`` [n, 7]; ``control`` asks for the deviation."""
    from neurad.integrators import bounce_kernels as kernels  # compiled code is loaded by those who use it

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
    guide = world.guide if guided else None
    rows = torch.empty(0, dtype=torch.int64) if guide is None else guide.rows(it, normal)
    asked = _lobes(bsdf, guide, rows, roughness, view, towards)
    wi = bsdf.direction(roughness, view, _warped(bsdf, guide, rows, u[:, 3:6]))
    drawn = _lobes(bsdf, guide, rows, roughness, view, wi)

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

    mean = mean_lobes(roughness, view[:, 2], bsdf.eta) if control and bsdf.deviates else torch.empty(4, 0)
    passed = torch.empty(0, dtype=torch.bool) if reached.passed is None else reached.passed
    through = torch.empty(0, 3) if reached.throughput is None else reached.throughput
    given = reflects, surface.albedo.detach(), drawn, mean, end.p, end.ng, end.wo, end.prim, end.valid, passed, through
    found = _collect(lane[:count], light[:count], blocked, asked, it.p, *given, lights)
    values = found.values
    if torch.is_grad_enabled() and (surface.albedo.requires_grad or surface.roughness.requires_grad):
        values = _Known.apply(surface.albedo, surface.roughness, found)  # type: ignore[no-untyped-call]
    told = (values[2], found.relative, wi) if len(values) > 2 else (None, None, None)
    return Arrived(values[0], values[1], end, *told)


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


def _collect(lane: Tensor, light: Tensor, blocked: Tensor, asked: Tensor, p: Tensor, *rest: Any) -> _Found:
    """What both techniques found; the arguments are those of the kernel."""
    from neurad.integrators import bounce_kernels as kernels

    *given, lights = rest
    m, control = len(p), given[3].shape[1] > 0
    parts = 3 if control else 2
    values, by_albedo, by_roughness = torch.empty(3, parts, m, 3).unbind()
    relative = torch.empty(m if control else 0, 3)
    tensors = lane, light, blocked, asked, p, *given, lights.pdf_area, lights.emission
    arrays = (x.contiguous().numpy() for x in tensors)
    kernels.collect(*arrays, *(x.numpy() for x in (values, by_albedo, by_roughness, relative)))
    return _Found(values.unbind(), by_albedo, by_roughness, relative)


def _warped(bsdf: Principled, guide: Guide | None, rows: Tensor, u: Tensor) -> Tensor:
    """Numbers for the BSDF [n, 3]: those of the diffuse lobe bent by the guide."""
    if guide is None:
        return u
    by_cosine = u[:, :1] < 1.0 - bsdf.specular_share
    return torch.cat((u[:, :1], torch.where(by_cosine, guide.warp(rows, u[:, 1:]), u[:, 1:])), -1)


def _lobes(bsdf: Principled, guide: Guide | None, rows: Tensor, roughness: Tensor, wo: Tensor, wi: Tensor) -> Tensor:
    """Rows d, s, pdf, dd/droughness, ds/droughness [5, n], the pdf with the guide's part."""
    from neurad.integrators import bounce_kernels as kernels

    out = bsdf.lobes_and_slopes(roughness, wo, wi)
    if guide is not None:
        share = np.float32(1.0 - bsdf.specular_share)
        kernels.bend(share, wi.numpy(), guide.density(rows, wi).numpy(), out.numpy())
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
        from neurad.integrators import bounce_kernels as kernels

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
