"""The kitchen's other walls: a dresser with a picture above it, a clock, a shelf, an apron on its hook."""

from collections.abc import Iterator

import numpy as np

from benchmarks.rooms import finishes as f
from benchmarks.rooms.furnished import SINK, Item
from benchmarks.rooms.kitchen_units import panelled, pull
from benchmarks.rooms.patterns import grid, material
from benchmarks.rooms.solids import bevelled, draped, jar, moved, swapped, tilted, tube, turned
from neurad.core.scene_records import Material
from neurad.scene.builtin.shapes import box, join, rotated


def dresser() -> Iterator[Item]:
    """A dresser at the front wall, what stands on it, and a picture above."""
    oak = f.boards("dresser", (0.28, 0.16, 0.08), (0.48, 0.3, 0.17), 0.35, 0.5, 360, 6, 1, (256, 256), 0.0)
    yield Item(box((-0.8, -SINK, 1.32), (0.9, 0.84, 1.702)), oak, 0.8)
    top = swapped(bevelled((-0.83, 0.838, 1.29), (0.93, 0.87, 1.702), 0.008, 2))
    yield Item(
        top,
        f.boards("dresser_top", (0.3, 0.17, 0.085), (0.5, 0.32, 0.18), 0.34, 0.46, 362, 4, 1, (256, 256), 0.02),
        0.8,
    )
    handles = []
    for i in range(3):
        x0 = -0.78 + 0.553 * i
        front = panelled((x0, x0 + 0.553), (0.06, 0.82), 0.0)
        centre = (x0 + 0.2765, 0.0, 0.0)
        placed = moved(rotated(front, 180.0, centre), (0.0, 0.0, 1.32))
        yield Item(
            placed,
            f.boards(
                f"dresser_door_{i + 1}",
                (0.28, 0.16, 0.08),
                (0.48, 0.3, 0.17),
                0.35,
                0.5,
                364 + 7 * i,
                5,
                1,
                (256, 128),
                0.0,
            ),
            0.6,
        )
        handles.append(moved(rotated(pull(x0 + 0.2765, 0.785, 0.022), 180.0, centre), (0.0, 0.0, 1.32)))
    yield Item(join(*handles), material("dresser_handles", (0.1, 0.09, 0.08), 0.3))
    y = 0.868
    yield Item(jar((-0.6, y, 1.5), 0.07, 0.24, 0.2), f.paint("dresser_jar", (0.5, 0.24, 0.14), 0.26, 0.46, 386), 0.3)
    vase = turned(
        [(0.0, 0.0), (0.05, 0.0), (0.09, 0.08), (0.085, 0.15), (0.035, 0.23), (0.04, 0.27), (0.0, 0.262)],
        (0.55, y, 1.5),
        0.3,
        32,
    )
    yield Item(vase, f.paint("vase", (0.22, 0.4, 0.38), 0.22, 0.4, 388), 0.3)
    books = [
        bevelled((-0.25 + 0.05 * i, y, 1.45), (-0.207 + 0.05 * i, y + 0.2 + 0.02 * (i % 3), 1.62), 0.003)
        for i in range(5)
    ]
    colours = [(0.5, 0.14, 0.1), (0.14, 0.24, 0.4), (0.66, 0.58, 0.4), (0.16, 0.32, 0.2), (0.56, 0.38, 0.12)]
    for i, (solid, colour) in enumerate(zip(books, colours, strict=True)):
        yield Item(solid, f.paint(f"book_{i + 1}", colour, 0.36, 0.55, 390 + 2 * i), 0.3)
    frame = [
        bevelled((-0.3, 1.3, 1.665), (0.5, 1.34, 1.702)), bevelled((-0.3, 1.86, 1.665), (0.5, 1.9, 1.702)),
        bevelled((-0.3, 1.335, 1.666), (-0.26, 1.865, 1.702)), bevelled((0.46, 1.335, 1.666), (0.5, 1.865, 1.702)),
    ]  # fmt: skip
    yield Item(join(*frame), f.paint("picture_frame", (0.3, 0.17, 0.08), 0.26, 0.4, 402), 0.4)
    yield Item(box((-0.28, 1.32, 1.685), (0.48, 1.88, 1.702)), _landscape(), 1.0)


