"""The kitchen's fixed furniture: cupboards, worktop, sink with its tap, oven, hob and hood."""

import math
from collections.abc import Iterator

from benchmarks.rooms import finishes as f
from benchmarks.rooms.furnished import SINK, Item
from benchmarks.rooms.patterns import material
from benchmarks.rooms.solids import bevelled, draped, tilted, tube, turned
from neurad.scene.builtin.shapes import Solid, box, join

TOP = 0.9
"""Height of the worktop."""
FRONT = -1.12
"""Where the doors of the base units stand, z."""
SAGE = (0.25, 0.34, 0.27)
CREAM = (0.72, 0.68, 0.58)


def panelled(x: tuple[float, float], y: tuple[float, float], z: float, rail: float = 0.065) -> Solid:
    """A door of a frame and a panel that lies deeper, facing +z."""
    (x0, x1), (y0, y1) = (x[0] + 0.003, x[1] - 0.003), (y[0] + 0.003, y[1] - 0.003)
    frame = [
        bevelled((x0, y0, z), (x0 + rail, y1, z + 0.022)),
        bevelled((x1 - rail, y0, z), (x1, y1, z + 0.022)),
        bevelled((x0 + rail - 0.004, y0, z), (x1 - rail + 0.004, y0 + rail, z + 0.0218)),
        bevelled((x0 + rail - 0.004, y1 - rail, z), (x1 - rail + 0.004, y1, z + 0.0218)),
    ]
    panel = box((x0 + 0.02, y0 + 0.02, z - SINK), (x1 - 0.02, y1 - 0.02, z + 0.009))
    return join(*frame, panel)


def pull(x: float, y: float, z: float, wide: float = 0.13) -> Solid:
    """A bow handle that lies across, on a front that faces +z."""
    half = 0.5 * wide
    bow = [(-half, 0.0), (-half, 0.024), (-half + 0.012, 0.032), (half - 0.012, 0.032), (half, 0.024), (half, 0.0)]
    return tube([(x + a, y, z - SINK + b) for a, b in bow], 0.0065, 8)


def base_units() -> Iterator[Item]:
    """Bodies, plinth, doors and drawers below the worktop."""
    body = join(
        box((-1.4, 0.1, -1.702), (0.45, 0.64, FRONT)),
        box((-1.4, 0.638, -1.702), (-0.64, 0.862, FRONT)),
        box((0.14, 0.638, -1.702), (0.45, 0.862, FRONT)),
        box((1.05, 0.1, -1.702), (2.002, 0.862, FRONT)),
    )
    yield Item(body, f.paint("base_units", SAGE, 0.34, 0.46, 100), 1.4)
    yield Item(
        box((-1.4, -SINK, -1.702), (2.002, 0.102, -1.17)), f.paint("plinth", (0.16, 0.2, 0.17), 0.3, 0.4, 102), 1.4
    )
    handles = []
    for i, (y0, y1) in enumerate([(0.1, 0.36), (0.36, 0.62), (0.62, 0.855)]):
        yield Item(
            panelled((-1.4, -0.75), (y0, y1), FRONT, 0.05),
            f.paint(f"drawer_{i + 1}", SAGE, 0.32, 0.48, 104 + 2 * i),
            1.15,
        )
        handles.append(pull(-1.075, 0.5 * (y0 + y1), FRONT + 0.009))
    doors = [(-0.75, -0.25, 0.635), (-0.25, 0.25, 0.635), (0.25, 0.45, 0.855), (1.05, 1.53, 0.855), (1.53, 1.98, 0.855)]
    for i, (x0, x1, y1) in enumerate(doors):
        finish = f.paint(f"door_{i + 1}", SAGE, 0.32, 0.48, 112 + 2 * i)
        yield Item(panelled((x0, x1), (0.1, y1), FRONT, 0.06 if x1 - x0 > 0.3 else 0.05), finish, 1.15)
        handles.append(pull(0.5 * (x0 + x1), y1 - 0.035, FRONT + 0.022, 0.11 if x1 - x0 > 0.3 else 0.08))
    yield Item(join(*handles), material("handles", (0.1, 0.09, 0.08), 0.3))


