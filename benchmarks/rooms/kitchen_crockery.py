"""What stands on the kitchen's shelves and on its worktop: crockery, tins, a pot, a kettle, bread and a herb."""

import math
from collections.abc import Iterator

from benchmarks.rooms import finishes as f
from benchmarks.rooms.furnished import SINK, Item
from benchmarks.rooms.kitchen_room import WHITE
from benchmarks.rooms.kitchen_units import TOP
from benchmarks.rooms.patterns import material
from benchmarks.rooms.solids import bevelled, cup, jar, moved, swapped, tilted, tube, turned
from neurad.scene.builtin.shapes import Point, Solid, join, rotated


def shelves() -> Iterator[Item]:
    """Two wooden shelves on the wall and the crockery on them."""
    oak = f.boards("shelves", (0.34, 0.2, 0.1), (0.56, 0.38, 0.22), 0.3, 0.5, 170, 1, 1, (256, 128), 0.0)
    heights = (1.5, 1.86)
    yield Item(swapped(join(*(bevelled((1.2, h, -1.702), (2.002, h + 0.032, -1.46)) for h in heights))), oak, 0.5)
    irons = [
        tube([(x, h - 0.1, -1.698), (x, h - 0.012, -1.69), (x, h - 0.008, -1.5)], 0.008, 8)
        for x in (1.3, 1.9)
        for h in heights
    ]
    yield Item(join(*irons), material("shelf_irons", (0.07, 0.065, 0.06), 0.45))
    low, high = heights[0] + 0.03, heights[1] + 0.03
    plates = [cup((1.38, low + 0.012 * k, -1.585), 0.06, 0.1, 0.02, 0.009, 0.2) for k in range(5)]
    yield Item(join(*plates), f.paint("plates", (0.78, 0.77, 0.73), 0.22, 0.36, 172), 0.2)
    bowls = [cup((1.62, low + 0.03 * k, -1.585), 0.035, 0.075, 0.05, 0.006, 0.2) for k in range(3)]
    yield Item(join(*bowls), f.paint("bowls", (0.2, 0.34, 0.5), 0.22, 0.36, 174), 0.2)
    mugs = [((1.83, low, -1.6), (0.62, 0.25, 0.16)), ((1.93, low, -1.56), (0.72, 0.6, 0.3))]
    for i, (at, colour) in enumerate(mugs):
        yield Item(mug(at), f.paint(f"shelf_mug_{i + 1}", colour, 0.22, 0.36, 176 + 2 * i), 0.2)
    tins = [
        (1.32, 0.055, 0.2, (0.66, 0.6, 0.46)), (1.46, 0.05, 0.17, (0.5, 0.2, 0.14)),
        (1.6, 0.055, 0.2, (0.3, 0.42, 0.34)), (1.74, 0.045, 0.15, (0.7, 0.68, 0.62)),
        (1.88, 0.055, 0.21, (0.2, 0.26, 0.36)),
    ]  # fmt: skip
    for i, (x, radius, height, colour) in enumerate(tins):
        yield Item(
            jar((x, high, -1.585), radius, height, 0.2), f.paint(f"tin_{i + 1}", colour, 0.24, 0.44, 180 + 2 * i), 0.25
        )


def mug(at: Point, radius: float = 0.038, height: float = 0.09) -> Solid:
    """A mug with its handle towards +x."""
    body = cup(at, 0.9 * radius, radius, height, 0.005, 0.2)
    x, y, z = at
    ear = [(x + 0.95 * radius + 0.028 * math.sin(a), y + 0.5 * height - 0.03 * math.cos(a), z) for a in
           [math.pi * k / 8 for k in range(9)]]  # fmt: skip
    return join(body, tube(ear, 0.005, 8))


