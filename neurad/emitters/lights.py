"""All the light of a scene behind one interface."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.errors import InputError
from neurad.core.protocols import Emitter
from neurad.core.records import EmitterSample, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.emitters.punctual import PunctualLights
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

MIN_PROBABILITY = 0.1
"""Smallest probability of either kind: power says nothing about what is visible from a point."""


class Lights(nn.Module):
    """Two emitters together: area lights and an environment, or lights without extent and all others. A sample comes
    from one of them, chosen by power.

    The environment's power is the flux through a disk as large as the scene, ``pi r^2 * integral of L``, that of
    triangles ``pi * sum(area * L)``; both probabilities are kept above :data:`MIN_PROBABILITY`. Area lights light only
    lanes that hit a surface, an environment only lanes that did not, and at lights without extent no ray ends: radiance
    and densities of both are simply added. The scene's size is the ``radius`` of its bounding sphere.
    """

    def __init__(
        self, first: AreaLights | PunctualLights, second: AreaLights | Environment | Lights, radius: float
    ) -> None:
        super().__init__()
        self.first = first
        self.second = second
        self.radius = radius

    @property
    def probability(self) -> float:
        """Probability of the first; that of an environment which is being recovered follows its present power."""
        own = _power(self.first, self.radius)
        share = own / (own + _power(self.second, self.radius))
        return min(max(share, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """A direction towards light of either kind; the third of ``u`` [n, 3] chooses and is then used again."""
        chance = self.probability
        use = u[:, 2] < chance
        again = torch.where(use, u[:, 2] / chance, (u[:, 2] - chance) / (1.0 - chance)).clamp(0.0, 1.0)
        u = torch.cat((u[:, :2], again[:, None]), -1)
        one, other = self.first.sample(p, u), self.second.sample(p, u)
        three = use[:, None]
        return EmitterSample(
            wi=torch.where(three, one.wi, other.wi),
            distance=torch.where(use, one.distance, other.distance),
            radiance=torch.where(three, one.radiance, other.radiance),
            pdf=torch.where(use, chance * one.pdf, (1.0 - chance) * other.pdf),
            is_delta=use if isinstance(self.first, PunctualLights) else None,
        )

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Radiance [n, 3] sent towards ``si.wo`` from surfaces, or from the environment where there is none."""
        return self.first.eval(si) + self.second.eval(si)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Density [n] at ``p`` [n, 3] of the direction that ended at ``si``, with the choice of the kind."""
        chance = self.probability
        return chance * self.first.pdf(p, si) + (1.0 - chance) * self.second.pdf(p, si)


class NullEmitter(nn.Module):
    """An :class:`~neurad.core.protocols.Emitter` that sends nothing."""

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """Any direction, with density 0."""
        wi = torch.zeros_like(p)
        wi[:, 2] = 1.0
        return EmitterSample(wi, torch.ones_like(p[:, 0]), torch.zeros_like(p), torch.zeros_like(p[:, 0]))

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Zeros [n, 3]."""
        return torch.zeros_like(si.p)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Zeros [n]."""
        return torch.zeros_like(p[:, 0])


AnyLights = AreaLights | Environment | Lights | PunctualLights
"""Whatever :func:`join` makes."""


def _power(lights: AnyLights, radius: float) -> float:
    """Luminous power that gets into a scene of this radius."""
    if isinstance(lights, Lights):
        return _power(lights.first, radius) + _power(lights.second, radius)
    if isinstance(lights, Environment):
        return math.pi * radius**2 * lights.integral
    return lights.power(radius) if isinstance(lights, PunctualLights) else lights.power


def parts(lights: Emitter) -> tuple[AreaLights | None, Environment | None, PunctualLights | None]:
    """What :func:`join` made one emitter of."""
    every: list[nn.Module] = list(lights.modules()) if isinstance(lights, nn.Module) else []
    return (
        next((one for one in every if isinstance(one, AreaLights)), None),
        next((one for one in every if isinstance(one, Environment)), None),
        next((one for one in every if isinstance(one, PunctualLights)), None),
    )


def join(
    area: AreaLights | None, environment: Environment | None, punctual: PunctualLights | None, radius: float
) -> AnyLights | None:
    """One emitter of all that there are, in a scene whose bounding sphere has a radius; None where there is none."""
    others: AreaLights | Environment | Lights | None = area if environment is None else environment
    if area is not None and environment is not None:
        others = Lights(area, environment, radius)
    if punctual is None or others is None:
        return others if punctual is None else punctual
    return Lights(punctual, others, radius)


def make_lights(
    scene: Scene, geometry: Geometry, other: Environment | None = None, lamps: AreaLights | None = None
) -> AnyLights:
    """The scene's emitter: one kind alone, or those that there are joined. An ``other`` environment, and ``lamps``, are
    used instead of its own.

    Raises:
        InputError: the scene has no light at all.
    """
    features = scene.features
    area = lamps
    if lamps is None and features.has_area_lights:
        area = AreaLights(geometry)
    environment = other
    if other is None and features.has_environment and scene.environment is not None:
        environment = Environment(scene.environment)
    punctual = PunctualLights(scene.punctual) if features.has_punctual else None
    made = join(area, environment, punctual, float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2)
    if made is None and features.has_flash:
        return AreaLights(geometry, dark=True)
    if made is None:
        raise InputError(
            f"scene {scene.name}: it has no emitter, so every photograph would be black; where photographs "
            "show what shines, take --model.lighting.emitters find"
        )
    return made
