"""The middle of the kitchen: table and chairs, and what is on the table."""

import math
from collections.abc import Iterator

from benchmarks.rooms import finishes as f
from benchmarks.rooms.furnished import SINK, Item
from benchmarks.rooms.kitchen_crockery import mug
from benchmarks.rooms.solids import ball, bevelled, cup, draped, moved, swapped, tube, turned
from neurad.scene.builtin.shapes import Point, Solid, box, join, rotated

TABLE = 0.76
LOW, HIGH = (-0.35, 0.1), (1.05, 0.9)
"""The table's corners, x and z."""


def table() -> Iterator[Item]:
    """The table: a top of boards, an apron and turned legs."""
    (x0, z0), (x1, z1) = LOW, HIGH
    top = f.boards("table_top", (0.36, 0.19, 0.09), (0.6, 0.38, 0.2), 0.15, 0.6, 300, 12, 1, (512, 384), 0.03, 0.4)
    yield Item(swapped(bevelled((x0, TABLE - 0.035, z0), (x1, TABLE, z1), 0.01, 2)), top, 1.5)
    profile = [
        (0.0, 0.0),
        (0.02, 0.0),
        (0.026, 0.05),
        (0.022, 0.1),
        (0.034, 0.3),
        (0.034, 0.5),
        (0.026, 0.53),
        (0.036, 0.56),
        (0.036, 0.73),
        (0.0, 0.73),
    ]
    legs = [turned(profile, (x, -SINK, z), 0.25, 18) for x in (x0 + 0.09, x1 - 0.09) for z in (z0 + 0.09, z1 - 0.09)]
    apron = [
        box((x0 + 0.07, TABLE - 0.12, z0 + 0.07), (x1 - 0.07, TABLE - 0.034, z0 + 0.09)),
        box((x0 + 0.07, TABLE - 0.12, z1 - 0.09), (x1 - 0.07, TABLE - 0.034, z1 - 0.07)),
        box((x0 + 0.071, TABLE - 0.1195, z0 + 0.08), (x0 + 0.09, TABLE - 0.034, z1 - 0.08)),
        box((x1 - 0.09, TABLE - 0.1195, z0 + 0.08), (x1 - 0.071, TABLE - 0.034, z1 - 0.08)),
    ]
    yield Item(join(*legs, *apron), f.paint("table_legs", (0.66, 0.62, 0.54), 0.36, 0.46, 302), 0.5)


def chair(at: tuple[float, float], degrees: float) -> Solid:
    """A chair with a slatted back, standing at ``at`` (x, z); unturned, one sits looking along -z."""
    half, seat, back = 0.19, 0.45, 0.88
    legs = [
        tube([(s * half, -SINK, -half), (s * (half - 0.02), seat - 0.01, -half + 0.02)], [0.014, 0.02], 10)
        for s in (-1, 1)
    ]
    for s in (-1, 1):
        legs.append(
            tube(
                [
                    (s * half, -SINK, half + 0.04),
                    (s * (half - 0.02), seat, half - 0.01),
                    (s * (half - 0.02), back, half + 0.06),
                ],
                [0.014, 0.019, 0.014],
                10,
            )
        )
    rungs = [
        tube([(s * (half - 0.008), 0.2, -half + 0.008), (s * (half - 0.008), 0.2, half + 0.02)], 0.009, 8)
        for s in (-1, 1)
    ]
    rungs.append(tube([(-half + 0.01, 0.24, -half + 0.01), (half - 0.01, 0.24, -half + 0.01)], 0.009, 8))
    plate = bevelled((-half - 0.015, seat - 0.012, -half - 0.02), (half + 0.015, seat + 0.018, half + 0.01), 0.012, 2)
    slats = []
    for y in (0.56, 0.68, 0.8):
        z = half - 0.01 + 0.07 * (y - seat) / (back - seat)
        slats.append(bevelled((-half + 0.015, y, z - 0.008), (half - 0.015, y + 0.06, z + 0.008), 0.007, 2))
    solid = join(*legs, *rungs, plate, *slats)
    return moved(rotated(solid, degrees, (0.0, 0.0, 0.0)), (at[0], 0.0, at[1]))


