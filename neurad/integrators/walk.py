"""Random walks from vertex to vertex, in lanes that drop out as paths end. Path integrators differ in what they sum."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import torch
from torch import Tensor

from neurad.core.ranges import Count, PositiveFraction, checked
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import SceneModel
from neurad.integrators.vertex import DIMENSIONS, Bounce
from neurad.runtime.lanes import all_lanes

Survival = Callable[[int, Tensor, Tensor], Tensor | None]
"""``(bounces done, throughput [n, 3], weight of the last bounce [n, 3])`` -> probability to go on [n], or None: all."""


@dataclass(frozen=True)
class Roulette:
    """Ends paths with the probability of what they have lost, as Mitsuba's ``path`` does.

    Attributes:
        rr_depth: depth from which roulette may end a path.
        rr_prob: largest probability to go on.
    """

    rr_depth: Count = 5
    rr_prob: PositiveFraction = 0.95

    def __post_init__(self) -> None:
        """Refuse numbers that end no path, or every one before it begins."""
        checked(self)

    def __call__(self, bounces: int, throughput: Tensor, weight: Tensor) -> Tensor | None:
        """Probability to go on [n]; None before ``rr_depth``."""
        return throughput.amax(-1).clamp_max(self.rr_prob) if bounces >= self.rr_depth else None


@dataclass(frozen=True)
class Vertex:
    """One bounce of all paths that got so far."""

    lane: Tensor
    """Which path [m], ascending."""
    si: SurfaceInteraction
    surface: Surface
    u: Tensor
    """Uniform numbers of the bounce [m, DIMENSIONS]."""
    throughput: Tensor
    """Product of the weights before this vertex over the probabilities to get here [m, 3]."""
    bounce: Bounce
    throughput_after_first: Tensor | None = None
    """``throughput`` without the first weight, so that its sum with direct light is what arrived along the first BSDF
    sample; without gradient [m, 3]. None at the first vertex, and without statistics of the samples."""


def walk(
    scene: SceneModel,
    si: SurfaceInteraction,
    surface: Surface,
    u: Tensor,
    stream: Stream,
    survival: Survival | None,
    max_depth: int | None,
    detached: bool = False,
    sample_stats: bool = False,
) -> Iterator[Vertex]:
    """Vertices of random walks, one bounce of all paths at a time. Where all lanes work, those of paths that have ended
    stay, with a throughput of 0.

    Args:
        si: first vertices [n]; a lane without a surface gives zeros and ends.
        u: uniform numbers of the first bounce [n, DIMENSIONS].
        stream: random numbers of all further ones.
        survival: when paths end; its probabilities are held fixed in derivatives. None leaves all to ``max_depth``.
        max_depth: a path's largest depth, counted as in Mitsuba, at least 2, which is one bounce; None leaves all to
            ``survival``.
        detached: cut the graph between vertices, so that each bounce is differentiable in its own surface alone.
        sample_stats: compare the first weights with their mean, and keep the throughput of what comes after them.
    """
    sample_stats = sample_stats and scene.world.bsdf.varying_weight
    lane = torch.arange(len(si), device=si.p.device)  # path of each lane [m]
    throughput = torch.ones_like(si.p)  # beta: weights over probabilities so far [m, 3]
    throughput_after_first = None  # the same without the first weight [m, 3]
    for depth in count(1):
        # ---------------------- One vertex ----------------------

        # Guided weights reach albedo / Guide.uniform: at every bounce of an endless path they would add up to infinite
        # variance. A guide is most accurate at first hits, too.
        step = bounce(scene.world, si, surface, u, sample_stats=sample_stats and depth == 1, guided=depth == 1)
        yield Vertex(lane, si, surface, u, throughput, step, throughput_after_first)
        if max_depth is not None and depth + 1 >= max_depth:
            return

        # ---------------------- Throughput ----------------------

        own = step.weight  # [m, 3]
        weight = own.detach()
        throughput = throughput * (weight if detached else own)
        fixed = throughput.detach()
        if sample_stats:
            throughput_after_first = (
                torch.ones_like(weight) if throughput_after_first is None else throughput_after_first * weight
            )

        # ---------------------- Russian roulette ----------------------

        alive = step.next.valid & (fixed.amax(-1) > 0)  # [m]
        keep = None if survival is None else survival(depth, fixed, weight)  # [m]
        if keep is not None:
            alive &= stream.uniform(len(lane)) < keep
            keep = keep.clamp_min(1e-30).unsqueeze(-1)
            throughput = throughput / keep
            throughput_after_first = None if throughput_after_first is None else throughput_after_first / keep
        here: Tensor | slice = slice(None)
        if keep is None and max_depth is not None and all_lanes(alive.device):  # dead ones carry nothing
            throughput = torch.where(alive.unsqueeze(-1), throughput, 0.0)
        else:
            here = alive.nonzero().squeeze(-1)  # [k], the paths that go on
            if len(here) == 0:
                return

        # ---------------------- Next vertex ----------------------

        lane, si, throughput = lane[here], step.next[here], throughput[here]
        throughput_after_first = None if throughput_after_first is None else throughput_after_first[here]
        del step, surface, own, weight, fixed, keep, alive  # the next vertex is the peak of the memory
        surface = scene.materials(si)
        if torch.is_grad_enabled() and not detached:
            append_sparse_gradients(surface)
        u = stream.uniform(len(lane), DIMENSIONS)


def scatter(parts: list[tuple[Tensor, Tensor]], like: Tensor) -> Tensor:
    """The sum of values [m, 3] at their lanes [m], in the shape of ``like`` [n, 3]."""
    zero = torch.zeros_like(like)
    if not parts:
        return zero
    return zero.index_add(0, torch.cat([lane for lane, _ in parts]), torch.cat([value for _, value in parts]))


def append_sparse_gradients(surface: Surface) -> None:
    """Make autograd add the sparse gradients behind a surface to others in no time, for tables read at every bounce.

    Torch merges two sparse tensors row by row, 40 ns each, unless the values of one of them are not contiguous: those
    it appends, which is seven times quicker. The optimizer adds up equal rows anyway.
    """
    nodes = [x.grad_fn for x in surface.parameters.values() if x.grad_fn is not None]
    seen = set()
    while nodes:
        node = nodes.pop()
        if node in seen:
            continue
        seen.add(node)
        before = [n for n, _ in node.next_functions if n is not None]
        inner = [n for n in before if type(n).__name__ != "AccumulateGrad"]
        if len(inner) < len(before):
            node.register_hook(_loosen_all)
        nodes += inner


def _loosen_all(gradients: Sequence[Tensor | None], outer: Sequence[Tensor | None]) -> tuple[Tensor | None, ...]:
    return tuple(noncontiguous(g) if g is not None and g.is_sparse else g for g in gradients)


def noncontiguous(gradient: Tensor) -> Tensor:
    """A sparse gradient whose values are not contiguous; see :func:`append_sparse_gradients`."""
    values = gradient._values()
    if values.dim() != 2:
        return gradient
    loose = values.new_empty(len(values), values.shape[1] + 1)[:, :-1].copy_(values)
    return torch.sparse_coo_tensor(gradient._indices(), loose, gradient.shape, check_invariants=False)
