"""A light that moves with the camera."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from neurad.core.records import Flash
from neurad.core.scene_records import PunctualLight
from neurad.emitters.punctual import over_squared, spot_falloff, towards


class FlashLight(nn.Module):
    """What the flashes of all photographs have in common: whether they are points or spots, the angles of these, and a
    factor of their intensity where that is recovered. Where each of them is, lanes carry, see
    :class:`~neurad.core.records.Flash`.

    It is no :class:`~neurad.core.protocols.Emitter`: each lane has one light, which takes a shadow ray and no draw.
    """

    def __init__(self, light: PunctualLight) -> None:
        super().__init__()
        self.is_spot = light.kind == "spot"
        self.cutoff, self.beam = math.radians(light.cutoff_angle), math.radians(light.beam_width)
        self.gain = nn.Parameter(torch.zeros(3), requires_grad=False)
        """Logarithm of what the intensities are multiplied by [3]; trained where that is recovered."""

    def factor(self) -> Tensor:
        """What the intensities are multiplied by [3]."""
        return self.gain.exp()

    def seen_from(self, p: Tensor, flash: Flash) -> tuple[Tensor, Tensor, Tensor]:
        """The flash from ``p`` [n, 3] with nothing in between: direction [n, 3], distance [n], and what its intensity
        is multiplied by to give the irradiance on a surface that faces it [n].
        """
        wi, distance = towards(p, flash.position)
        falloff = torch.ones_like(distance)
        if self.is_spot:
            width = self.cutoff - self.beam
            falloff = spot_falloff(wi, flash.direction, self.cutoff, self.beam, 1.0 / width if width > 0 else 0.0)
        return wi, distance, over_squared(falloff, distance)