def on_worktop() -> Iterator[Item]:
    """A pot on the hob, jars, a chopping board, spoons, a kettle and a herb on the sill."""
    y = TOP - SINK
    pot = cup((0.64, TOP + 0.007, -1.46), 0.1, 0.108, 0.12, 0.006, 0.3)
    ears = [
        tube(
            [
                (0.64 + s * 0.1, TOP + 0.1, -1.49),
                (0.64 + s * 0.14, TOP + 0.1, -1.48),
                (0.64 + s * 0.14, TOP + 0.1, -1.44),
                (0.64 + s * 0.1, TOP + 0.1, -1.43),
            ],
            0.007,
            8,
        )
        for s in (-1, 1)
    ]
    lid = turned(
        [
            (0.0, 0.0),
            (0.112, 0.0),
            (0.112, 0.008),
            (0.07, 0.03),
            (0.016, 0.04),
            (0.016, 0.055),
            (0.022, 0.065),
            (0.0, 0.075),
        ],
        (0.64, TOP + 0.126, -1.46),
        0.3,
    )
    yield Item(join(pot, *ears, lid), f.paint("pot", (0.55, 0.1, 0.06), 0.2, 0.34, 200), 0.3)
    board = tilted(bevelled((1.1, y, -1.61), (1.34, y + 0.34, -1.59), 0.006), -9.0, 0, (1.2, y, -1.59))
    yield Item(
        board,
        f.boards("chopping_board", (0.4, 0.24, 0.12), (0.62, 0.43, 0.25), 0.36, 0.55, 202, 3, 1, (128, 128), 0.0),
        0.26,
    )
    crock = cup((1.5, y, -1.52), 0.055, 0.065, 0.15, 0.008, 0.2)
    yield Item(crock, f.paint("crock", (0.7, 0.66, 0.56), 0.26, 0.42, 204), 0.25)
    spoons = []
    for dx, dz, tall in [(-0.03, 0.01, 0.3), (0.02, -0.02, 0.33), (0.03, 0.025, 0.28)]:
        spoons.append(
            tube(
                [
                    (1.5, y + 0.02, -1.52),
                    (1.5 + 0.7 * dx, y + 0.7 * tall, -1.52 + 0.7 * dz),
                    (1.5 + dx, y + tall - 0.05, -1.52 + dz),
                    (1.5 + 1.1 * dx, y + tall, -1.52 + 1.1 * dz),
                ],
                [0.006, 0.006, 0.008, 0.018],
                8,
            )
        )
    yield Item(join(*spoons), f.paint("spoons", (0.52, 0.35, 0.19), 0.5, 0.75, 206), 0.2)
    for i, (x, r, h, colour) in enumerate([(1.72, 0.065, 0.2, WHITE), (1.87, 0.055, 0.15, WHITE)]):
        yield Item(jar((x, y, -1.54), r, h, 0.2), f.paint(f"jar_{i + 1}", colour, 0.24, 0.4, 208 + 2 * i), 0.25)
    yield Item(kettle((-1.12, y, -1.4)), f.paint("kettle", (0.5, 0.58, 0.56), 0.22, 0.38, 212), 0.3)
    loaf = bevelled((-0.86, y + 0.018, -1.5), (-0.68, y + 0.1, -1.4), 0.04, 4)
    slab = bevelled((-0.92, y, -1.54), (-0.66, y + 0.02, -1.3), 0.006)
    yield Item(
        rotated(slab, 8.0, (-0.8, 0, -1.42)),
        f.boards("bread_board", (0.42, 0.27, 0.15), (0.6, 0.42, 0.26), 0.38, 0.6, 214, 1, 1, (128, 64), 0.0),
        0.26,
    )
    yield Item(
        rotated(loaf, 12.0, (-0.8, 0, -1.42)), f.skin("loaf", (0.4, 0.2, 0.08), (0.58, 0.36, 0.17), 0.5, 0.85, 216), 0.2
    )
    pot_at = (0.12, 1.1 + 0.003, -1.71)
    yield Item(
        cup(pot_at, 0.032, 0.045, 0.075, 0.006, 0.2), f.paint("herb_pot", (0.5, 0.24, 0.13), 0.5, 0.85, 218), 0.2
    )
    yield Item(
        _herb((pot_at[0], pot_at[1] + 0.06, pot_at[2])),
        f.skin("herb", (0.1, 0.24, 0.05), (0.2, 0.38, 0.1), 0.35, 0.6, 220),
        0.1,
    )


def kettle(at: Point) -> Solid:
    """A stove kettle with spout, lid and bow handle."""
    x, y, z = at
    body = turned(
        [
            (0.0, 0.0),
            (0.085, 0.0),
            (0.1, 0.03),
            (0.098, 0.08),
            (0.075, 0.13),
            (0.045, 0.15),
            (0.012, 0.156),
            (0.012, 0.17),
            (0.018, 0.18),
            (0.0, 0.19),
        ],
        at,
        0.3,
    )
    spout = tube([(x + 0.08, y + 0.06, z), (x + 0.125, y + 0.1, z), (x + 0.15, y + 0.14, z)], [0.022, 0.015, 0.011], 12)
    bow = [(x + 0.08 * math.cos(a), y + 0.12 + 0.12 * math.sin(a), z) for a in [math.pi * k / 12 for k in range(13)]]
    return join(body, spout, tube(bow, 0.007, 10))


def _herb(at: Point) -> Solid:
    """A bunch of leaves on a stalk each."""
    leaves = []
    for k in range(16):
        turn, lean = 2.4 * k, 0.012 + 0.05 * ((k * 7) % 16) / 16
        x, z = lean * math.cos(turn), lean * math.sin(turn)
        tall = 0.13 - 0.9 * lean + 0.012 * (k % 3)
        path = [
            (0.2 * x, 0.0, 0.2 * z),
            (0.7 * x, 0.55 * tall, 0.7 * z),
            (x, 0.8 * tall, z),
            (1.25 * x, tall, 1.25 * z),
            (1.45 * x, tall + 0.012, 1.45 * z),
        ]
        leaves.append(moved(tube(path, [0.003, 0.004, 0.014, 0.013, 0.003], 7), at))
    return join(*leaves)
