"""All the light of a scene behind one interface."""

import math
from dataclasses import replace

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
    """Area lights and an environment together; a sample comes from one of them, chosen by power.

    The environment's power is the flux through a disk as large as the scene, ``pi r^2 * integral of L``, that of
    the triangles ``pi * sum(area * L)``; both probabilities are kept above :data:`MIN_PROBABILITY`. Since one lights
    only lanes that hit a surface and the other only lanes that did not, radiance and densities of both are simply
    added.

    Args:
        radius: radius of the scene's bounding sphere.
    """

    def __init__(self, area: AreaLights, environment: Environment, radius: float) -> None:
        super().__init__()
        self.area = area
        self.environment = environment
        self.radius = radius

    @property
    def power(self) -> float:
        """Luminous power of both kinds."""
        return self.area.power + _through(self.environment, self.radius)

    @property
    def area_probability(self) -> float:
        """Probability of an area light; that of an environment which is being recovered follows its present power."""
        return _by_power(self.area.power, self.power)

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """A direction towards either kind of light; the third of ``u`` [n, 3] chooses and is then used again."""
        return _sampled(self.area, self.environment, self.area_probability, p, u)[0]

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Radiance [n, 3] sent towards ``si.wo`` from surfaces, or from the environment where there is none."""
        return self.area.eval(si) + self.environment.eval(si)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Density [n] at ``p`` [n, 3] of the direction that ended at ``si``, with the choice of the kind."""
        return self.area_probability * self.area.pdf(p, si) + (1.0 - self.area_probability) * self.environment.pdf(
            p, si
        )


class WithPunctual(nn.Module):
    """Lights without extent beside others; a sample comes from one of the two groups, chosen by power.

    Args:
        radius: radius of the scene's bounding sphere.
    """

    def __init__(self, punctual: PunctualLights, others: AreaLights | Environment | Lights, radius: float) -> None:
        super().__init__()
        self.punctual = punctual
        self.others = others
        self._radius = radius

    @property
    def radius(self) -> float:
        """Radius of what light from far away is judged by."""
        return self._radius

    @radius.setter
    def radius(self, radius: float) -> None:
        self._radius = radius
        if isinstance(self.others, Lights):
            self.others.radius = radius

    @property
    def punctual_probability(self) -> float:
        """Probability of a light without extent."""
        others = self.others
        power = _through(others, self.radius) if isinstance(others, Environment) else others.power
        own = self.punctual.power(self.radius)
        return _by_power(own, own + power)

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """A direction towards a light of either group; the third of ``u`` [n, 3] chooses and is then used again."""
        sample, is_delta = _sampled(self.punctual, self.others, self.punctual_probability, p, u)
        return replace(sample, is_delta=is_delta)

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Radiance [n, 3] sent towards ``si.wo`` by lights that have an extent."""
        return self.others.eval(si)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Density [n] at ``p`` [n, 3] of the direction that ended at ``si``, with the choice of the group."""
        return (1.0 - self.punctual_probability) * self.others.pdf(p, si)


def _by_power(power: float, total: float) -> float:
    """Probability of a part of the light, by its power."""
    return min(max(power / total, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)


def _sampled(first: Emitter, second: Emitter, chance: float, p: Tensor, u: Tensor) -> tuple[EmitterSample, Tensor]:
    """A direction towards one of two emitters, the first with a probability of ``chance``, and whether it is that [n],
    bool; the third of ``u`` [n, 3] chooses and is then used again.
    """
    use = u[:, 2] < chance
    again = torch.where(use, u[:, 2] / chance, (u[:, 2] - chance) / (1.0 - chance)).clamp(0.0, 1.0)
    u = torch.cat((u[:, :2], again[:, None]), -1)
    one, other = first.sample(p, u), second.sample(p, u)
    three = use[:, None]
    found = EmitterSample(
        wi=torch.where(three, one.wi, other.wi),
        distance=torch.where(use, one.distance, other.distance),
        radiance=torch.where(three, one.radiance, other.radiance),
        pdf=torch.where(use, chance * one.pdf, (1.0 - chance) * other.pdf),
    )
    return found, use


def _through(environment: Environment, radius: float) -> float:
    """Luminous power of an environment through a disk of this radius."""
    return math.pi * radius**2 * environment.integral


AnyLights = AreaLights | Environment | Lights | PunctualLights | WithPunctual
"""Whatever :func:`join` makes."""


def parts(lights: Emitter) -> tuple[AreaLights | None, Environment | None, PunctualLights | None]:
    """What :func:`join` made one emitter of."""
    punctual, others = (lights.punctual, lights.others) if isinstance(lights, WithPunctual) else (None, lights)
    area, environment = (others.area, others.environment) if isinstance(others, Lights) else (others, others)
    return (
        area if isinstance(area, AreaLights) else None,
        environment if isinstance(environment, Environment) else None,
        others if isinstance(others, PunctualLights) else punctual,
    )


def join(
    area: AreaLights | None, environment: Environment | None, punctual: PunctualLights | None, radius: float
) -> AnyLights | None:
    """One emitter of all that there are; None where there is none.

    Args:
        radius: of the scene's bounding sphere.
    """
    others: AreaLights | Environment | Lights | None = area if environment is None else environment
    if area is not None and environment is not None:
        others = Lights(area, environment, radius)
    if punctual is None or others is None:
        return others if punctual is None else punctual
    return WithPunctual(punctual, others, radius)


def make_lights(
    scene: Scene, geometry: Geometry, other: Environment | None = None, lamps: AreaLights | None = None
) -> AnyLights:
    """The scene's emitter: one kind alone, or those that there are joined.

    Args:
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
