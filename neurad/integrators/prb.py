"""Path replay backpropagation (Vicini et al. 2021): derivatives of long paths in constant memory.

A first pass finds each path's radiance and keeps no graph. The backward pass draws the same random numbers again. With
``beta_i`` the throughput before vertex i, ``d_i`` and ``w_i`` its direct light and weight, and what is left of the
path's radiance ``R_i = sum_{j >= i} beta_j d_j``, a path contributes ``beta_i d(d_i) + (R_{i+1} / w_i) d(w_i)`` at
vertex i. So each bounce is differentiated alone, and its graph is dropped before the next one is made.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import RadianceEstimate, SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.vertex import BSDFSampleStats
from neurad.integrators.walk import Vertex, noncontiguous, walk
from neurad.runtime.dispatch import use_kernel


class PRB(PathTracing):
    """:class:`~neurad.integrators.path.PathTracing` with the same values and derivatives, in memory that does not grow.

    Paper Eq. 6 and 9.

    Works with any field: only materials at one vertex at a time are differentiated, networks and textures alike. A
    channel whose weight is exactly 0 gets no derivative there (as in Mitsuba): the rest of its path cannot be known.

    Args:
        max_depth: longest path; 1 shows emitters only, 2 adds direct light. None: roulette alone ends paths.
        rr_depth: depth from which roulette may end a path.
        rr_prob: largest probability to go on; below it, it is the throughput.
        control_variate: give what takes noise from the samples without changing their mean, at no ray's cost.
    """

    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """``sum_{i >= 1} T^i E`` at the lanes of ``si``."""
        if not torch.is_grad_enabled() or not self.reflects:  # there is nothing to replay
            return super().reflected(scene, si, surface, u, stream)
        key, stats = int(stream.integers(1 << 62, 1)), self.wants_sample_stats(scene.world)

        def steps(first: Surface) -> Iterator[Vertex]:
            """The walks, any number of times; every step has a graph to its own surface only."""
            # With gradients enabled in both passes: networks may round differently without them, and the smallest
            # difference in a direction can end at another triangle.
            again = Stream(key, device=u.device)
            return walk(scene, si, first, u, again, self.roulette, self.max_depth, detached=True, sample_stats=stats)

        modules = [part for part in (scene.materials, scene.world) if isinstance(part, nn.Module)]
        parameters = [p for module in modules for p in module.parameters() if p.requires_grad]
        given = surface.detach(), *_given(surface).values(), *parameters
        value, *found = _Radiance.apply(steps, *given)  # type: ignore[no-untyped-call]
        if not found:
            return RadianceEstimate(value)
        light, *sample_stats = found
        return RadianceEstimate(value, Li_bsdf=light, sample_stats=BSDFSampleStats(*sample_stats))


def _given(surface: Surface) -> dict[str, Tensor]:
    """What has a derivative at first surfaces, by name."""
    return surface.parameters | ({} if surface.lambert is None else {"lambert": surface.lambert})


class _Radiance(torch.autograd.Function):
    """The walks' radiance [n, 3] as a function of the first surface and of all parameters.

    With control there are more: the light that arrived along the first BSDF samples, which has no derivative, and what
    :class:`~neurad.integrators.vertex.BSDFSampleStats` holds; its deviation has the derivative of the first surface.
    """

    @staticmethod
    def forward(
        ctx: Any, steps: Callable[[Surface], Iterator[Vertex]], surface: Surface, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        # Sums in double precision: what is left of a long path is a difference of nearly equal numbers.
        radiance = torch.zeros_like(surface.albedo, dtype=torch.float64)
        sample_stats, light = None, torch.zeros_like(surface.albedo)
        with torch.enable_grad():
            for v in steps(surface):
                direct = v.bounce.direct.detach()
                radiance.index_add_(0, v.lane, (v.throughput * direct).double())
                if v.throughput_after_first is not None:
                    light.index_add_(0, v.lane, v.throughput_after_first * direct)
                elif v.bounce.sample_stats is not None:
                    sample_stats = v.bounce.sample_stats
                del v, direct  # before the next one is made
        ctx.steps, ctx.surface, ctx.radiance, ctx.parameters = steps, surface, radiance, parameters
        value = radiance.to(light.dtype)
        if sample_stats is None:
            return (value,)
        ctx.mark_non_differentiable(light, sample_stats.relative, sample_stats.wi)
        return value, light, sample_stats.deviation.detach(), sample_stats.relative, sample_stats.wi

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        left = ctx.radiance.clone()  # R_i: radiance from vertex i on, over all paths [n, 3]
        with torch.enable_grad():
            first = {name: value.clone().requires_grad_() for name, value in _given(ctx.surface).items()}
            ends = (*first.values(), *ctx.parameters[len(first) :])
            totals = [GradientSum() for _ in ends]
            for v in ctx.steps(replace(ctx.surface, **first)):
                # ---------------------- Radiance after this vertex ----------------------

                direct, weight = v.bounce.direct, v.bounce.weight  # d_i, w_i [m, 3]
                left.index_add_(0, v.lane, (v.throughput * direct.detach()).double(), alpha=-1.0)
                fixed = weight.detach()
                after = torch.where(fixed > 0, left[v.lane].to(fixed.dtype) / fixed.clamp_min(1e-30), 0.0)

                # ---------------------- Gradient of this vertex alone ----------------------

                outer = gradients[0][v.lane]  # of the loss by the radiance [m, 3]
                pairs = [(direct, outer * v.throughput), (weight, outer * after)]
                if v.bounce.sample_stats is not None:
                    pairs.append((v.bounce.sample_stats.deviation, gradients[2]))
                outputs, scales = zip(*((x, g) for x, g in pairs if x.requires_grad), strict=True)  # known parts do not
                found = torch.autograd.grad(outputs, ends, scales, allow_unused=True)
                for total, gradient in zip(totals, found, strict=True):
                    total.add(gradient)
                del v, direct, weight, pairs, outputs, scales  # before the next one is made
                del fixed, after, outer, found, gradient
        return (None, None, *(total.value for total in totals))


class GradientSum:
    """A sum of gradients whose size does not grow with their number.

    Tables of hash grids have sparse gradients; their rows are merged as soon as they take twice the room of the
    merged ones.
    """

    def __init__(self) -> None:
        self.dense: Tensor | None = None
        self.pieces: list[Tensor] = []
        self.merged = 0

    def add(self, gradient: Tensor | None) -> None:
        """Add a dense or sparse gradient; None is zero."""
        if gradient is None:
            return
        if gradient.is_sparse:
            self.pieces.append(gradient)
            if sum(piece._nnz() for piece in self.pieces) > 2 * self.merged:
                self._merge()
        else:
            self.dense = gradient if self.dense is None else self.dense + gradient

    def _merge(self) -> None:
        merged = self.pieces[0] if len(self.pieces) == 1 else merge(self.pieces)
        self.pieces, self.merged = [merged], merged._nnz()

    @property
    def value(self) -> Tensor | None:
        """The sum so far; None if nothing was added."""
        if not self.pieces:
            return self.dense
        self._merge()
        return noncontiguous(self.pieces[0]) if self.dense is None else self.dense + self.pieces[0]


def merge(pieces: Sequence[Tensor]) -> Tensor:
    """Sparse gradients [e, c] of one table as one, every row once."""
    indices = torch.cat([piece._indices() for piece in pieces], 1)
    values = torch.cat([piece._values() for piece in pieces])
    shape = pieces[0].shape
    if use_kernel(indices.shape[0] == 1 and values.dim() == 2, values):
        from neurad.fields import hash_grid_kernels as kernels  # torch's own coalesce sorts, which takes far longer

        rows, sums = torch.empty_like(indices[0]), torch.empty_like(values)
        arrays = indices[0].contiguous().numpy(), values.contiguous().numpy(), rows.numpy(), sums.numpy()
        found = kernels.merge_rows(*arrays, *kernels.marks(shape[0]))
        # Cut to size: a view would keep the whole room alive.
        indices, values = rows[:found].clone().unsqueeze(0), sums[:found].clone()
        return torch.sparse_coo_tensor(indices, values, shape, check_invariants=False, is_coalesced=True)
    return torch.sparse_coo_tensor(indices, values, shape, check_invariants=False).coalesce()
