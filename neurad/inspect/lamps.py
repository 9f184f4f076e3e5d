"""The lamps of a scene one at a time. Light is linear in them, so any brightness of each is a sum of pictures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.relight import shown_environment
from neurad.core.colour import luminance
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.emitters.lights import join, parts
from neurad.emitters.punctual import PunctualLights
from neurad.formats.edits.placement import turned_environment
from neurad.integrators.renderer import MethodRenderer, path_tracer
from neurad.integrators.world import World

MAX_LAMPS = 8
"""Lamps with a brightness of their own; dimmer ones beyond these share one."""
ENVIRONMENT = "environment"
FLASH = "flash"


@dataclass(frozen=True)
class Lamp:
    """A part of a scene's light that has a brightness of its own."""

    name: str
    meshes: tuple[int, ...] = ()
    """Indices into ``Scene.meshes``."""
    punctual: tuple[int, ...] = ()
    """Indices into ``Scene.punctual``."""

    @property
    def is_environment(self) -> bool:
        """Whether it is what is neither a mesh nor a light without extent."""
        return self.name == ENVIRONMENT and not self.meshes and not self.punctual

    @property
    def is_flash(self) -> bool:
        """Whether it moves with the camera."""
        return self.name == FLASH and not self.meshes and not self.punctual


@dataclass(frozen=True)
class LightSettings:
    """What a viewer made of the scene's light: the photographs' own is all ones and no turn."""

    scales: tuple[float, ...]
    """Times as bright, for each lamp."""
    turn: float = 0.0
    """Degrees that the environment is turned about its vertical axis, counterclockwise as seen from above."""


def lamps_of(assembly: Assembly) -> list[Lamp]:
    """The lamps of a scene, brightest first, then what moves with the camera, and the environment last.

    Meshes of one name are one lamp. At most :data:`MAX_LAMPS` lamps that are not the environment stand alone.
    """
    geometry, scene = assembly.world.geometry, assembly.scene
    power = luminance(_emission(assembly.world).double()) * geometry.face_area.double()
    by_mesh = torch.zeros(len(scene.meshes), dtype=torch.float64, device=power.device)
    by_mesh.index_add_(0, geometry.mesh_index, power)
    named: dict[str, list[int]] = {}
    for index in by_mesh.nonzero().squeeze(-1).tolist():
        named.setdefault(scene.meshes[index].name, []).append(index)
    powers = {Lamp(name, tuple(ids)): math.pi * float(by_mesh[ids].sum()) for name, ids in named.items()}
    radius = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2
    for index, light in enumerate(scene.punctual):
        if light.intensity.any():
            powers[Lamp(light.name, punctual=(index,))] = PunctualLights([light]).power(radius)
    lamps = sorted(powers, key=lambda lamp: -powers[lamp])
    if len(lamps) > MAX_LAMPS:
        rest = lamps[MAX_LAMPS - 1 :]
        meshes = tuple(index for lamp in rest for index in lamp.meshes)
        points = tuple(index for lamp in rest for index in lamp.punctual)
        lamps = [*lamps[: MAX_LAMPS - 1], Lamp(f"{len(rest)} other lamps", meshes, points)]
    if assembly.world.flash is not None:
        lamps.append(Lamp(FLASH))
    if _environment(assembly) is not None:
        lamps.append(Lamp(ENVIRONMENT))
    return lamps


def as_photographed(lamps: Sequence[Lamp]) -> LightSettings:
    """The light that the photographs were taken in."""
    return LightSettings((1.0,) * len(lamps))


def lamp_renderer(assembly: Assembly, lamp: Lamp, turn: float = 0.0) -> MethodRenderer:
    """Path tracing with the recovered materials in the light of one lamp alone, as bright as it is; the environment
    turned by ``turn`` degrees.
    """
    world, scene = assembly.world, assembly.scene
    area = environment = punctual = None
    if lamp.is_flash:
        area = AreaLights(world.geometry, dark=True)
    if lamp.meshes:
        chosen = torch.isin(world.geometry.mesh_index, torch.tensor(lamp.meshes, device=world.two_sided.device))
        area = AreaLights(world.geometry, _emission(world) * chosen.unsqueeze(-1))
    if lamp.punctual:
        punctual = PunctualLights([scene.punctual[index] for index in lamp.punctual])
    if lamp.is_environment:
        shown = _environment(assembly)
        assert shown is not None
        environment = Environment(turned_environment(shown, turn))
    lights = join(area, environment, punctual, float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) / 2)
    assert lights is not None
    lights = lights.to(world.two_sided.device)
    return path_tracer(world.under(lights, flash=lamp.is_flash), assembly.materials, scene.max_depth, scene.rr_depth)


def _emission(world: World) -> Tensor:
    """Radiance of every triangle [F, 3], as it was recovered where it was not known."""
    lamps, _, _ = parts(world.lights)
    return world.geometry.emission if lamps is None else lamps.emission


def _environment(assembly: Assembly) -> EnvironmentMap | None:
    """The environment of a run: the recovered one where it recovers one; None where there is none."""
    shines = assembly.environment is not None or assembly.scene.features.has_environment
    return shown_environment(assembly) if shines else None