def _landscape() -> Material:
    """A painting of hills below a sky."""
    u, v = grid(128, 128)
    across, up = (0.5 - u) * 1.0 * np.ones_like(v), v * np.ones_like(u)
    sky = np.array((0.5, 0.6, 0.68)) + np.array((0.2, 0.1, -0.1)) * np.exp(-((up - 0.6) ** 2) / 0.02)[..., None]
    albedo = sky
    for k, colour in enumerate([(0.34, 0.44, 0.46), (0.3, 0.4, 0.2), (0.5, 0.44, 0.16)]):
        ridge = 0.62 - 0.1 * k + 0.05 * np.sin(2 * np.pi * ((2 + k) * across + 0.3 * k))
        inside = 1.0 / (1.0 + np.exp(120.0 * (up - ridge)))
        albedo = albedo + (np.array(colour) - albedo) * inside[..., None]
    return material("picture", albedo, 0.38 + 0.06 * f.patches(404, u, v))


def on_walls() -> Iterator[Item]:
    """A clock and a shelf with jars on the right wall, an apron beside the door."""
    clock = turned(
        [(0.0, 0.0), (0.15, 0.0), (0.15, 0.03), (0.13, 0.035), (0.128, 0.022), (0.0, 0.022)], (0.0, 0.0, 0.0), 0.4, 40
    )
    at = (1.99, 1.75, 0.1)
    face = tilted(clock, 90.0, 2, (0.0, 0.0, 0.0))
    yield Item(moved(face, (2.001, at[1], at[2])), f.paint("clock", (0.74, 0.72, 0.66), 0.24, 0.4, 410), 0.4)
    x = 1.972
    hands = [bevelled((x - 0.006, at[1] - 0.015, at[2] - 0.006), (x, at[1] + 0.075, at[2] + 0.006), 0.002)]
    hands.append(
        tilted(
            bevelled((x - 0.009, at[1] - 0.015, at[2] - 0.004), (x - 0.004, at[1] + 0.105, at[2] + 0.004), 0.002),
            110.0,
            0,
            (x, at[1], at[2]),
        )
    )
    hands += [
        tilted(
            box((x - 0.004, at[1] + 0.1, at[2] - 0.004), (x + 0.01, at[1] + 0.12, at[2] + 0.004)),
            30.0 * k,
            0,
            (x, at[1], at[2]),
        )
        for k in range(12)
    ]
    yield Item(join(*hands), material("clock_hands", (0.05, 0.05, 0.05), 0.4))
    oak = f.boards("side_shelf", (0.34, 0.2, 0.1), (0.54, 0.36, 0.2), 0.3, 0.5, 412, 1, 1, (128, 128), 0.0)
    yield Item(bevelled((1.8, 1.2, 0.35), (2.002, 1.232, 1.25)), oak, 0.4)
    for i, (z, r, h, colour) in enumerate(
        [
            (0.5, 0.06, 0.2, (0.56, 0.5, 0.36)),
            (0.68, 0.06, 0.16, (0.22, 0.36, 0.3)),
            (1.05, 0.07, 0.22, (0.52, 0.2, 0.14)),
        ]
    ):
        yield Item(jar((1.9, 1.23, z), r, h, 0.2), f.paint(f"side_jar_{i + 1}", colour, 0.22, 0.42, 414 + 2 * i), 0.25)
    hooks = [tube([(-1.998, 1.5, z), (-1.95, 1.5, z), (-1.945, 1.53, z)], 0.006, 8) for z in (-0.35, -0.15, 0.05)]
    yield Item(
        join(bevelled((-2.002, 1.47, -0.45), (-1.98, 1.55, 0.15)), *hooks),
        f.paint("hook_rail", (0.4, 0.25, 0.13), 0.3, 0.6, 420),
        0.4,
    )
    lines = []
    for k, height in enumerate((0.75, 0.9, 1.05, 1.2, 1.35, 1.47)):
        width = (0.2, 0.2, 0.19, 0.16, 0.09, 0.03)[k]
        t = np.linspace(-1.0, 1.0, 25)
        fold = 0.02 * np.sin(7.0 * t + 0.4 * k) * (1.0 - k / 6.0)
        lines.append([(-1.95 + float(w), height, -0.15 - width * float(s)) for s, w in zip(t, fold, strict=True)])
    yield Item(draped(lines, 0.003), f.cloth("apron", (0.56, 0.58, 0.6), (0.2, 0.26, 0.36), 422, 5, checked=False), 0.4)
