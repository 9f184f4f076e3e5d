"""A unidirectional path tracer with emitter sampling, MIS and roulette: the forward reference."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Rays
from neurad.core.rng import Stream
from neurad.integrators.vertex import DIMENSIONS, bounce
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
        first = self.world.reach(rays, stream.uniform(len(rays)))
        it = first.it
        radiance = first.through(self.world.emitted(it))
        lane = it.valid.nonzero().squeeze(-1)
        throughput = first.through(torch.ones_like(it.p))[lane]
        it = it[lane]
        depth = 1
        while len(lane) and (self.max_depth is None or depth < self.max_depth):
            step = bounce(self.world, it, self.materials(it), stream.uniform(len(lane), DIMENSIONS))
            radiance.index_add_(0, lane, throughput * step.direct)
            throughput = throughput * step.weight
            strongest = throughput.amax(-1)
            alive = step.next.valid & (strongest > 0)
            if depth >= self.rr_depth:
                keep = strongest.clamp_max(self.rr_prob)
                alive &= stream.uniform(len(lane)) < keep
                throughput = throughput / keep.clamp_min(1e-30).unsqueeze(-1)
            index = alive.nonzero().squeeze(-1)
            lane, it, throughput = lane[index], step.next[index], throughput[index]
            depth += 1
        return radiance
