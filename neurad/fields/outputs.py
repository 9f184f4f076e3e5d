"""What makes values of what a field's layers say, with derivatives for kernels that autograd does not see."""

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import softplus

from neurad.core.records import SurfaceInteraction
from neurad.scene.textures import KnownSurfaces

START = 0.2
"""Mean of :class:`Positive` at the start, in units of its scale."""
_SHIFT = math.log(math.expm1(START))  # softplus(_SHIFT) = START


class Output(Protocol):
    """A map from what layers say [n, c] to values [n, c]."""

    def __call__(self, y: Tensor) -> Tensor:
        """The values."""

    def vjp(self, y: Tensor, gradient: Tensor) -> Tensor:
        """The gradient by ``y`` for one by the values [n, c]; called after the values were made."""


@dataclass(frozen=True)
class Unchanged:
    """What the layers say."""

    def __call__(self, y: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        return y

    def vjp(self, y: Tensor, gradient: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        return gradient


@dataclass(frozen=True)
class Between:
    """A sigmoid between two ends."""

    low: float
    high: float

    def __call__(self, y: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        fraction = torch.sigmoid(y)
        return fraction if (self.low, self.high) == (0.0, 1.0) else self.low + (self.high - self.low) * fraction

    def vjp(self, y: Tensor, gradient: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        found: Tensor = torch.ops.aten.sigmoid_backward(gradient, torch.sigmoid(y))
        return found if self.high - self.low == 1.0 else found * (self.high - self.low)


@dataclass(frozen=True)
class Positive:
    """``scale * softplus(y + shift)``: linear where it is large, and unlike exp it cannot grow exponentially."""

    scale: Tensor
    """Scalar."""

    def __call__(self, y: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        return self.scale * softplus(y + _SHIFT)

    def vjp(self, y: Tensor, gradient: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        return torch.sigmoid(y + _SHIFT) * gradient * self.scale


@dataclass
class Known:
    """Another output where surfaces are recovered, and the scene's own values on those that are known."""

    own: Output
    known: KnownSurfaces
    si: SurfaceInteraction
    """Where the values are [n]."""
    _replaced: Tensor | None = field(default=None, init=False)

    def __call__(self, y: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        values = self.own(y)
        if values.requires_grad:
            replaced: Tensor = self.known(self.si, values)
            return replaced
        self._replaced = self.known.replace_(self.si, values)
        return values

    def vjp(self, y: Tensor, gradient: Tensor) -> Tensor:
        """As :class:`Output` has it."""
        assert self._replaced is not None
        return self.own.vjp(y, gradient).masked_fill_(self._replaced.unsqueeze(-1), 0.0)
