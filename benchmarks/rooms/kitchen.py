"""The built-in kitchen: a room as people live in, lit by windows in its roof and its wall, a garden door and two lamps.

Of its surfaces all but one are unknown; the tap is a smooth metal, which is known. Their roughness comes from varnish,
glaze and wear, and does not follow their colour.
"""

from itertools import chain

from benchmarks.rooms.furnished import Film, furnished
from benchmarks.rooms.kitchen_crockery import on_worktop, shelves
from benchmarks.rooms.kitchen_room import door, lights, pendants, shell, skylight, tiles, window
from benchmarks.rooms.kitchen_table import chairs, fruit, on_table, table
from benchmarks.rooms.kitchen_units import base_units, cooker, larder, sink, worktop
from benchmarks.rooms.kitchen_walls import dresser, on_walls
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
    ((1.7, 1.1, 0.0), (-1.0, 0.0, 0.5)),
]
TEST: list[tuple[Point, Point]] = [
    ((-1.4, 1.55, 1.3), (0.45, 0.82, -0.8)),
    ((1.3, 1.5, 0.5), (-0.7, 0.95, -1.4)),
    ((0.15, 1.5, 1.05), (0.75, 1.0, -1.4)),
    ((0.9, 1.5, -0.7), (-0.5, 0.75, 1.3)),
]


FILM = Film(TRAIN, TEST, FOV, SIZE)


def model_kitchen() -> Scene:
    """The kitchen, with the photographs and material maps that ship."""
    items = chain(
        shell(), window(), skylight(), tiles(), door(), pendants(), base_units(), larder(), worktop(), sink(), cooker(),
        shelves(), on_worktop(), table(), chairs(), fruit(), on_table(), dresser(), on_walls(),
    )  # fmt: skip
    # depth 2: two thirds of the time of the usual 8 for the same noise
    return furnished("kitchen", items, lights(), FILM, rr_depth=2)
