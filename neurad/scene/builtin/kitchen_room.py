"""The kitchen's room: floor, walls with a window, tiles, curtains, door, and the lights; in metres, y up.

It reaches from -2 to 2 in x, from 0 to 2.5 in y and from -1.7 to 1.7 in z; the window is in the wall at -1.7.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from neurad.core.records import Material
from neurad.scene.builtin import finishes as f
from neurad.scene.builtin.plain import room
from neurad.scene.builtin.rounded import bevelled, curtain, tilted, tube
from neurad.scene.builtin.shapes import Solid, ball, box, join, quad, turned

LOW, HIGH = (-2.0, 0.0, -1.7), (2.0, 2.5, 1.7)
OPENING = ((-0.75, 1.1), (0.25, 2.05))
"""The window's lower left and upper right corner, x and y."""
OUTSIDE = -1.87
"""Where the view out of the window stands, z."""
SINK = 0.002
"""Things stand this much inside what carries them: no coplanar faces, no slits."""
WARM = (0.74, 0.68, 0.56)
WHITE = (0.78, 0.77, 0.73)


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


def shell() -> Iterator[Item]:
    """Floor, ceiling, walls and the window's reveal."""
    side = room(LOW, HIGH)
    floor = f.boards("floor", (0.22, 0.125, 0.065), (0.46, 0.29, 0.165), 0.24, 0.62, 1, 10, 2, (512, 512), 0.045)
    yield Item(side["floor"], floor, 1.6)
    yield Item(side["ceiling"], f.paint("ceiling", (0.8, 0.79, 0.76), 0.7, 0.85, 10), 2.0)
    yield Item(side["left"], f.paint("wall_left", WARM, 0.42, 0.8, 12), 1.7)
    yield Item(side["right"], f.paint("wall_right", WARM, 0.42, 0.8, 14), 1.7)
    yield Item(side["front"], f.paint("wall_front", (0.36, 0.46, 0.5), 0.4, 0.8, 16), 1.7)
    yield Item(_window_wall(), f.paint("wall_back", WARM, 0.45, 0.8, 18), 1.7)
    yield Item(_reveal(), f.paint("reveal", WHITE, 0.35, 0.6, 20), 0.9)
    ledge = [(LOW[0], HIGH[0], -1.702, -1.688), (LOW[0], HIGH[0], 1.688, 1.702)]
    skirting = [box((a, -SINK, c), (b, 0.09, d)) for a, b, c, d in ledge]
    skirting += [box((x - 0.014, -SINK, -1.702), (x + 0.014, 0.09, 1.702)) for x in (LOW[0], HIGH[0])]
    yield Item(join(*skirting), f.paint("skirting", WHITE, 0.3, 0.6, 22), 0.9)


def _window_wall() -> Solid:
    """The wall around the opening, in eight parts that share their corners."""
    (x0, y0), (x1, y1) = OPENING
    xs, ys = (LOW[0], x0, x1, HIGH[0]), (LOW[1], y0, y1, HIGH[1])
    parts = [
        quad((xs[i], ys[j], LOW[2]), (xs[i + 1] - xs[i], 0, 0), (0, ys[j + 1] - ys[j], 0))
        for i in range(3) for j in range(3) if (i, j) != (1, 1)
    ]  # fmt: skip
    return join(*parts)


def _reveal() -> Solid:
    """The four sides of the hole in the wall, facing into it."""
    (x0, y0), (x1, y1) = OPENING
    z0, depth = OUTSIDE - 0.02, LOW[2] - OUTSIDE + 0.02
    return join(
        quad((x0, y0, z0), (0, y1 - y0, 0), (0, 0, depth)),
        quad((x1, y0, z0), (0, 0, depth), (0, y1 - y0, 0)),
        quad((x0, y0, z0), (0, 0, depth), (x1 - x0, 0, 0)),
        quad((x0, y1, z0), (x1 - x0, 0, 0), (0, 0, depth)),
    )


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
    yield Item(join(*bars), f.paint("window_frame", WHITE, 0.25, 0.55, 30), 0.6)
    sill = bevelled((x0 - 0.06, y0 - 0.03, -1.81), (x1 + 0.06, y0 + 0.004, -1.635), 0.008, 2)
    yield Item(sill, f.paint("window_sill", WHITE, 0.2, 0.6, 32), 0.5)
    linen = f.cloth("curtains", (0.74, 0.68, 0.58), (0.55, 0.25, 0.2), 34, 4, checked=False)
    left = curtain((x0 - 0.1, x0 + 0.14), (y0 + 0.03, 2.19), -1.645, 4, 0.022)
    right = curtain((x1 - 0.14, x1 + 0.1), (y0 + 0.03, 2.19), -1.645, 4, 0.022)
    yield Item(join(left, right), linen, 0.36)
    rod = tube([(x0 - 0.14, 2.2, -1.645), (x1 + 0.14, 2.2, -1.645)], 0.011)
    ends = [ball((x, 2.2, -1.645), 0.022, 0.2, 8, 14) for x in (x0 - 0.15, x1 + 0.15)]
    holders = [tube([(x, 2.2, -1.645), (x, 2.2, -1.705)], 0.008) for x in (x0 - 0.12, x1 + 0.12)]
    yield Item(join(rod, *ends, *holders), f.material("curtain_rod", (0.07, 0.065, 0.06), 0.4))


