"""The kitchen's room: floor, walls with a window, tiles, curtains, door, and the lights; in metres, y up.

It reaches from -2 to 2 in x, from 0 to 2.5 in y and from -1.7 to 1.7 in z; the window is in the wall at -1.7.
"""

from collections.abc import Iterator

import numpy as np

from benchmarks.rooms import finishes as f
from benchmarks.rooms.furnished import SINK, Item, Light
from benchmarks.rooms.patterns import material
from benchmarks.rooms.solids import ball, bevelled, curtain, tube, turned
from neurad.core.records import Float64Array
from neurad.scene.builtin.plain import room
from neurad.scene.builtin.shapes import Solid, box, join, quad, rotated

LOW, HIGH = (-2.0, 0.0, -1.7), (2.0, 2.5, 1.7)
OPENING = ((-0.75, 1.1), (0.25, 2.05))
"""The window's lower left and upper right corner, x and y."""
OUTSIDE = -1.87
"""Where the view out of the window stands, z."""
DOORWAY = ((0.35, 0.03), (1.2, 2.05))
"""The garden door's lower and upper corner, z and y."""
ROOF = ((-0.5, -0.8), (1.1, 0.2))
"""Two corners of the window in the ceiling, x and z."""
BEYOND = -2.15
"""Where the view out of the door stands, x."""
WARM = (0.74, 0.68, 0.56)
WHITE = (0.78, 0.77, 0.73)
GREEN = (0.13, 0.17, 0.14)
"""Colour of what stands close to the sky: white, few paths would carry much of the light there, and the noise."""


def shell() -> Iterator[Item]:
    """Floor, ceiling, walls and the window's reveal."""
    side = room(LOW, HIGH)
    floor = f.boards("floor", (0.22, 0.125, 0.065), (0.46, 0.29, 0.165), 0.15, 0.6, 1, 20, 4, (512, 768), 0.045, 0.4)
    yield Item(side["floor"], floor, 3.2)
    yield Item(side["ceiling"], f.paint("ceiling", (0.8, 0.79, 0.76), 0.34, 0.42, 10), 2.0)
    yield Item(_door_wall(), f.paint("wall_left", WARM, 0.37, 0.43, 12), 1.7)
    yield Item(side["right"], f.paint("wall_right", WARM, 0.37, 0.43, 14), 1.7)
    yield Item(side["front"], f.paint("wall_front", (0.36, 0.46, 0.5), 0.37, 0.43, 16), 1.7)
    yield Item(_window_wall(), f.paint("wall_back", WARM, 0.37, 0.43, 18), 1.7)
    yield Item(_reveal(), f.paint("reveal", WHITE, 0.34, 0.44, 20), 0.9)
    ledge = [(LOW[0], HIGH[0], -1.702, -1.688), (LOW[0], HIGH[0], 1.688, 1.702)]
    skirting = [box((a, -SINK, c), (b, 0.09, d)) for a, b, c, d in ledge]
    (z0, _), (z1, _) = DOORWAY
    sides = [(LOW[0], -1.702, z0 - 0.08), (LOW[0], z1 + 0.08, 1.702), (HIGH[0], -1.702, 1.702)]
    skirting += [box((x - 0.014, -SINK, a), (x + 0.014, 0.09, b)) for x, a, b in sides]
    yield Item(join(*skirting), f.paint("skirting", WHITE, 0.34, 0.44, 22), 0.9)


def _window_wall() -> Solid:
    """The wall around the opening, in eight parts that share their corners."""
    (x0, y0), (x1, y1) = OPENING
    xs, ys = (LOW[0], x0, x1, HIGH[0]), (LOW[1], y0, y1, HIGH[1])
    parts = [
        quad((xs[i], ys[j], LOW[2]), (xs[i + 1] - xs[i], 0, 0), (0, ys[j + 1] - ys[j], 0))
        for i in range(3) for j in range(3) if (i, j) != (1, 1)
    ]  # fmt: skip
    return join(*parts)


def _door_wall() -> Solid:
    """The wall around the doorway, in eight parts that share their corners."""
    (z0, y0), (z1, y1) = DOORWAY
    zs, ys = (LOW[2], z0, z1, HIGH[2]), (LOW[1], y0, y1, HIGH[1])
    parts = [
        quad((LOW[0], ys[j], zs[i]), (0, ys[j + 1] - ys[j], 0), (0, 0, zs[i + 1] - zs[i]))
        for i in range(3) for j in range(3) if (i, j) != (1, 1)
    ]  # fmt: skip
    return join(*parts)


