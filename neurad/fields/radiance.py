"""The radiance field ``L_theta(x, wo, n, albedo)`` (Hadadan et al. 2021, 2023): reflected radiance, no emission."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from neurad.core.frame import dot, faceforward
from neurad.core.records import SurfaceInteraction
from neurad.fields.outputs import Between, Positive
from neurad.fields.select import evaluate_layers, make_layers
from neurad.fields.settings import RADIANCE_INPUTS, RadianceConfig
from neurad.fields.unit_cube import UnitCube


class RadianceField(nn.Module):
    """Hash grid of the position and chosen further inputs -> network -> :class:`~neurad.fields.outputs.Positive`.

    The paper names no output activation. Softplus keeps radiance positive; its scale makes training the same however
    bright the scene is. With a dense grid in place of hash grid and network the field reads the position alone: its
    radiance is the same in all directions and on both sides of a surface.

    Under a flash, whose power per solid angle is ``I``, light is linear in it, and what it sends to the point is known:
    the network gives three values a channel, ``L = a + I / (pi scale) (b / size^2 + c arriving cos)``, of the room's
    other lamps, of the flash by way of other surfaces, and of the flash directly, whose shadows are exact so.

    Args:
        config: kind, sizes of grid and network, and the inputs beside the position; without inputs those of a scene
            with highlights.
        bounds: smallest and largest corner of what is to be resolved [2, 3].
        scale: typical training radiance; it is part of the checkpoint.
        contracted: whether what lies outside of them is contracted, not clamped.
        weighted: whether there are :class:`BlendingWeights` beside it.
    """

    scale: Tensor
    weights: BlendingWeights | None
    """How far each place takes it for what is there; None for a method that does not ask."""

    def __init__(
        self,
        config: RadianceConfig,
        bounds: Tensor,
        scale: float = 1.0,
        contracted: bool = False,
        weighted: bool = False,
    ) -> None:
        super().__init__()
        config = config.resolved(diffuse=False)
        self.inputs = () if not config.has_network or config.inputs is None else config.inputs
        self.reads_albedo = "albedo" in self.inputs
        self.cube = UnitCube(bounds, contracted)
        self.reads_flash = "flash" in self.inputs
        channels = 9 if self.reads_flash else 3
        self.grid, self.mlp = make_layers(config, channels, sum(RADIANCE_INPUTS[name] for name in self.inputs))
        self.size = 0.5 * float((bounds[1] - bounds[0]).max())
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.weights = BlendingWeights(config, self.cube) if weighted else None

    def set_scale(self, scale: float) -> None:
        """Take ``scale`` (typical training radiance) as the unit of the output."""
        self.scale.fill_(scale)

    def forward(self, si: SurfaceInteraction, albedo: Tensor | None) -> Tensor:
        """Reflected radiance [n, 3] towards ``si.wo``; positive.

        Args:
            albedo: albedo there [n, 3], or None for a field that does not read it; no gradient flows into it.

        Raises:
            ValueError: the field reads the albedo, and none is given.
        """
        if self.reads_albedo and albedo is None:
            raise ValueError("RadianceField: it reads the albedo, which is not given")
        others = [self._flash(si) if name == "flash" else _read(name, si, albedo) for name in self.inputs]
        values = evaluate_layers(self.cube, self.grid, self.mlp, si.p, Positive(self.scale), others)
        if not self.reads_flash:
            return values
        room, indirect, direct = values.view(-1, 3, 3).unbind(1)
        flash = si.flash
        if flash is None or flash.wi is None or flash.arriving is None:
            return room
        facing = flash.arriving * dot(faceforward(si), flash.wi).clamp_min(0.0)  # [n], per squared length
        power = flash.intensity / (math.pi * self.scale)
        found: Tensor = room + power * (indirect / self.size**2 + facing.unsqueeze(-1) * direct)
        return found

    def _flash(self, si: SurfaceInteraction) -> Tensor:
        """The flash seen from surface points, and where it is in the room [n, 24]; zeros where there is none."""
        flash = si.flash
        if flash is None or flash.wi is None:
            return si.p.new_zeros(len(si), RADIANCE_INPUTS["flash"])
        n = faceforward(si)
        mirrored = 2.0 * dot(si.wo, n).unsqueeze(-1) * n - si.wo
        distance = (flash.position - si.p).norm(dim=-1) / self.size
        angles = torch.stack((dot(n, flash.wi), dot(mirrored, flash.wi), torch.log1p(distance)), -1)
        place: Tensor = 2.0 * self.cube(flash.position) - 1.0
        waves = torch.cat([f(math.pi * k * place) for k in (1.0, 2.0) for f in (torch.sin, torch.cos)], -1)
        return torch.cat((flash.wi, angles, flash.direction, place, waves), -1)


class BlendingWeights(nn.Module):
    """Weights [n, 1] in [0, 1] of a radiance field at places, one half at the start: a grid as fine as the field's, and
    a network of one hidden layer.
    """

    def __init__(self, config: RadianceConfig, cube: UnitCube) -> None:
        super().__init__()
        self.cube = cube
        self.grid, self.mlp = make_layers(replace(config, hidden_layers=min(config.hidden_layers, 1)), 1)

    def forward(self, si: SurfaceInteraction) -> Tensor:
        """Weights [n, 1] at the lanes of ``si``."""
        return evaluate_layers(self.cube, self.grid, self.mlp, si.p, Between(0.0, 1.0))


def _read(name: str, si: SurfaceInteraction, albedo: Tensor | None) -> Tensor:
    """One of the inputs beside the position [n, 3]."""
    if name == "direction":
        return si.wo
    if name == "normal":
        return si.n
    if name == "albedo" and albedo is not None:
        return albedo.detach()
    if name == "faceforward":
        return faceforward(si)
    return 2.0 * (si.wo * si.n).sum(-1, keepdim=True) * si.n - si.wo  # reflection
