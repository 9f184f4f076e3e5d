"""The lamps of a scene one at a time. Light is linear in them, so any brightness of each is a sum of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from neurad.assembly.build import Assembly
from neurad.assembly.relight import shown_environment
from neurad.core.colour import luminance
from neurad.core.records import EnvironmentMap
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.integrators.renderer import MethodRenderer, path_tracer
from neurad.integrators.world import World
from neurad.scene.placement import turned_environment

MOST = 8
"""Area lights with a brightness of their own; dimmer ones beyond these share one."""
ENVIRONMENT = "environment"


@dataclass(frozen=True)
class Lamp:
    """A part of a scene's light that has a brightness of its own."""

    name: str
    meshes: tuple[int, ...] = ()
    """Indices into ``Scene.meshes``; none: it is the environment."""


@dataclass(frozen=True)
class Light:
    """What a viewer made of the scene's light: the photographs' own is all ones and no turn."""

    scales: tuple[float, ...]
    """Times as bright, for each lamp."""
    turn: float = 0.0
    """Degrees that the environment is turned about its vertical axis, counterclockwise as seen from above."""


def lamps_of(assembly: Assembly) -> list[Lamp]:
    """The lamps of a scene, brightest first, the environment last.

    Meshes of one name are one lamp. At most :data:`MOST` area lights stand alone.
    """
    geometry, scene = assembly.world.geometry, assembly.scene
    power = luminance(geometry.emission.double()) * geometry.face_area.double()
    by_mesh = torch.zeros(len(scene.meshes), dtype=torch.float64, device=power.device)
    by_mesh.index_add_(0, geometry.mesh_index, power)
    named: dict[str, list[int]] = {}
    for index in by_mesh.nonzero().squeeze(-1).tolist():
        named.setdefault(scene.meshes[index].name, []).append(index)
    order = sorted(named, key=lambda name: -float(by_mesh[named[name]].sum()))
    lamps = [Lamp(name, tuple(named[name])) for name in order]
    if len(lamps) > MOST:
        rest = lamps[MOST - 1 :]
        lamps = [*lamps[: MOST - 1], Lamp(f"{len(rest)} other lamps", sum((lamp.meshes for lamp in rest), ()))]
    if _environment(assembly) is not None:
        lamps.append(Lamp(ENVIRONMENT))
    return lamps


def as_photographed(lamps: Sequence[Lamp]) -> Light:
    """The light that the photographs were taken in."""
    return Light((1.0,) * len(lamps))


def lamp_renderer(assembly: Assembly, lamp: Lamp, turn: float = 0.0) -> MethodRenderer:
    """Path tracing with the recovered materials in the light of one lamp alone, as bright as it is.

    Args:
        assembly: the parts of a run.
        lamp: of :func:`lamps_of`.
        turn: of the environment, in degrees.
    """
    world, scene = assembly.world, assembly.scene
    lights: AreaLights | Environment
    if lamp.meshes:
        chosen = torch.isin(world.geometry.mesh_index, torch.tensor(lamp.meshes, device=world.two_sided.device))
        lights = AreaLights(world.geometry, world.geometry.emission * chosen.unsqueeze(-1))
    else:
        environment = _environment(assembly)
        assert environment is not None
        lights = Environment(turned_environment(environment, turn)).to(world.two_sided.device)
    alone = World(
        world.geometry, world.tracer, lights, world.bsdf, world.features, world.two_sided, world.hide_environment,
        world.delta,
    )  # fmt: skip
    return path_tracer(alone, assembly.materials, scene.max_depth, scene.rr_depth)


def _environment(assembly: Assembly) -> EnvironmentMap | None:
    """The environment of a run: the recovered one where it recovers one; None where there is none."""
    shines = assembly.environment is not None or assembly.scene.features.has_environment
    return shown_environment(assembly) if shines else None
