"""The built-in kitchen: a room as people live in, lit by windows in its roof and its wall, a garden door and two lamps.

Of its surfaces all but one are unknown; the tap is a smooth metal, which is known. Their roughness comes from varnish,
glaze and wear, and does not follow their colour.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from neurad.core.records import Constant, Material
from neurad.core.reflection import PrincipledModel
from neurad.scene.builtin.kitchen_crockery import crockery
from neurad.scene.builtin.kitchen_room import Item, door, lights, pendants, shell, skylight, tiles, window
from neurad.scene.builtin.kitchen_table import furniture
from neurad.scene.builtin.kitchen_units import units
from neurad.scene.builtin.kitchen_walls import walls
from neurad.scene.builtin.plain import views, with_files
from neurad.scene.builtin.shapes import Point
from neurad.scene.description import Scene

FOV = 66.0
SIZE = 256

TRAIN: list[tuple[Point, Point]] = [
    ((-1.55, 1.5, 1.0), (0.6, 0.8, -0.9)),
    ((-1.6, 1.45, 0.1), (0.6, 0.9, -1.3)),
    ((-0.5, 1.55, 0.2), (-0.5, 0.95, -1.7)),
    ((0.9, 1.5, 0.1), (-0.7, 1.05, -1.5)),
    ((1.55, 1.5, 0.9), (-0.5, 0.8, -0.7)),
    ((0.4, 1.45, -0.2), (1.1, 1.15, -1.7)),
    ((1.7, 1.5, -0.4), (-1.0, 0.9, -0.6)),
    ((1.5, 1.5, -0.7), (-0.2, 0.6, 0.9)),
    ((-0.9, 1.55, -0.7), (0.6, 0.6, 0.8)),
    ((-1.2, 1.5, -0.8), (0.3, 1.0, 1.7)),
    ((0.6, 1.5, -0.8), (-1.7, 0.8, 0.6)),
    ((-0.5, 1.4, -0.8), (2.0, 1.1, 0.7)),
    ((0.35, 1.65, 1.2), (0.4, 0.6, 0.1)),
    ((-1.5, 1.2, 0.6), (0.2, 2.3, -0.9)),
    ((1.4, 1.2, -0.6), (-0.3, 2.2, 1.0)),
    ((-0.3, 1.3, 1.15), (0.5, 0.65, -0.6)),
    ((-1.45, 1.6, -0.6), (-0.4, 0.0, 0.6)),
    ((1.6, 1.5, 1.4), (0.9, 0.1, -0.6)),
]
TEST: list[tuple[Point, Point]] = [
    ((-1.4, 1.55, 1.3), (0.45, 0.82, -0.8)),
    ((1.3, 1.5, 0.5), (-0.7, 0.95, -1.4)),
    ((0.15, 1.5, 1.05), (0.75, 1.0, -1.4)),
    ((0.9, 1.5, -0.7), (-0.5, 0.75, 1.3)),
]


def build_kitchen() -> Scene:
    """The kitchen with the photographs and material maps that are shipped beside this file, where they are there."""
    items = list(_items())
    materials = [item.material for item in items]
    meshes = [item.solid.mesh(item.material.name, i, item.tile) for i, item in enumerate(items)]
    for light in lights():
        materials.append(_pane(light.name))
        radiance = np.array(light.radiance, np.float32)
        meshes.append(light.solid.mesh(light.name, len(materials) - 1, smooth_shading=False, radiance=radiance))
    return Scene(
        name="kitchen",
        meshes=meshes,
        materials=materials,
        train=with_files("kitchen", views("train", TRAIN, FOV, SIZE)),
        test=with_files("kitchen", views("test", TEST, FOV, SIZE)),
        rr_depth=2,  # two thirds of the time of the usual 8 for the same noise
    )


def _items() -> Iterator[Item]:
    """All that does not send light."""
    for part in (shell, window, skylight, tiles, door, pendants, units, crockery, furniture, walls):
        yield from part()


def _pane(name: str) -> Material:
    return Material(
        name, PrincipledModel(), Constant(np.full(3, 0.5, np.float32)), Constant(np.full(1, 0.4, np.float32))
    )