def tiles() -> Iterator[Item]:
    """Glazed tiles between worktop and shelves, left out where the window is."""
    glazed = f.tiling("tiles", (0.66, 0.67, 0.62), (0.36, 0.34, 0.31), 0.15, 0.55, 40)
    (x0, y0), (x1, _) = OPENING
    back, front = -1.702, -1.69
    parts = [
        box((-1.4, 0.89, back), (2.002, y0 - 0.03, front)),
        box((-1.4, y0 - 0.03, back), (x0 - 0.06, 1.5, front)),
        box((x1 + 0.06, y0 - 0.03, back), (2.002, 1.5, front)),
    ]
    yield Item(join(*parts), glazed, 0.8)


def door() -> Iterator[Item]:
    """A panelled door in the left wall, its frame and its handle."""
    z0, z1, x = 0.35, 1.15, -2.0
    leaf = [bevelled((x - SINK, 0.004, z0), (x + 0.02, 2.0, z1))]
    rails = [(0.004, 0.2), (0.85, 1.0), (1.84, 2.0)]
    leaf += [bevelled((x, y0, z0 + 0.1), (x + 0.034, y1, z1 - 0.1)) for y0, y1 in rails]
    stiles = [(z0, z0 + 0.11), (0.7, 0.8), (z1 - 0.11, z1)]
    leaf += [bevelled((x, 0.004, a), (x + 0.0345, 2.0, b)) for a, b in stiles]
    yield Item(join(*leaf), f.paint("door", WHITE, 0.25, 0.65, 50), 0.8)
    frame = [
        bevelled((x - SINK, -SINK, z0 - 0.09), (x + 0.045, 2.1, z0 - 0.003)),
        bevelled((x - SINK, -SINK, z1 + 0.003), (x + 0.045, 2.1, z1 + 0.09)),
        bevelled((x - SINK, 2.003, z0 - 0.085), (x + 0.044, 2.099, z1 + 0.085)),
    ]
    yield Item(join(*frame), f.paint("door_frame", WHITE, 0.3, 0.6, 52), 0.8)
    knob = turned(
        [(0.0, 0.0), (0.012, 0.0), (0.012, 0.03), (0.026, 0.04), (0.026, 0.055), (0.0, 0.066)], (0, 0, 0), 0.1, 16
    )
    at = (x + 0.033, 0.98, z0 + 0.055)
    placed = Solid(knob.vertices + np.array(at), knob.faces, knob.uvs, knob.normals)
    yield Item(tilted(placed, -90.0, 2, at), f.material("door_knob", (0.5, 0.36, 0.16), 0.25))


def pendants() -> Iterator[Item]:
    """Cords and caps of the two lamps over the table."""
    for i, (x, z) in enumerate(PENDANTS):
        cord = tube([(x, GLOBE + 0.115, z), (x, 2.502, z)], 0.006, 8)
        rose = turned([(0.0, 2.46), (0.05, 2.46), (0.05, 2.502), (0.0, 2.502)], (x, 0.0, z), 0.2, 20)
        cap = turned([(0.0, 0.088), (0.052, 0.088), (0.046, 0.122), (0.0, 0.142)], (x, GLOBE, z), 0.2, 20)
        yield Item(join(cord, rose, cap), f.material(f"pendant_{i + 1}", (0.09, 0.08, 0.07), 0.35))


PENDANTS = ((0.02, 0.5), (0.68, 0.5))
"""Where the two lamps hang, x and z."""
GLOBE = 1.72
"""Height of their middle."""


def lights() -> Iterator[Light]:
    """What the window shows, and the two lamps."""
    (x0, y0), (x1, y1) = OPENING
    left, right, z = x0 - 0.015, x1 + 0.015, OUTSIDE
    columns = np.linspace(left, right, 13)
    ridge = 1.36 + 0.05 * np.sin(5.0 * columns + 0.6) + 0.02 * np.sin(17.0 * columns)
    yield Light("sky", _strip(columns, ridge, np.full(13, y1 + 0.015), z), (5.6, 7.0, 8.6))
    yield Light("garden", _strip(columns, np.full(13, y0 - 0.015), ridge, z), (1.5, 2.3, 0.8))
    globes = [ball((x, GLOBE, w), 0.1, 0.3, 10, 20) for x, w in PENDANTS]
    yield Light("lamps", join(*globes), (15.0, 11.2, 7.0))


def _strip(x: f.Mask, low: f.Mask, high: f.Mask, z: float) -> Solid:
    """A flat band between two curves, facing +z."""
    count = len(x)
    depth = np.full(count, z)
    vertices = np.concatenate((np.stack((x, low, depth), 1), np.stack((x, high, depth), 1)))
    j = np.arange(count - 1)
    faces = np.concatenate((np.stack((j, j + 1, j + count + 1), 1), np.stack((j, j + count + 1, j + count), 1)))
    return Solid(vertices, faces.astype(np.int64), vertices[:, :2], np.tile([0.0, 0.0, 1.0], (2 * count, 1)))
