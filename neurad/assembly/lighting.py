"""Light that is not known: what is built for it, and what it is compared with."""

from __future__ import annotations

from dataclasses import replace

from neurad.assembly.settings import Lighting
from neurad.core.errors import InputError
from neurad.core.records import EnvironmentMap
from neurad.emitters.environment import Environment
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.lights import Lights, WithPunctual, make_lights
from neurad.integrators.world import World
from neurad.scene.description import Scene


def fitted_environment(world: World) -> FittedEnvironment | None:
    """The environment of a world that is being recovered; None where it is known."""
    lights = world.lights.others if isinstance(world.lights, WithPunctual) else world.lights
    lights = lights.environment if isinstance(lights, Lights) else lights
    return lights if isinstance(lights, FittedEnvironment) else None


def relit_world(world: World, scene: Scene, environment: EnvironmentMap) -> World:
    """The same surfaces under another environment; area lights stay."""
    lights = make_lights(scene, world.geometry, Environment(environment)).to(world.geometry.vertices.device)
    return World(
        geometry=world.geometry,
        tracer=world.tracer,
        lights=lights,
        bsdf=world.bsdf,
        features=replace(world.features, has_environment=True),
        two_sided=world.two_sided,
        hide_environment=world.hide_environment,
        delta=world.delta,
    )


def unknown_environment(scene: Scene, settings: Lighting) -> FittedEnvironment | None:
    """The environment to recover, or None where it is known.

    Raises:
        InputError: the scene has no environment at all.
    """
    if settings.environment == "known":
        return None
    if scene.environment is None or not scene.features.has_environment:
        raise InputError(
            f"scene {scene.name}: model.lighting.environment is fit, but scene.xml has no environment emitter "
            "(a constant one is enough)"
        )
    return FittedEnvironment(scene.environment, settings.width, settings.height)