def _reveal() -> Solid:
    """The sides of the two holes in the walls, facing into them."""
    (x0, y0), (x1, y1) = OPENING
    z0, depth = OUTSIDE - 0.02, LOW[2] - OUTSIDE + 0.02
    hole = [
        quad((x0, y0, z0), (0, y1 - y0, 0), (0, 0, depth)),
        quad((x1, y0, z0), (0, 0, depth), (0, y1 - y0, 0)),
        quad((x0, y0, z0), (0, 0, depth), (x1 - x0, 0, 0)),
        quad((x0, y1, z0), (x1 - x0, 0, 0), (0, 0, depth)),
    ]
    (z0, y0), (z1, y1) = DOORWAY
    x0, depth = BEYOND - 0.02, LOW[0] - BEYOND + 0.02
    hole += [
        quad((x0, y0, z0), (depth, 0, 0), (0, y1 - y0, 0)),
        quad((x0, y0, z1), (0, y1 - y0, 0), (depth, 0, 0)),
        quad((x0, y0, z0), (0, 0, z1 - z0), (depth, 0, 0)),
        quad((x0, y1, z0), (depth, 0, 0), (0, 0, z1 - z0)),
    ]
    return join(*hole)


def window() -> Iterator[Item]:
    """Frame, sill and curtains."""
    (x0, y0), (x1, y1) = OPENING
    a, b, middle, cross = -1.815, -1.77, 0.5 * (x0 + x1), 1.72
    bars = [
        bevelled((x0 - SINK, y0 - SINK, a), (x0 + 0.05, y1 + SINK, b)),
        bevelled((x1 - 0.05, y0 - SINK, a), (x1 + SINK, y1 + SINK, b)),
        bevelled((x0 + 0.04, y0 - SINK, a), (x1 - 0.04, y0 + 0.05, b)),
        bevelled((x0 + 0.04, y1 - 0.05, a), (x1 - 0.04, y1 + SINK, b)),
        bevelled((middle - 0.03, y0 + 0.04, a - 0.004), (middle + 0.03, y1 - 0.04, b + 0.006)),
        bevelled((x0 + 0.04, cross, a), (middle, cross + 0.035, b)),
        bevelled((middle, cross, a), (x1 - 0.04, cross + 0.035, b)),
    ]
    yield Item(join(*bars), f.paint("window_frame", GREEN, 0.28, 0.38, 30), 0.6)
    sill = bevelled((x0 - 0.06, y0 - 0.03, -1.81), (x1 + 0.06, y0 + 0.004, -1.635), 0.008, 2)
    yield Item(sill, f.paint("window_sill", WHITE, 0.34, 0.44, 32), 0.5)
    linen = f.cloth("curtains", (0.74, 0.68, 0.58), (0.55, 0.25, 0.2), 34, 4, checked=False)
    left = curtain((x0 - 0.1, x0 + 0.14), (y0 + 0.03, 2.19), -1.645, 4, 0.018)
    right = curtain((x1 - 0.14, x1 + 0.1), (y0 + 0.03, 2.19), -1.645, 4, 0.018)
    yield Item(join(left, right), linen, 0.36)
    rod = tube([(x0 - 0.14, 2.2, -1.645), (x1 + 0.14, 2.2, -1.645)], 0.011)
    ends = [ball((x, 2.2, -1.645), 0.022, 0.2, 8, 14) for x in (x0 - 0.15, x1 + 0.15)]
    holders = [tube([(x, 2.2, -1.645), (x, 2.2, -1.705)], 0.008) for x in (x0 - 0.12, x1 + 0.12)]
    yield Item(join(rod, *ends, *holders), material("curtain_rod", (0.07, 0.065, 0.06), 0.3))


def skylight() -> Iterator[Item]:
    """Frame and glazing bars of the window in the ceiling."""
    (x0, z0), (x1, z1) = ROOF
    low, high, wide = 2.462, 2.502, 0.06
    bars = [
        bevelled((x0 - wide, low, z0 - wide), (x1 + wide, high, z0 + 0.003)),
        bevelled((x0 - wide, low, z1 - 0.003), (x1 + wide, high, z1 + wide)),
        bevelled((x0 - wide, low + 0.0005, z0 - 0.003), (x0 + 0.003, high, z1 + 0.003)),
        bevelled((x1 - 0.003, low + 0.0005, z0 - 0.003), (x1 + wide, high, z1 + 0.003)),
    ]
    third = (x1 - x0) / 3
    bars += [
        bevelled((x - 0.015, low + 0.004, z0 - 0.003), (x + 0.015, 2.4925, z1 + 0.003))
        for x in (x0 + third, x1 - third)
    ]
    yield Item(join(*bars), f.paint("skylight_frame", GREEN, 0.28, 0.38, 60), 1.4)


def tiles() -> Iterator[Item]:
    """Glazed tiles between worktop and shelves, left out where the window is."""
    glazed = f.tiling("tiles", (0.66, 0.67, 0.62), (0.48, 0.46, 0.42), 0.38, 0.48, 40)
    (x0, y0), (x1, _) = OPENING
    back, front = -1.702, -1.69
    parts = [
        box((-1.4, 0.89, back), (2.002, y0 - 0.03, front)),
        box((-1.4, y0 - 0.03, back), (x0 - 0.06, 1.5, front)),
        box((x1 + 0.06, y0 - 0.03, back), (2.002, 1.5, front)),
    ]
    yield Item(join(*parts), glazed, 0.8)


