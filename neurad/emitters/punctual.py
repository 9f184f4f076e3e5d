"""Points, spots and directional lights: lights without extent, and the flash of a camera."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.colour import luminance
from neurad.core.errors import InputError
from neurad.core.frame import dot
from neurad.core.records import EmitterSample, Flash, SurfaceInteraction
from neurad.core.scene_records import PunctualLight

ARRIVING = 0.75
"""Fraction of the choices that go by what arrives at a point; the rest is even, as a bright light may be hidden."""
_AT_ONCE = 1 << 22
"""Most pairs of points and lights whose arrival is computed together."""


class PunctualLights(nn.Module):
    """All lights without extent as one :class:`~neurad.core.protocols.Emitter`.

    A light is chosen by the irradiance that it would give at the reference point with nothing in between; one that
    cannot shine there is never chosen. No ray ends at such a light, so that ``eval`` and ``pdf``, which belong to where
    rays end, are 0. The irradiance is differentiable in ``intensity``.

    Args:
        lights: checked; those without light are left out.

    Raises:
        InputError: all are black.
    """

    position: Tensor
    direction: Tensor
    intensity: Tensor
    strength: Tensor
    is_near: Tensor
    is_spot: Tensor
    cutoff: Tensor
    beam: Tensor
    inverse_transition: Tensor

    def __init__(self, lights: Sequence[PunctualLight]) -> None:
        super().__init__()
        lights = [light for light in lights if light.intensity.any()]
        if not lights:
            raise InputError("the scene's lights without extent cannot send light: they are black")
        axes = np.stack([np.asarray(light.direction, np.float64) for light in lights])
        intensity = torch.from_numpy(np.stack([light.intensity for light in lights]).astype(np.float32))
        cutoff = torch.tensor([math.radians(light.cutoff_angle) for light in lights], dtype=torch.float64)
        beam = torch.tensor([math.radians(light.beam_width) for light in lights], dtype=torch.float64)
        kinds = [light.kind for light in lights]
        transition = cutoff - beam
        for name, value in {
            "position": torch.from_numpy(np.stack([light.position for light in lights]).astype(np.float32)),  # [k, 3]
            "direction": torch.from_numpy(axes / np.linalg.norm(axes, axis=1, keepdims=True)).float(),  # [k, 3]
            "intensity": intensity,  # [k, 3]
            "strength": luminance(intensity.double()).float(),  # [k]
            "is_near": torch.tensor([kind != "directional" for kind in kinds]),  # [k]: has a place
            "is_spot": torch.tensor([kind == "spot" for kind in kinds]),  # [k]
            "cutoff": cutoff.float(),  # [k], radians
            "beam": beam.float(),  # [k], radians
            "inverse_transition": torch.where(transition > 0, 1.0 / transition, 0.0).float(),  # [k]
        }.items():
            self.register_buffer(name, value, persistent=False)
        # Solid angle that a light fills, weighted with its falloff
        filled = torch.where(
            transition > 0, 1.0 - (cutoff.sin() - beam.sin()) / transition.clamp_min(1e-9), 1.0 - cutoff.cos()
        )
        solid = torch.where(self.is_spot, 2.0 * math.pi * filled, 4.0 * math.pi)
        strength = luminance(intensity.double())
        self._near = float((strength * solid)[self.is_near].sum())
        self._far = float(strength[~self.is_near].sum())

    def power(self, radius: float) -> float:
        """Luminous power that gets into a scene of this radius; of directional lights through a disk as large."""
        return self._near + math.pi * radius**2 * self._far

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """The direction to a light for each of ``p`` [n, 3], chosen by the third of ``u`` [n, 3]."""
        index, chance = self._choose(p, u[:, 2])
        wi, distance, factor = self._arrival(p, index)
        irradiance = self.intensity.index_select(0, index) * factor.unsqueeze(-1)
        lit = (chance > 0) & (factor > 0) & torch.isfinite(irradiance).all(-1)
        return EmitterSample(
            wi, distance, torch.where(lit.unsqueeze(-1), irradiance, 0.0), torch.where(lit, chance, 0.0),
            torch.ones_like(lit),
        )  # fmt: skip

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Zeros [n, 3]: no ray ends at a light without extent."""
        return torch.zeros_like(si.p)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Zeros [n]: no ray ends at a light without extent."""
        return torch.zeros_like(p[:, 0])

    def chances(self, p: Tensor) -> Tensor:
        """Probability of each light at ``p`` [n, 3]: [n, k], all 0 where none can shine."""
        n, k = len(p), len(self.intensity)
        every = torch.arange(k, device=p.device).repeat(n)
        factor = self._arrival(p.repeat_interleave(k, 0), every)[2].view(n, k)
        arrives = factor * self.strength
        even = (arrives > 0).to(p.dtype)
        total, count = arrives.sum(1, keepdim=True), even.sum(1, keepdim=True)
        mixed = ARRIVING * arrives / total + (1.0 - ARRIVING) * even / count
        return torch.where(torch.isfinite(total) & (total > 0), mixed, even / count.clamp_min(1.0))

    def _choose(self, p: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Light [n] for uniform numbers [n] at ``p`` [n, 3], and its probability [n]."""
        k = len(self.intensity)
        if k == 1:
            return torch.zeros_like(u, dtype=torch.int64), torch.ones_like(u)
        count, found = max(_AT_ONCE // k, 1), []
        for some_p, some_u in zip(torch.split(p, count), torch.split(u, count), strict=True):
            chances = self.chances(some_p)  # [n, k]
            end = chances.cumsum(1)
            index = (some_u.unsqueeze(-1) * end[:, -1:] >= end[:, :-1]).sum(1)
            found.append((index, chances.gather(1, index.unsqueeze(-1)).squeeze(-1)))
        indices, chosen = zip(*found, strict=True)
        return torch.cat(indices), torch.cat(chosen)

    def _arrival(self, p: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """How lights [n] are seen from ``p`` [n, 3]: direction [n, 3], distance [n], and what their intensity is
        multiplied by to give the irradiance on a surface that faces them [n].
        """
        near, direction = self.is_near.index_select(0, index), self.direction.index_select(0, index)
        wi, distance = towards(p, self.position.index_select(0, index))
        wi = torch.where(near.unsqueeze(-1), wi, -direction)
        cutoff, beam, inverse = (x.index_select(0, index) for x in (self.cutoff, self.beam, self.inverse_transition))
        falloff = torch.where(
            self.is_spot.index_select(0, index), spot_falloff(wi, direction, cutoff, beam, inverse), 1.0
        )
        factor = over_squared(falloff, distance)
        return wi, torch.where(near, distance, math.inf), torch.where(near, factor, 1.0)


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


def towards(p: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions [n, 3] from points [n, 3] to places [n, 3], and their distances [n]."""
    way = position - p
    distance = way.norm(dim=-1)
    return way / distance.clamp_min(1e-30).unsqueeze(-1), distance


def over_squared(values: Tensor, distance: Tensor) -> Tensor:
    """Values over squared distances [n]; 0 where there is no distance."""
    apart = torch.where(distance > 0, distance, 1.0)
    # by division one after the other: the square of a short distance would be rounded to 0
    return torch.where(distance > 0, values / apart / apart, 0.0)


def spot_falloff(
    wi: Tensor, direction: Tensor, cutoff: Tensor | float, beam: Tensor | float, inverse_transition: Tensor | float
) -> Tensor:
    """What a spot's intensity is multiplied by [n] towards points that see it along ``wi`` [n, 3].

    Args:
        wi: unit directions to the spot.
        direction: unit directions of its axis [n, 3].
        cutoff: angle from which on it is dark, in radians [n].
        beam: angle up to which it is full, in radians [n].
        inverse_transition: one over the difference of both, or 0 [n].
    """
    # atan2, as acos has few digits near the axis
    angle = torch.atan2(torch.linalg.cross(direction, wi).norm(dim=-1), -dot(direction, wi))
    left = (cutoff - angle) * inverse_transition
    return torch.where(angle < cutoff, torch.where(angle <= beam, 1.0, left.clamp(0.0, 1.0)), 0.0)
