"""Light that is not known: what is built for it, and what it is compared with."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from neurad.assembly.region import TrainingPaths, training_paths
from neurad.assembly.settings import Lighting
from neurad.core.errors import InputError
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.environment import Environment
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.emitters.lights import make_lights, parts
from neurad.emitters.openings import MAX_ESCAPING, Openings
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.shining import Shining, lamps_in_parts, shining_scene

WIDTH = 256
"""Texels across of an environment to recover; from pole to pole it has half as many."""


def fitted_environment(world: World) -> FittedEnvironment | None:
    """The environment of a world that is being recovered; None where it is known."""
    _, environment, _ = parts(world.lights)
    return environment if isinstance(environment, FittedEnvironment) else None


def draw_by_openings(world: World, scene: Scene, paths: TrainingPaths | None = None) -> None:
    """Draw directions of the environment towards the openings that its light enters by, if it is hidden from most of
    the surfaces that the scene's views show.

    Args:
        paths: of these views; None casts them.
    """
    _, environment, _ = parts(world.lights)
    if environment is None:
        return
    paths = training_paths(world, scene, world.geometry.vertices.device) if paths is None else paths
    if 0 < len(paths.leaving) <= MAX_ESCAPING * paths.bounces:
        openings = Openings(paths.leaving, torch.from_numpy(scene.bounds))
        environment.enter_by(openings.to(world.geometry.vertices.device))


def recovered_lamps(world: World) -> FittedLamps | None:
    """The lamps of a world whose radiance is being recovered; None where it is known."""
    lamps, _, _ = parts(world.lights)
    return lamps if isinstance(lamps, FittedLamps) else None


def relit_world(world: World, scene: Scene, environment: EnvironmentMap) -> World:
    """A world of equal surfaces under another environment; area lights stay as they are or were recovered."""
    lamps, _, _ = parts(world.lights)
    lights = make_lights(scene, world.geometry, Environment(environment), lamps).to(world.geometry.vertices.device)
    made = world.under(lights, replace(world.features, has_environment=True))
    draw_by_openings(made, scene)
    return made


def lit_scene(scene: Scene, settings: Lighting, lamps: Sequence[Shining] | None) -> Scene:
    """The scene with the lamps of a fit.

    Raises:
        InputError: a lamp falls into too many parts.
    """
    scene = scene if lamps is None else shining_scene(scene, lamps)
    return lamps_in_parts(scene) if settings.split_lamps else scene


def unknown_environment(scene: Scene, settings: Lighting, fits: bool = True) -> FittedEnvironment | None:
    """The environment to recover, or None where it is known.

    Args:
        fits: False for what a fit has found, in a scene that may have another light: what that lacks does not shine.

    Raises:
        InputError: the scene of a fit has no environment at all.
    """
    if settings.environment == "known":
        return None
    if scene.environment is None or not scene.features.has_environment:
        if not fits:
            return None
        raise InputError(
            f"scene {scene.name}: model.lighting.environment is fit, but scene.xml has no environment emitter "
            "(a constant one is enough)"
        )
    return FittedEnvironment(scene.environment, WIDTH, WIDTH // 2)


def unknown_lamps(scene: Scene, geometry: Geometry, settings: Lighting, fits: bool = True) -> FittedLamps | None:
    """The lamps whose radiance the photographs are to say, or None where it is known or none was found; ``fits`` as in
    :func:`unknown_environment`.

    Raises:
        InputError: no mesh shines at all in the scene of a fit.
    """
    if settings.emitters == "known":
        return None
    check_known_beside_flash(scene, settings)
    meshes = lamps_of_scene(scene)
    if not meshes and (settings.emitters == "find" or not fits):
        return None
    if not meshes:
        raise InputError(
            f"scene {scene.name}: model.lighting.emitters is {settings.emitters}, but no shape of scene.xml has an "
            "area emitter of a radiance above 0; give each lamp one, whatever it is, such as 1"
        )
    declared = np.array([scene.meshes[index].radiance for index in meshes], np.float64)
    return FittedLamps(geometry, meshes, declared, train=settings.fits_lamps)


def check_known_beside_flash(scene: Scene, settings: Lighting) -> None:
    """Refuse to recover lamps from photographs with a flash, of whose light they would take a part for theirs.

    Raises:
        InputError: they are to be recovered, and there is a flash.
    """
    if scene.features.has_flash and settings.emitters != "known":
        raise InputError(
            f"scene {scene.name}: model.lighting.emitters {settings.emitters}: beside a flash all other lamps have to "
            "be known, or off"
        )


def lamps_of_scene(scene: Scene) -> list[int]:
    """Indices of the meshes that shine."""
    return [i for i, mesh in enumerate(scene.meshes) if mesh.radiance is not None and mesh.radiance.any()]