def door() -> Iterator[Item]:
    """A glazed door to the garden in the left wall, its frame and its handle."""
    (z0, y0), (z1, y1) = DOORWAY
    a, b, middle = -2.075, -2.03, 0.5 * (z0 + z1)
    leaf = [
        bevelled((a, y0 - SINK, z0 - SINK), (b, y1 + SINK, z0 + 0.09)),
        bevelled((a, y0 - SINK, z1 - 0.09), (b, y1 + SINK, z1 + SINK)),
        bevelled((a, y0 - SINK, z0 + 0.08), (b, y0 + 0.28, z1 - 0.08)),
        bevelled((a, y1 - 0.1, z0 + 0.08), (b, y1 + SINK, z1 - 0.08)),
        bevelled((a + 0.004, y0 + 0.27, middle - 0.013), (b - 0.004, y1 - 0.09, middle + 0.013)),
    ]
    leaf += [bevelled((a + 0.005, y, z0 + 0.08), (b - 0.005, y + 0.026, z1 - 0.08)) for y in (0.73, 1.14, 1.55)]
    yield Item(join(*leaf), f.paint("door", GREEN, 0.26, 0.36, 50), 1.4)
    x = LOW[0]
    frame = [
        bevelled((x - SINK, -SINK, z0 - 0.09), (x + 0.03, y1 + 0.09, z0 - 0.003)),
        bevelled((x - SINK, -SINK, z1 + 0.003), (x + 0.03, y1 + 0.09, z1 + 0.09)),
        bevelled((x - SINK, y1 + 0.003, z0 - 0.085), (x + 0.029, y1 + 0.089, z1 + 0.085)),
    ]
    yield Item(join(*frame), f.paint("door_frame", WHITE, 0.32, 0.42, 52), 1.4)
    at = (b - 0.001, 1.0, z0 + 0.045)
    lever = tube([at, (at[0] + 0.045, at[1], at[2]), (at[0] + 0.05, at[1], at[2] + 0.11)], 0.009, 10)
    yield Item(lever, material("door_handle", (0.5, 0.36, 0.16), 0.25))


def pendants() -> Iterator[Item]:
    """Cords and caps of the two lamps over the table."""
    for i, (x, z) in enumerate(PENDANTS):
        cord = tube([(x, GLOBE + 0.115, z), (x, 2.502, z)], 0.006, 8)
        rose = turned([(0.0, 2.46), (0.05, 2.46), (0.05, 2.502), (0.0, 2.502)], (x, 0.0, z), 0.2, 20)
        cap = turned([(0.0, 0.088), (0.052, 0.088), (0.046, 0.122), (0.0, 0.142)], (x, GLOBE, z), 0.2, 20)
        yield Item(join(cord, rose, cap), material(f"pendant_{i + 1}", (0.09, 0.08, 0.07), 0.35))


PENDANTS = ((0.02, 0.5), (0.68, 0.5))
"""Where the two lamps hang, x and z."""
GLOBE = 1.72
"""Height of their middle."""


def lights() -> Iterator[Light]:
    """A window in the roof, which gives most of the light, what window and door show, and the two lamps."""
    (x0, z0), (x1, z1) = ROOF
    yield Light("skylight", quad((x0, 2.492, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0)), (6.2, 6.9, 7.6))
    (x0, y0), (x1, y1) = OPENING
    (z0, v0), (z1, v1) = DOORWAY
    sky, garden = [], []
    outlooks = [
        (np.linspace(x0 - 0.015, x1 + 0.015, 13), y0, y1, OUTSIDE, 0.0),
        (np.linspace(-z1 - 0.015, -z0 + 0.015, 13), v0, v1, BEYOND, 90.0),
    ]
    for across, low, high, depth, degrees in outlooks:
        ridge = 1.36 + 0.05 * np.sin(5.0 * across + 0.6) + 0.02 * np.sin(17.0 * across)
        bottom, top = np.full(13, low - 0.015), np.full(13, high + 0.015)
        sky.append(rotated(_strip(across, ridge, top, depth), degrees, (0.0, 0.0, 0.0)))
        garden.append(rotated(_strip(across, bottom, ridge, depth), degrees, (0.0, 0.0, 0.0)))
    yield Light("sky", join(*sky), (2.7, 3.2, 3.7))
    yield Light("garden", join(*garden), (1.0, 1.35, 0.6))
    globes = [ball((x, GLOBE, w), 0.1, 0.3, 10, 20) for x, w in PENDANTS]
    yield Light("lamps", join(*globes), (6.8, 5.2, 3.4))


def _strip(x: Float64Array, low: Float64Array, high: Float64Array, z: float) -> Solid:
    """A flat band between two curves, facing +z."""
    count = len(x)
    depth = np.full(count, z)
    vertices = np.concatenate((np.stack((x, low, depth), 1), np.stack((x, high, depth), 1)))
    j = np.arange(count - 1)
    faces = np.concatenate((np.stack((j, j + 1, j + count + 1), 1), np.stack((j, j + count + 1, j + count), 1)))
    return Solid(vertices, faces.astype(np.int64), vertices[:, :2], np.tile([0.0, 0.0, 1.0], (2 * count, 1)))
