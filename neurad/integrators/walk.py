"""Random walks from vertex to vertex, in lanes that drop out as paths end. Path integrators differ in what they sum."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.vertex import DIMENSIONS, Bounce
from neurad.integrators.world import World

Survival = Callable[[int, Tensor, Tensor], Tensor | None]
"""``(bounces done, throughput [n, 3], weight of the last bounce [n, 3])`` -> probability to go on [n], or None: all."""


@dataclass(frozen=True)
class Roulette:
    """Ends paths with the probability of what they have lost, as Mitsuba's ``path`` does.

    Attributes:
        start: bounces after which a path may end.
        most: largest probability to go on.
    """

    start: int = 5
    most: float = 0.95

    def __call__(self, bounces: int, throughput: Tensor, weight: Tensor) -> Tensor | None:
        """Probability to go on [n]; None before ``start``."""
        return throughput.amax(-1).clamp_max(self.most) if bounces >= self.start else None


@dataclass(frozen=True)
class Vertex:
    """One bounce of all paths that got so far."""

    lane: Tensor
    """Which path [m], ascending."""
    si: SurfaceInteraction
    throughput: Tensor
    """Product of the weights before this vertex over the probabilities to get here [m, 3]."""
    step: Bounce
    throughput_after_first: Tensor | None = None
    """``throughput`` without the first weight, so that its sum with direct light is what arrived along the first BSDF
    sample; without gradient [m, 3]. None at the first vertex, and unless control is asked for."""


def walk(
    world: World,
    materials: Materials,
    si: SurfaceInteraction,
    surface: Surface,
    u: Tensor,
    stream: Stream,
    survival: Survival,
    max_bounces: int | None,
    detached: bool = False,
    control: bool = False,
) -> Iterator[Vertex]:
    """Vertices of random walks, one bounce of all paths at a time.

    Args:
        world: the scene.
        materials: what its surfaces are made of.
        si: first vertices [n]; a lane without a surface gives zeros and ends.
        surface: what they are made of.
        u: uniform numbers of the first bounce [n, DIMENSIONS].
        stream: random numbers of all further ones.
        survival: when paths end; its probabilities are held fixed in derivatives.
        max_bounces: a path's largest number of bounces; None leaves all to ``survival``.
        detached: cut the graph between vertices, so that each step is differentiable in its own surface alone.
        control: ask how the first samples are sample_stats, and for what comes ``beyond`` them.
    """
    control = control and world.bsdf.varying_weight
    lane = torch.arange(len(si), device=si.p.device)
    throughput = torch.ones_like(si.p)
    throughput_after_first = None
    for bounces in count(1):
        # Guided weights reach albedo / Guide.uniform: at every bounce of an endless path they would add up to infinite
        # variance. A guide knows first hits best, too.
        step = bounce(world, si, surface, u, sample_stats=control and bounces == 1, guided=bounces == 1)
        yield Vertex(lane, si, throughput, step, throughput_after_first)
        if max_bounces is not None and bounces >= max_bounces:
            return
        own = step.weight
        weight = own.detach()
        throughput = throughput * (weight if detached else own)
        fixed = throughput.detach()
        if control:
            throughput_after_first = (
                torch.ones_like(weight) if throughput_after_first is None else throughput_after_first * weight
            )
        alive = step.next.valid & (fixed.amax(-1) > 0)
        keep = survival(bounces, fixed, weight)
        if keep is not None:
            alive &= stream.uniform(len(lane)) < keep
            keep = keep.clamp_min(1e-30).unsqueeze(-1)
            throughput = throughput / keep
            throughput_after_first = None if throughput_after_first is None else throughput_after_first / keep
        index = alive.nonzero().squeeze(-1)
        if len(index) == 0:
            return
        lane, si, throughput = lane[index], step.next[index], throughput[index]
        throughput_after_first = None if throughput_after_first is None else throughput_after_first[index]
        del step, surface, own, weight, fixed, keep, alive  # the next vertex is the peak of the memory
        surface = materials(si)
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
    nodes = [x.grad_fn for x in (surface.albedo, surface.roughness) if x.grad_fn is not None]
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
    return tuple(loosen(g) if g is not None and g.is_sparse else g for g in gradients)


def loosen(gradient: Tensor) -> Tensor:
    """A sparse gradient whose values are not contiguous; see :func:`append_sparse_gradients`."""
    values = gradient._values()
    if values.dim() != 2:
        return gradient
    loose = values.new_empty(len(values), values.shape[1] + 1)[:, :-1].copy_(values)
    return torch.sparse_coo_tensor(gradient._indices(), loose, gradient.shape, check_invariants=False)