def larder() -> Iterator[Item]:
    """The tall cupboard in the corner, and the cupboard beside the window."""
    body = box((-2.002, -SINK, -1.702), (-1.4, 2.1, FRONT))
    yield Item(body, f.paint("larder", SAGE, 0.34, 0.46, 130), 1.4)
    handles = []
    for i, (y0, y1) in enumerate([(0.1, 0.95), (0.95, 2.09)]):
        yield Item(
            panelled((-1.985, -1.405), (y0, y1), FRONT),
            f.paint(f"larder_door_{i + 1}", SAGE, 0.32, 0.48, 132 + 2 * i),
            1.2,
        )
        at = (-1.45, 0.8 if i == 0 else 1.1, FRONT + 0.022)
        handles.append(tilted(pull(*at), 90.0, 2, at))
    yield Item(box((-1.398, 1.5, -1.702), (-0.9, 2.1, -1.4)), f.paint("wall_unit", SAGE, 0.34, 0.46, 136), 1.4)
    yield Item(panelled((-1.398, -0.9), (1.5, 2.1), -1.4), f.paint("wall_unit_door", SAGE, 0.32, 0.48, 138), 1.15)
    handles.append(pull(-1.149, 1.533, -1.378))
    yield Item(join(*handles), material("wall_handles", (0.1, 0.09, 0.08), 0.3))


def worktop() -> Iterator[Item]:
    """Polished stone with a round edge, cut out for the sink."""
    stone = f.stone("worktop", (0.075, 0.075, 0.08), (0.2, 0.19, 0.18), 0.14, 0.34, 140)
    low, edge, nose = 0.86, -1.0845, -1.065
    slabs = [
        box((-1.4, low, -1.702), (-0.62, TOP, edge)),
        box((0.12, low, -1.702), (2.002, TOP, edge)),
        box((-0.622, low, -1.702), (0.122, TOP - 0.0003, -1.555)),
    ]
    edges = [
        bevelled((-1.4, low, -1.1), (-0.62, TOP, nose), 0.015, 2),
        bevelled((0.12, low, -1.1), (2.002, TOP, nose), 0.015, 2),
    ]
    yield Item(join(*slabs, *edges), stone, 0.9)


def sink() -> Iterator[Item]:
    """A ceramic basin and the tap, which is a known metal."""
    x0, x1, z0, z1, low, high = -0.622, 0.122, -1.56, -1.05, 0.64, TOP + 0.006
    wall = 0.04
    parts = [
        bevelled((x0, low, z1 - wall), (x1, high, z1), 0.012, 2),
        bevelled((x0, low + 0.01, z0), (x1, high, z0 + wall), 0.012, 2),
        bevelled((x0, low + 0.01, z0 + 0.01), (x0 + wall, high - 0.0005, z1 - 0.01), 0.012, 2),
        bevelled((x1 - wall, low + 0.01, z0 + 0.01), (x1, high - 0.0005, z1 - 0.01), 0.012, 2),
        box((x0 + 0.01, low + 0.002, z0 + 0.01), (x1 - 0.01, low + 0.04, z1 - 0.01)),
    ]
    yield Item(join(*parts), f.paint("sink", (0.8, 0.79, 0.76), 0.3, 0.4, 142), 0.6)
    x, z, rise, reach = -0.25, -1.595, 1.2, 0.1
    arc = [math.pi * k / 10 for k in range(11)]
    spout = [(x, TOP - SINK, z), (x, TOP + 0.1, z)]
    spout += [(x, rise + reach * math.sin(a), z + reach - reach * math.cos(a)) for a in arc]
    spout += [(x, rise - 0.06, z + 2 * reach)]
    foot = turned([(0.0, 0.0), (0.03, 0.0), (0.03, 0.012), (0.02, 0.02), (0.0, 0.02)], (x, TOP - SINK, z), 0.2, 20)
    taps = [tube(spout, 0.0135, 14), foot]
    for sign in (-1.0, 1.0):
        at = x + sign * 0.1
        body = turned(
            [(0.0, 0.0), (0.024, 0.0), (0.018, 0.05), (0.018, 0.075), (0.0, 0.08)], (at, TOP - SINK, z), 0.2, 18
        )
        taps += [body, tube([(at, TOP + 0.065, z), (at + sign * 0.055, TOP + 0.075, z + 0.012)], [0.008, 0.006], 10)]
    yield Item(join(*taps), f.metal("tap", (0.72, 0.72, 0.74)))


