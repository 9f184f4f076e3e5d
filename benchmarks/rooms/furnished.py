"""Rooms of solids and lights, as the built-in kitchens are."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.scene.builtin.plain import views, with_files
from neurad.scene.builtin.shapes import Point, Solid
from neurad.scene.description import Scene

SINK = 0.002
"""Things stand this much inside what carries them: no coplanar faces, no slits."""


@dataclass(frozen=True)
class Item:
    """One object: a solid, its material, and the length in metres after which its texture repeats."""

    solid: Solid
    material: Material
    tile: float = 1.0


@dataclass(frozen=True)
class Light:
    """A surface that sends light, by its name."""

    name: str
    solid: Solid
    radiance: tuple[float, float, float]


@dataclass(frozen=True)
class Film:
    """Where cameras stand and what they look at, and their films."""

    train: Sequence[tuple[Point, Point]]
    test: Sequence[tuple[Point, Point]]
    fov: float
    """Degrees."""
    size: int
    """Pixels along a side."""


def furnished(name: str, items: Iterable[Item], lights: Iterable[Light], film: Film, **limits: Any) -> Scene:
    """The scene, with the photographs and material maps of its name that are shipped, where they are there.

    Args:
        name: of the scene.
        items: all that does not send light.
        lights: the rest.
        film: the views.
        limits: ``max_depth`` and ``rr_depth``, where they are not the usual ones.
    """
    materials: list[Material] = []
    meshes: list[Mesh] = []
    for item in items:
        meshes.append(item.solid.mesh(item.material.name, len(materials), item.tile))
        materials.append(item.material)
    for light in lights:
        radiance = np.array(light.radiance, np.float32)
        meshes.append(light.solid.mesh(light.name, len(materials), smooth_shading=False, radiance=radiance))
        materials.append(_pane(light.name))
    return Scene(
        name=name,
        meshes=meshes,
        materials=materials,
        train=with_files(name, views("train", film.train, film.fov, film.size)),
        test=with_files(name, views("test", film.test, film.fov, film.size)),
        **limits,
    )


def _pane(name: str) -> Material:
    return Material(
        name, PrincipledModel(), Constant(np.full(3, 0.5, np.float32)), Constant(np.full(1, 0.4, np.float32))
    )
