"""Path tracing with emitter sampling, MIS and roulette: the forward reference, and its derivative by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.ranges import Count, PositiveFraction, checked
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import Method, RadianceEstimate, SceneModel
from neurad.integrators.walk import Roulette, scatter, walk


class PathTracing(Method):
    """AD-PT: ``sum_i T^i E`` with autograd through all bounces (paper Eq. 7), directions and roulette held fixed.

    Memory grows with the length of the paths, as the graph keeps every bounce. Without ``max_depth`` the estimate is
    unbiased; its variance is finite where the albedo's square stays below ``rr_prob``.

    Args:
        max_depth: longest path, counted as in Mitsuba: 1 shows emitters only, 2 adds direct light. None: roulette alone
            ends paths.
        rr_depth: depth from which roulette may end a path.
        rr_prob: largest probability to go on; below it, it is the throughput.
        control_variate: give what takes noise from the samples without changing their mean, at no ray's cost.

    Raises:
        InputError: a number that ends no path, or every one before it begins.
    """

    needs_field = False

    def __init__(
        self,
        max_depth: Count | None = 16,
        rr_depth: Count = 5,
        rr_prob: PositiveFraction = 0.95,
        control_variate: bool = True,
    ) -> None:
        if rr_prob == 1.0 and max_depth is None:
            raise InputError(f"model.method ({type(self).__name__}): rr_prob 1 and no max_depth would end no path")
        self.max_depth = max_depth
        self.roulette = Roulette(rr_depth, rr_prob)
        self.control_variate = control_variate
        checked(self)

    @property
    def reflects(self) -> bool:
        """Whether paths reach beyond what emits."""
        return self.max_depth is None or self.max_depth > 1

    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """``sum_{i >= 1} T^i E`` at the lanes of ``si``, the Neumann series of Eq. 1."""
        if not self.reflects:
            return RadianceEstimate(torch.zeros_like(si.p))
        stats = self.wants_sample_stats(scene.world)
        vertices = walk(scene, si, surface, u, stream, self.roulette, self.max_depth, sample_stats=stats)
        terms, arrived, sample_stats = [], [], None
        for v in vertices:
            terms.append((v.lane, v.throughput * v.bounce.direct))  # beta_i T_hat(E)
            if v.throughput_after_first is None:
                sample_stats = v.bounce.sample_stats
            else:
                arrived.append((v.lane, v.throughput_after_first * v.bounce.direct.detach()))
        light = None if sample_stats is None else scatter(arrived, si.p)
        return RadianceEstimate(scatter(terms, si.p), Li_bsdf=light, sample_stats=sample_stats)
