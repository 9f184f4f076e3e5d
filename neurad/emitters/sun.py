"""A disk at infinity whose radiance is recovered."""

import math

import torch
from torch import Tensor, nn

from neurad.core.frame import Frame, dot
from neurad.core.records import Float64Array
from neurad.core.sampling import uniform_cone


class FittedSun(nn.Module):
    """The sun: a direction, a radius, and a radiance that is trained; there is none before :meth:`rise`.

    It is what a map that is kept soft cannot hold: the edges of its light would go into the materials.
    """

    towards: Tensor
    one_minus_cos: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.zeros(1, 3))
        """Logarithms of its radiance [1, 3]."""
        self.register_buffer("towards", torch.tensor([0.0, 1.0, 0.0]))
        self.register_buffer("one_minus_cos", torch.zeros(()))

    def rise(self, towards: Float64Array, radius: float, irradiance: Float64Array) -> None:
        """Shine from now on.

        Args:
            towards: direction [3], of length 1.
            radius: angular radius in radians.
            irradiance: to begin with, on a surface that faces it [3].
        """
        self.towards.copy_(torch.from_numpy(towards))
        self.one_minus_cos.fill_(2.0 * math.sin(0.5 * radius) ** 2)
        least = max(1e-3 * float(irradiance.max()), 1e-30)
        with torch.no_grad():
            self.values.copy_(torch.from_numpy(irradiance.clip(least) / self.solid_angle).log())

    @property
    def shines(self) -> bool:
        """Whether there is one."""
        return float(self.one_minus_cos) > 0.0

    @property
    def solid_angle(self) -> float:
        """Solid angle of the disk, in sr."""
        return 2.0 * math.pi * float(self.one_minus_cos)

    def radiance(self, d: Tensor) -> Tensor:
        """What it adds to the radiance [n, 3] from unit world directions [n, 3], with the gradient of ``values``."""
        return torch.where(self.shows(d)[:, None], self.values.exp(), 0.0)

    def direction(self, p: Tensor, u: Tensor) -> Tensor:
        """Directions [n, 3] uniform within its disk, by the first two of ``u`` [n, 3]."""
        local = uniform_cone(u[:, :2], self.one_minus_cos)
        found: Tensor = Frame.around(self.towards[None].expand(len(p), 3)).to_world(local)
        return found

    def pdf(self, p: Tensor, d: Tensor) -> Tensor:
        """Solid-angle density [n] of unit directions [n, 3]."""
        return torch.where(self.shows(d), 1.0 / self.solid_angle, 0.0)

    def shows(self, d: Tensor) -> Tensor:
        """Directions of the disk [n], bool; by the chord, since 1 - cos has no digits left in a dot product."""
        chord = d - self.towards
        return dot(chord, chord) <= 2.0 * self.one_minus_cos * (1.0 + 1e-4)
