"""Path tracing with emitter sampling, MIS and roulette: the forward reference, and its derivative by autograd."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.protocols import Materials
from neurad.core.records import Rays, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import Method, Parts, Reflected
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.walk import Roulette, scatter, walk
from neurad.integrators.world import World


@dataclass(frozen=True)
class PathTracer:
    """Estimates ``sum_i T^i E`` by random walks (depth and roulette count as in Mitsuba's ``path``).

    Attributes:
        world: the scene.
        materials: what its surfaces are made of.
        max_depth: longest path; 1 shows emitters only, 2 adds direct light. None: roulette alone ends paths.
        rr_depth: depth from which roulette may end a path.
        rr_prob: largest probability to go on.
    """

    world: World
    materials: Materials
    max_depth: int | None = 20
    rr_depth: int = 8
    rr_prob: float = 0.95

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """One-sample estimate of the radiance along camera rays [n, 3]."""
        stream = Stream(seed, device=rays.o.device)
        first = self.world.trace_past_delta(rays, stream.uniform(len(rays)))
        radiance = first.attenuate(self.world.emitted(first.si))
        lane = first.si.valid.nonzero().squeeze(-1)
        if len(lane) == 0 or (self.max_depth is not None and self.max_depth < 2):
            return radiance
        si = first.si[lane]
        before = first.attenuate(torch.ones_like(first.si.p))[lane]
        steps = walk(
            self.world, self.materials, si, self.materials(si), stream.uniform(len(si), DIMENSIONS), stream,
            Roulette(self.rr_depth, self.rr_prob), None if self.max_depth is None else self.max_depth - 1,
        )  # fmt: skip
        for vertex in steps:
            at = vertex.lane
            radiance.index_add_(0, lane[at], before[at] * vertex.throughput * vertex.step.direct)
        return radiance


class PathTracing(Method):
    """AD-PT: ``sum_i T^i E`` with autograd through all bounces (paper Eq. 7), directions and roulette held fixed.

    Memory grows with the length of the paths, as the graph keeps every bounce. Without ``max_bounces`` the estimate is
    unbiased; its variance is finite where the albedo's square stays below ``roulette``.

    Args:
        max_bounces: longest path in bounces, 1 is direct light; None: roulette alone ends paths.
        roulette_start: bounces after which roulette may end a path.
        roulette: largest probability to go on; below it, it is the throughput.
        control: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: a number that ends no path, or every one before it begins.
    """

    needs_field = False

    def __init__(
        self, max_bounces: int | None = 15, roulette_start: int = 5, roulette: float = 0.95, control: bool = True
    ) -> None:
        name = f"model.method ({type(self).__name__})"
        if max_bounces is not None and max_bounces < 1:
            raise InputError(f"{name}: max_bounces must be at least 1, or null for no cap")
        if roulette_start < 1:
            raise InputError(f"{name}: roulette_start must be at least 1")
        if not 0.0 < roulette <= 1.0 or (roulette == 1.0 and max_bounces is None):
            raise InputError(f"{name}: roulette must lie in (0, 1], and below 1 where max_bounces caps no path")
        self.max_bounces = max_bounces
        self.roulette = Roulette(roulette_start, roulette)
        self.control = control

    def reflected(self, parts: Parts, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream) -> Reflected:
        """``sum_{i >= 1} T^i E`` at the lanes of ``si``."""
        control = self.tells(parts.world)
        steps = walk(
            parts.world, parts.materials, si, surface, u, stream, self.roulette, self.max_bounces, control=control
        )
        terms, arrived, sample_stats = [], [], None
        for v in steps:
            terms.append((v.lane, v.throughput * v.step.direct))
            if v.throughput_after_first is None:
                sample_stats = v.step.sample_stats
            else:
                arrived.append((v.lane, v.throughput_after_first * v.step.direct.detach()))
        light = None if sample_stats is None else scatter(arrived, si.p)
        return Reflected(scatter(terms, si.p), Li_bsdf=light, sample_stats=sample_stats)
