"""What one training step estimates: the RHS image, the field at the same points, and the prior's two sides."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Interaction, Lanes, Surface
from neurad.core.rng import Stream
from neurad.integrators.method import Method, Parts, Reflected, ReflectedRadiance, look_up
from neurad.integrators.radiometric import Radiometric, incident
from neurad.integrators.vertex import DIMENSIONS, bounce
from neurad.integrators.world import World


@dataclass(frozen=True)
class Estimator:
    """Estimates in a world with materials and, for the methods that read one, a radiance field."""

    world: World
    materials: Materials
    radiance: ReflectedRadiance | None
    method: Method = field(default_factory=Radiometric)

    @property
    def parts(self) -> Parts:
        """What the method works on."""
        return Parts(self.world, self.materials, self.radiance)

    def image(self, it: Interaction, surface: Surface, count: int, stream: Stream, together: int = 1) -> Reflected:
        """The method's estimate, ``count`` samples at every lane: lane i's are i*count .. (i+1)*count - 1.

        The samples of ``together`` neighbouring lanes are spread evenly, and independent of all others.
        """
        assert len(it) % together == 0
        u = spread(len(it) // together, together * count, stream)
        return self.method.reflected(self.parts, it.repeat(count), surface.repeat(count), u, stream)

    def reflected(
        self,
        it: Interaction,
        surface: Surface,
        count: int,
        stream: Stream,
        field_gradient: bool = False,
        light_gradient: bool = True,
    ) -> Tensor:
        """``count`` evenly spread samples of ``T_hat(E + L_theta)`` at each lane [n, count, 3]: the prior's right side.

        The samples are differentiable in ``surface``; in theta only if ``field_gradient``. Without ``light_gradient``
        their direct part is fixed.
        """
        assert self.radiance is not None
        u = spread(len(it), count, stream)
        step = bounce(self.world, it.repeat(count), surface.repeat(count), u)
        if field_gradient:
            light = look_up(self.radiance, self.materials, step.next) * step.next.valid.unsqueeze(-1)
        else:
            light = incident(self.materials, self.radiance, step.next)
        direct = step.direct if light_gradient else step.direct.detach()
        return (direct + step.weight * light).view(len(it), count, 3)


def spread(groups: int, count: int, stream: Stream) -> Tensor:
    """Uniform numbers for ``groups`` times ``count`` bounces that are spread evenly [groups * count, DIMENSIONS].

    Every bounce's numbers are uniform, and groups are independent. Within a group each number stands once in every
    ``count``-th part of its range (the second ones of pairs do if ``count`` is a power of two). The pairs that make a
    direction or a point on an emitter are those of a Hammersley set, randomly shifted; what belongs to different
    decisions is paired by random affine maps of the indices (padding, Kollig and Keller 2002), of which powers of two
    have most.
    """
    shift = stream.uniform(groups, 1, DIMENSIONS)
    if count == 1:
        return shift.view(groups, DIMENSIONS)
    units = torch.tensor([k for k in range(1, count) if math.gcd(k, count) == 1], device=shift.device)
    factor = units[stream.integers(len(units), groups, 1, len(_FIRST))]
    start = stream.integers(count, groups, 1, len(_FIRST))
    order = (start + factor * torch.arange(count, device=shift.device).view(1, -1, 1)) % count
    numbers = shift.repeat(1, count, 1)
    numbers[..., _FIRST] += order / count
    numbers[..., _SECOND] += _mirrored(count).to(shift.device)[order[..., _PAIRS]]
    return (numbers % 1.0).view(groups * count, DIMENSIONS)


_FIRST = [0, 2, 3, 4, 6]
"""First number of each decision of a bounce: point on an emitter, emitter, lobe, direction, glass."""
_PAIRS = [0, 3]
"""Which of them take two numbers."""
_SECOND = [1, 5]
"""Their second ones."""


def _mirrored(count: int) -> Tensor:
    """Van der Corput's sequence in base 2 [count]."""
    bits = max(1, (count - 1).bit_length())
    return torch.tensor([int(f"{k:0{bits}b}"[::-1], 2) / (1 << bits) for k in range(count)])


def some(lanes: Lanes, share: float, stream: Stream, count: int) -> Tensor:
    """Indices of a random ``share`` of the first hits, one random bounce of each: into lanes ordered by hit, ``count``
    bounces a hit.
    """
    hits = len(lanes) // count
    keep = max(1, round(share * hits))
    device = stream.device
    chosen = (
        torch.randperm(hits, generator=stream.generator, device=device)[:keep]
        if keep < hits
        else torch.arange(hits, device=device)
    )
    return chosen * count + stream.integers(count, len(chosen))
