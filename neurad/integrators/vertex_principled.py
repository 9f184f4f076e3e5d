"""The bounce at principled surfaces under area lights, in a few kernels instead of some hundred tensor operations.

With the BSDF's two lobes ``albedo d + s`` all that a bounce gives is linear in the albedo and known in closed form, so
the kernels find its derivatives as well, and autograd sees one operation. Its reference is
:func:`neurad.integrators.vertex.bounce_reference`, which draws the same directions from the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.core.protocols import LobeKernels
from neurad.core.records import Rays, Surface, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.integrators import vertex_principled_kernels as kernels
from neurad.integrators.guide import Guided
from neurad.integrators.lamp_gradient import FoundLight, by_lamps, found_light
from neurad.integrators.vertex import Bounce, BSDFSampleStats
from neurad.integrators.vertex_kernels_shared import ShadowRays, Triangles, Vertices, reads
from neurad.integrators.world import World
from neurad.runtime.threads import split

GRAIN_LANES = 4096
"""Lanes of a bounce, its rays included, that are worth a thread: about 2 ms of work, as parts wait for each other's
Python, some 1.5 ms in all.
"""


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
    fixed, n = surface.detach(), len(si)
    # Derivatives are found by the roughness always, by other scalars where these have a graph.
    derived = [surface.albedo, *(x for i, x in enumerate(surface.scalars) if i == 0 or x.requires_grad)]
    lamps = world.lights if isinstance(world.lights, FittedLamps) and world.lights.trains else None

    @torch.no_grad()  # a thread has its own mode
    def part(low: int, high: int) -> _Found:
        here = slice(low, high)
        given = (si, fixed, u) if high - low == n else (si[here], fixed[here], u[here])
        return _bounce(world, *given, len(derived) - 1, sample_stats, guided, low if lamps is not None else None)

    lobes = world.bsdf.kernels(surface)
    # Chains of smooth surfaces are counted, by one thread.
    splits = world.delta is None and lobes is not None and lobes.takes_any_lanes
    found = _Found.joined(split(part, n, GRAIN_LANES if splits else n))
    values = found.values
    if torch.is_grad_enabled() and any(x.requires_grad for x in derived):
        values = _KnownDerivatives.apply(found, *derived)  # type: ignore[no-untyped-call]
    direct = values[0] if lamps is None else by_lamps(lamps, values[0], found.light)
    stats = BSDFSampleStats(values[2], found.relative, found.wi) if sample_stats else None
    return Bounce(direct, values[1], found.next, stats)


def _bounce(
    world: World, si: SurfaceInteraction, surface: Surface, u: Tensor, scalars: int, sample_stats: bool, guided: bool,
    first: int | None,
) -> _Found:  # fmt: skip
    """Lanes of a bounce, with derivatives by the first ``scalars`` scalar parameters. ``first`` is the number of the
    first lane where it is asked which light came from which lamp.
    """
    assert isinstance(world.lights, AreaLights)
    bsdf, geometry, n = world.bsdf.kernels(surface), world.geometry, len(si)
    assert bsdf is not None
    vertices, lights = Vertices.of(si), Triangles.of(world.lights)

    # ---------------------- Frames and emitter sampling ----------------------

    normal, wo, wi_em, ds_d = torch.empty(4, n, 3).unbind()
    ds_dist_pdf, ds_prim = torch.empty(n, 2), torch.empty(n, dtype=torch.int64)
    local = kernels.LocalSamples(*(x.numpy() for x in (normal, wo, wi_em, ds_d, ds_dist_pdf, ds_prim)))
    kernels.sample_emitter(vertices, u.contiguous().numpy(), lights, local)

    # ---------------------- BSDF towards the lights, BSDF sampling ----------------------

    guide = None
    if guided and world.guide is not None:
        guide = Guided(world.guide, world.guide.rows(si, normal), world.bsdf.diffuse_fraction(surface, wo))
    bsdf_em = _lobes(bsdf, guide, surface, wo, wi_em)  # [3 + 2 scalars, n]
    wi = bsdf.direction(surface, wo, u[:, 3:6] if guide is None else guide.warp(u[:, 3:6]))  # [n, 3]
    bsdf_wi = _lobes(bsdf, guide, surface, wo, wi)  # [3 + 2 scalars, n]

    # ---------------------- Rays of both techniques ----------------------

    active = world.reflects(si) & (wo[:, 2] > 0)  # [n]
    o, d, shadow_o, shadow_d, radiance = torch.empty(5, n, 3).unbind()
    lane, t_max = torch.empty(n, dtype=torch.int64), torch.empty(n)
    shadow = lane, shadow_o, shadow_d, t_max, radiance
    count = kernels.spawn_rays_principled(
        vertices, active.numpy(), geometry.face_offset.numpy(), np.float32(geometry.scale), local, bsdf_em.numpy(),
        wi.numpy(), lights.emission, o.numpy(), d.numpy(), ShadowRays(*(x.numpy() for x in shadow)),
    )  # fmt: skip
    lane, shadow_o, shadow_d, t_max, radiance = (x[:count] for x in shadow)  # [k, ...]

    # ---------------------- Tracing ----------------------

    visible = world.visibility(Rays(shadow_o, shadow_d), t_max)  # [k]
    blocked = visible == 0.0
    if world.delta is not None:
        radiance *= visible.unsqueeze(-1)
    hit = world.trace_past_delta(Rays(o, d), u[:, 6])

    # ---------------------- Light that both found, joined by MIS ----------------------

    mean = bsdf.mean_lobes(surface, wo[:, 2]) if sample_stats else torch.empty(4, 0)
    rows = 3 if sample_stats else 2
    via_delta = torch.empty(0, dtype=torch.bool) if hit.via_delta is None else hit.via_delta
    throughput = torch.empty(0, 3) if hit.throughput is None else hit.throughput
    values, by_albedo = torch.empty(2, rows, n, 3).unbind()
    by_scalars, relative = torch.empty(rows, scalars, n, 3), torch.empty(n if sample_stats else 0, 3)
    kernels.resolve_hits_principled(
        ShadowRays(*(x.numpy() for x in (lane, shadow_o, shadow_d, t_max, radiance))), blocked.numpy(),
        bsdf_em.numpy(), vertices.p, active.numpy(), surface.albedo.contiguous().numpy(), bsdf_wi.numpy(), mean.numpy(),
        Vertices.of(hit.si), via_delta.numpy(), throughput.contiguous().numpy(), lights,
        kernels.Derivatives(*(x.numpy() for x in (values, by_albedo, by_scalars, relative))),
    )  # fmt: skip
    found = _Found(hit.si, wi, values, by_albedo, by_scalars, relative)
    if first is None:
        return found
    lane = lane[~blocked]
    bsdf_value = surface.albedo[lane] * bsdf_em[0, lane, None] + bsdf_em[1, lane, None]  # f cos [k, 3]
    shown = lane, bsdf_value * radiance[~blocked]
    light = found_light(world, si, u, shown, bsdf_wi[2], hit.si, found.values[1], hit.via_delta)
    return replace(found, light=[replace(x, lane=x.lane + first) for x in light])


@dataclass(frozen=True)
class _Found:
    """What a bounce gives, and its derivatives."""

    next: SurfaceInteraction
    """Where BSDF samples ended [n]."""
    wi: Tensor
    """Their directions, local [n, 3]."""
    values: Tensor
    """Direct light, weight and, with statistics, the weight's deviation from its mean [2 or 3, n, 3]."""
    by_albedo: Tensor
    """Derivatives by the albedo's same channel [2 or 3, n, 3]."""
    by_scalars: Tensor
    """Derivatives by the scalar parameters, the roughness first [2 or 3, scalars, n, 3]."""
    relative: Tensor
    """Weight over its mean [n, 3]; empty without statistics."""
    light: Sequence[FoundLight] = ()
    """Where direct light came from, where that is asked."""

    @classmethod
    def joined(cls, parts: list[_Found]) -> _Found:
        """All lanes of parts that follow each other."""
        if len(parts) == 1:
            return parts[0]
        lanes = {"wi": 0, "values": 1, "by_albedo": 1, "by_scalars": 2, "relative": 0}
        tensors = {name: torch.cat([getattr(part, name) for part in parts], axis) for name, axis in lanes.items()}
        ends = SurfaceInteraction.cat(*(part.next for part in parts))
        return cls(ends, **tensors, light=[light for part in parts for light in part.light])


