"""Derivatives by the radiance of lamps, beside kernels that know nothing of them.

Direct light is linear in the radiance ``exp(v)`` of every lamp. So the derivative of what a sample found on a lamp by
the lamp's ``v`` is what it found, and it is enough to know which sample found how much on which lamp. The reference
needs none of this: autograd follows the lamps' :meth:`~neurad.emitters.fitted_lamps.FittedLamps.radiance_of`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.core.records import SurfaceInteraction
from neurad.core.sampling import mis_weight
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.integrators.world import World


@dataclass(frozen=True)
class FoundLight:
    """Light that one technique found on lamps."""

    lane: Tensor
    """Lanes that it arrived at [k]."""
    face: Tensor
    """Triangles that it came from [k]."""
    light: Tensor
    """Its part of these lanes' direct light [k, 3]."""


def by_lamps(lights: FittedLamps, direct: Tensor, found: Sequence[FoundLight]) -> Tensor:
    """``direct`` light [n, 3], the sum of what was ``found``, with its derivative by the radiance of ``lights``."""
    lane, face = (torch.cat([getattr(part, name) for part in found]) for name in ("lane", "face"))
    light = torch.cat([part.light.detach() for part in found])
    result: Tensor = _ByLamps.apply(direct, lights.values, lane, lights.lamp.index_select(0, face), light)  # type: ignore[no-untyped-call]
    return result


def found_light(
    world: World, si: SurfaceInteraction, u: Tensor, unoccluded: tuple[Tensor, Tensor], pdf: Tensor,
    end: SurfaceInteraction, weight: Tensor, via_delta: Tensor | None = None,
) -> list[FoundLight]:  # fmt: skip
    """The direct light of a bounce by lamps: what emitter samples brought, and what BSDF samples ended at.

    Args:
        unoccluded: lanes [k] whose emitter sample nothing lies before, and the light of each [k, 3].
        pdf: of the BSDF samples [n], whose ``weight`` is [n, 3] and which ended at ``end`` [n].
        via_delta: whether smooth surfaces lay on their way [n]; None where there are none.
    """
    lights = world.lights
    assert isinstance(lights, FittedLamps)
    lane, light = unoccluded
    by_emitter = FoundLight(lane, lights.chosen(u[lane, 2]), light)
    ends = (end.valid & (pdf > 0) & (lights.lamp[end.prim.clamp_min(0)] >= 0)).nonzero().squeeze(-1)
    hit = end[ends]
    mis = mis_weight(pdf[ends], lights.pdf(si.p[ends], hit))
    if via_delta is not None:  # emitter sampling cannot look through all smooth surfaces
        mis = torch.where(via_delta[ends], 1.0, mis)
    with torch.no_grad():
        emitted = lights.eval(hit)
    return [by_emitter, FoundLight(ends, hit.prim, weight[ends] * emitted * mis.unsqueeze(-1))]


class _ByLamps(torch.autograd.Function):
    """Direct light as it is, whose gradient also goes to the lamps that it came from."""

    @staticmethod
    def forward(ctx: Any, direct: Tensor, values: Tensor, lane: Tensor, lamp: Tensor, light: Tensor) -> Tensor:
        ctx.save_for_backward(lane, lamp, light)
        ctx.lamps = values.shape
        return direct.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        lane, lamp, light = ctx.saved_tensors
        # In double precision: many small parts, one sum for each lamp.
        parts = gradient.index_select(0, lane).double() * light
        total = parts.new_zeros(ctx.lamps).index_add_(0, lamp, parts)
        return gradient, total.to(gradient.dtype), None, None, None