def cooker() -> Iterator[Item]:
    """Oven, hob and hood, and a towel over the oven's rail."""
    x0, x1 = 0.455, 1.045
    yield Item(box((x0, 0.1, -1.702), (x1, 0.862, FRONT + 0.004)), f.paint("oven", CREAM, 0.34, 0.44, 150), 0.6)
    door = bevelled((x0 + 0.008, 0.16, FRONT), (x1 - 0.008, 0.7, FRONT + 0.03), 0.008, 2)
    yield Item(door, f.paint("oven_door", CREAM, 0.34, 0.44, 152), 0.6)
    pane = bevelled((x0 + 0.09, 0.27, FRONT + 0.02), (x1 - 0.09, 0.58, FRONT + 0.0335), 0.004)
    yield Item(pane, f.paint("oven_pane", (0.05, 0.045, 0.045), 0.15, 0.28, 154), 0.5)
    knobs = []
    for k in range(5):
        at = (x0 + 0.1 + 0.0975 * k, 0.785, FRONT + 0.002)
        profile = [(0.0, 0.0), (0.024, 0.0), (0.021, 0.022), (0.0, 0.024)]
        knobs.append(tilted(turned(profile, at, 0.1, 18), 90.0, 0, at))
    yield Item(join(*knobs), material("oven_knobs", (0.12, 0.11, 0.1), 0.35))
    y, z = 0.662, FRONT + 0.075
    rail = tube(
        [(x0 + 0.05, y, FRONT + 0.02), (x0 + 0.05, y, z), (x1 - 0.05, y, z), (x1 - 0.05, y, FRONT + 0.02)], 0.009, 10
    )
    yield Item(rail, material("oven_rail", (0.5, 0.48, 0.45), 0.25))
    yield Item(_towel(0.79, y, z), f.cloth("towel", (0.76, 0.74, 0.68), (0.2, 0.3, 0.5), 156, 3), 0.12)
    hob = bevelled((x0 + 0.01, TOP - SINK, -1.6), (x1 - 0.01, TOP + 0.008, -1.14), 0.003)
    yield Item(hob, f.paint("hob", (0.045, 0.045, 0.05), 0.15, 0.28, 158), 0.5)
    hood = [
        bevelled((x0 - 0.04, 1.56, -1.702), (x1 + 0.04, 1.63, -1.22), 0.008),
        bevelled((x0 + 0.17, 1.625, -1.702), (x1 - 0.17, 2.502, -1.42), 0.006),
    ]
    yield Item(join(*hood), f.paint("hood", CREAM, 0.34, 0.44, 160), 1.2)


def _towel(x: float, y: float, z: float) -> Solid:
    """A towel that hangs over a rail along x, its front half lower."""
    lines = []
    for depth, height in [
        (0.013, -0.27),
        (0.014, -0.2),
        (0.013, -0.12),
        (0.012, -0.05),
        (0.0105, 0.0),
        (0.005, 0.0165),
    ]:
        row = []
        for k in range(17):
            t = k / 16
            swing = 0.006 * math.sin(2 * math.pi * 2.5 * t) * min(1.0, -4.0 * min(height, 0.0))
            row.append((x - 0.1 + 0.2 * t, y + height + 0.006, z + depth + swing + 0.008))
        lines.append(row)
    return draped(lines, 0.007)