def _lobes(bsdf: LobeKernels, guide: Guided | None, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
    """Rows d, s, pdf, then dd/dx and ds/dx by each scalar parameter x [3 + 2 scalars, n], the pdf with the guide's
    part.
    """
    out = bsdf.lobes(surface, wo, wi)
    if guide is not None:
        guide.add_pdf(wi, out[2])
    return out


class _KnownDerivatives(torch.autograd.Function):
    """Values whose derivatives by albedo, channel by channel, and scalar parameters are known."""

    @staticmethod
    def forward(ctx: Any, found: _Found, albedo: Tensor, *scalars: Tensor) -> tuple[Tensor, ...]:
        ctx.derivatives = found.by_albedo, found.by_scalars
        ctx.set_materialize_grads(False)
        return found.values.unbind()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        by_albedo, by_scalars = ctx.derivatives
        albedo, scalars = torch.zeros(by_albedo.shape[1:]), torch.zeros(*by_scalars.shape[1:3], 1)
        for row, gradient in enumerate(gradients):
            if gradient is not None:
                outer = gradient.contiguous().numpy()
                kernels.vjp(outer, by_albedo[row].numpy(), by_scalars[row].numpy(), albedo.numpy(), scalars.numpy())
        wanted = ctx.needs_input_grad[1:]
        return (None, *(x if want else None for x, want in zip((albedo, *scalars.unbind()), wanted, strict=True)))
