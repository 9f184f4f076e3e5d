"""All the light of a scene behind one interface."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.errors import InputError
from neurad.core.records import EmitterSample, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

LEAST = 0.1
"""Smallest probability of either kind: power says nothing about what is visible from a point."""


class Lights(nn.Module):
    """Area lights and an environment together; a sample comes from one of them, chosen by power.

    The environment's power is the flux through a disk as large as the scene, ``pi r^2 * integral of L``, that of
    the triangles ``pi * sum(area * L)``; both probabilities are kept above :data:`LEAST`. Since one lights only lanes
    that hit a surface and the other only lanes that did not, radiance and densities of both are simply added.

    Args:
        area: the emitting triangles.
        environment: the environment.
        radius: radius of the scene's bounding sphere.
    """

    def __init__(self, area: AreaLights, environment: Environment, radius: float) -> None:
        super().__init__()
        self.area = area
        self.environment = environment
        self.radius = radius

    @property
    def area_probability(self) -> float:
        """Probability of an area light; that of an environment which is being recovered follows its present power."""
        through = math.pi * self.radius**2 * self.environment.integral
        return min(max(self.area.power / (self.area.power + through), LEAST), 1.0 - LEAST)

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """A direction towards either kind of light; the third of ``u`` [n, 3] chooses and is then used again."""
        chance = self.area_probability
        use = u[:, 2] < chance
        again = torch.where(use, u[:, 2] / chance, (u[:, 2] - chance) / (1.0 - chance))
        area = self.area.sample(p, torch.cat((u[:, :2], again[:, None].clamp(0.0, 1.0)), -1))
        far = self.environment.sample(p, u)
        three = use[:, None]
        return EmitterSample(
            wi=torch.where(three, area.wi, far.wi),
            distance=torch.where(use, area.distance, far.distance),
            radiance=torch.where(three, area.radiance, far.radiance),
            pdf=torch.where(use, chance * area.pdf, (1.0 - chance) * far.pdf),
        )

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Radiance [n, 3] sent towards ``si.wo`` from surfaces, or from the environment where there is none."""
        return self.area.eval(si) + self.environment.eval(si)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Density [n] at ``p`` [n, 3] of the direction that ended at ``si``, with the choice of the kind."""
        return self.area_probability * self.area.pdf(p, si) + (1.0 - self.area_probability) * self.environment.pdf(
            p, si
        )


def make_lights(
    scene: Scene, geometry: Geometry, other: Environment | None = None, lamps: AreaLights | None = None
) -> AreaLights | Environment | Lights:
    """The scene's emitter: one kind alone, or both joined.

    Args:
        scene: whose area lights, and environment unless another one is given.
        geometry: of the same scene.
        other: used instead of the scene's own environment.
        lamps: used instead of the scene's own area lights.

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
    if area is not None and environment is not None:
        return Lights(area, environment, float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2)
    if area is not None:
        return area
    if environment is not None:
        return environment
    raise InputError(f"scene {scene.name}: it has no emitter, so every photograph would be black")