def chairs() -> Iterator[Item]:
    """Three chairs around the table, painted in one colour: one in gloss, two in satin."""
    places = [((-0.62, 0.5), 82.0, 0.17), ((0.75, 1.05), 12.0, 0.38), ((0.3, -0.1), 170.0, 0.36)]
    for i, (at, degrees, smooth) in enumerate(places):
        coat = f.paint(f"chair_{i + 1}", (0.16, 0.28, 0.36), smooth, smooth + 0.1, 310 + 2 * i)
        yield Item(chair(at, -degrees), coat, 1.0)


def fruit() -> Iterator[Item]:
    """A bowl with apples, oranges, a lemon and bananas."""
    x, y, z = 0.4, TABLE - SINK, 0.47
    profile = [
        (0.0, 0.0), (0.065, 0.0), (0.065, 0.012), (0.11, 0.035), (0.15, 0.085), (0.155, 0.09), (0.15, 0.095),
        (0.143, 0.09), (0.105, 0.045), (0.05, 0.022), (0.0, 0.02),
    ]  # fmt: skip
    yield Item(turned(profile, (x, y, z), 0.3, 40), f.paint("fruit_bowl", (0.76, 0.76, 0.73), 0.22, 0.34, 330), 0.3)
    h = y + 0.045
    apples = [
        ((x - 0.065, h, z + 0.03), 0.04),
        ((x + 0.035, h, z + 0.06), 0.039),
        ((x - 0.01, h + 0.058, z + 0.012), 0.039),
    ]
    reds = [
        ((0.5, 0.04, 0.03), (0.6, 0.2, 0.06)),
        ((0.46, 0.05, 0.03), (0.56, 0.34, 0.08)),
        ((0.36, 0.5, 0.08), (0.5, 0.52, 0.12)),
    ]
    for i, ((at, r), (one, other)) in enumerate(zip(apples, reds, strict=True)):
        yield Item(_apple(at, r), f.skin(f"apple_{i + 1}", one, other, 0.2, 0.5, 332 + 2 * i), 0.25)
    oranges = [(x - 0.03, h, z - 0.055), (x + 0.066, h + 0.003, z - 0.02)]
    for i, at in enumerate(oranges):
        yield Item(
            ball(at, 0.041, 0.2, 14, 26),
            f.skin(f"orange_{i + 1}", (0.68, 0.24, 0.02), (0.74, 0.33, 0.04), 0.3, 0.55, 340 + 2 * i),
            0.25,
        )
    lemon = tube(
        [
            (-0.052, 0, 0),
            (-0.045, 0, 0),
            (-0.033, 0, 0),
            (-0.015, 0, 0),
            (0.01, 0, 0),
            (0.03, 0, 0),
            (0.043, 0, 0),
            (0.051, 0, 0),
        ],
        [0.004, 0.01, 0.024, 0.032, 0.032, 0.024, 0.01, 0.004],
        20,
    )
    placed = moved(rotated(lemon, 35.0, (0, 0, 0)), (x + 0.04, h + 0.052, z - 0.05))
    yield Item(placed, f.skin("lemon", (0.72, 0.56, 0.05), (0.76, 0.64, 0.12), 0.3, 0.55, 344), 0.2)
    bananas = []
    for k in range(3):
        arc = [0.55 + 1.9 * j / 12 for j in range(13)]
        path = [(0.1 * math.cos(a), 0.1 * math.sin(a) - 0.06 + 0.004 * k, 0.0) for a in arc]
        radii = [0.006, 0.011, 0.016, 0.018, 0.0185, 0.019, 0.019, 0.0185, 0.018, 0.016, 0.012, 0.007, 0.006]
        bananas.append(
            moved(
                rotated(tube(path, radii, 14), 30.0 + 14.0 * k, (0.0, 0.0, 0.0)),
                (x - 0.04 - 0.01 * k, h + 0.037, z + 0.075 + 0.029 * k - 0.06),
            )
        )
    yield Item(join(*bananas), f.skin("bananas", (0.7, 0.52, 0.06), (0.76, 0.6, 0.14), 0.4, 0.65, 346), 0.25)


