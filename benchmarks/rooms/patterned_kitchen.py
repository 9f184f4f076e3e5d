"""The built-in patterned kitchen: a closed room of some tens of objects, each of them patterned, lit by a window and a
ceiling lamp. Tests and measurements know it by the name ``patterns``.
"""

from itertools import chain

from benchmarks.rooms.furnished import Film, Light, furnished
from benchmarks.rooms.patterned_fixtures import base_units, frames, shell, wall_units
from benchmarks.rooms.patterned_props import around, on_table, on_worktop, table
from neurad.scene.builtin.shapes import Point, join, quad
from neurad.scene.description import Scene

FOV = 68.0
SIZE = 128
WINDOW = (5.6, 7.2, 9.4)
LAMP = (22.0, 19.0, 14.0)
"""Radiance of the two lights."""

TRAIN: list[tuple[Point, Point]] = [
    ((-1.45, 1.55, 0.95), (0.2, 0.7, -1.1)),
    ((-1.5, 1.5, 1.2), (1.4, 0.9, 0.2)),
    ((-0.9, 1.5, 1.3), (-0.5, 1.1, -1.75)),
    ((-0.3, 1.6, 1.1), (0.6, 1.2, -1.75)),
    ((0.6, 1.5, 1.1), (-1.2, 1.1, -1.75)),
    ((1.3, 1.55, 1.0), (-0.4, 0.8, -0.9)),
    ((1.5, 1.5, 0.9), (-2.0, 1.0, 0.2)),
    ((1.1, 1.4, 0.3), (1.5, 0.9, -1.75)),
    ((0.9, 1.5, -0.8), (0.1, 0.6, 1.4)),
    ((1.2, 1.6, -0.6), (-1.4, 0.7, 1.4)),
    ((0.2, 1.5, -0.9), (1.9, 1.0, 0.6)),
    ((-0.3, 1.5, -0.8), (1.0, 0.8, 1.75)),
    ((-1.1, 1.5, -0.8), (-0.9, 1.0, 1.75)),
    ((-1.6, 1.6, -0.8), (1.2, 0.7, 0.9)),
    ((-1.3, 1.5, 0.0), (2.0, 1.2, 0.0)),
    ((0.9, 1.6, -0.2), (-2.0, 1.1, -0.9)),
    ((1.6, 1.3, -0.3), (0.2, 0.5, 0.9)),
    ((-0.8, 1.35, -0.6), (0.4, 0.6, 0.5)),
    ((0.5, 1.35, -0.5), (0.3, 2.2, 1.75)),
    ((-1.4, 1.3, 0.5), (0.6, 2.5, -0.9)),
    ((1.2, 1.2, 1.1), (-1.0, 2.4, 0.0)),
    ((0.6, 1.75, 0.4), (0.25, 0.2, 0.1)),
    ((0.2, 1.5, -0.9), (-1.1, 0.1, 0.9)),
    ((1.0, 1.6, 0.9), (-0.6, 0.0, 0.5)),
]
TEST: list[tuple[Point, Point]] = [
    ((-1.1, 1.5, 1.1), (0.5, 0.8, -1.2)),
    ((1.3, 1.5, 0.7), (-1.0, 0.9, -0.9)),
    ((0.7, 1.55, -0.7), (-0.4, 0.7, 1.5)),
    ((-1.2, 1.5, -0.6), (1.5, 0.9, 0.7)),
]


FILM = Film(TRAIN, TEST, FOV, SIZE)


def model_patterns() -> Scene:
    """The patterned kitchen, with the photographs and material maps that ship."""
    window = join(*(quad((-1.935, 1.09, z), (0, 0.92, 0), (0, 0, 0.71)) for z in (-0.69, 0.08)))
    lamp = quad((-0.33, 2.535, -0.13), (0.66, 0, 0), (0, 0, 0.56))
    items = chain(shell(), base_units(), wall_units(), frames(), table(), on_table(), on_worktop(), around())
    lights = (Light("window", window, WINDOW), Light("lamp", lamp, LAMP))
    return furnished("patterns", items, lights, FILM)