def _apple(at: Point, radius: float) -> Solid:
    """An apple with its dimple and stalk, ``radius`` at its widest."""
    profile = [
        (0.0, -0.82),
        (0.3, -0.88),
        (0.62, -0.72),
        (0.88, -0.35),
        (1.0, 0.1),
        (0.93, 0.5),
        (0.7, 0.8),
        (0.38, 0.88),
        (0.14, 0.74),
        (0.0, 0.62),
    ]
    body = turned([(radius * a, radius * b) for a, b in profile], at, 0.25, 26)
    stalk = tube(
        [(at[0], at[1] + 0.6 * radius, at[2]), (at[0] + 0.1 * radius, at[1] + 1.15 * radius, at[2])], 0.0022, 6
    )
    return join(body, stalk)


def on_table() -> Iterator[Item]:
    """A cloth over the table's edge, a plate with a mug beside it, a jug."""
    yield Item(_runner(), f.cloth("cloth", (0.74, 0.7, 0.62), (0.52, 0.1, 0.09), 350, 3), 0.27)
    y = TABLE - SINK
    yield Item(
        cup((-0.1, y, 0.6), 0.075, 0.125, 0.018, 0.01, 0.25, 36),
        f.paint("plate", (0.74, 0.72, 0.66), 0.22, 0.34, 352),
        0.25,
    )
    yield Item(
        rotated(mug((-0.12, y, 0.3), 0.042, 0.095), 130.0, (-0.12, 0.0, 0.3)),
        f.paint("mug", (0.16, 0.32, 0.46), 0.2, 0.34, 354),
        0.2,
    )
    profile = [
        (0.0, 0.0), (0.05, 0.0), (0.07, 0.03), (0.075, 0.08), (0.055, 0.14), (0.045, 0.18), (0.055, 0.215),
        (0.048, 0.215),
        (0.038, 0.18), (0.047, 0.14), (0.066, 0.08), (0.06, 0.03), (0.0, 0.02),
    ]  # fmt: skip
    x, z = 0.78, 0.32
    ear = [
        (x + 0.05 + 0.045 * math.sin(a), y + 0.13 - 0.065 * math.cos(a), z)
        for a in [math.pi * k / 10 for k in range(11)]
    ]
    jug = rotated(join(turned(profile, (x, y, z), 0.3, 32), tube(ear, 0.008, 10)), -30.0, (x, 0.0, z))
    yield Item(jug, f.paint("jug", (0.66, 0.62, 0.5), 0.32, 0.42, 356), 0.3)


def _runner() -> Solid:
    """A cloth that lies on the table, rumpled, and falls over its front edge in folds."""
    (_, _), (_, z1) = LOW, HIGH
    lines = []
    fall = [
        (0.24, z1 + 0.022),
        (0.18, z1 + 0.021),
        (0.11, z1 + 0.018),
        (0.05, z1 + 0.013),
        (0.015, z1 + 0.009),
        (0.0, z1 - 0.004),
    ]
    flat = [(-0.0, z1 - 0.02 - 0.045 * k) for k in range(1, 9)]
    for n, (drop, z) in enumerate(fall + flat):
        row = []
        for k in range(33):
            t = k / 32
            x = 0.5 + 0.4 * t + 0.012 * math.sin(2.1 * n + 3.0 * t)
            fold = 0.011 * math.sin(2 * math.pi * 3 * t + 0.15 * n) * min(1.0, drop / 0.1)
            ripple = 0.0025 * (1.0 + math.sin(9.0 * t + 0.8 * n)) if drop == 0.0 else 0.0
            row.append((x, TABLE + 0.007 + ripple - drop, z + max(fold, -0.009)))
        lines.append(row)
    return draped(lines, 0.005)
