"""The patterned kitchen's room and fixed furniture: x from -2 to 2, y from 0 to 2.6, z from -1.75 to 1.75 metres."""

from collections.abc import Iterator

from benchmarks.rooms import patterns as p
from benchmarks.rooms.furnished import SINK, Item
from benchmarks.rooms.patterns import finish
from neurad.scene.builtin.plain import room
from neurad.scene.builtin.shapes import box, join

LOW, HIGH = (-2.0, 0.0, -1.75), (2.0, 2.6, 1.75)


def shell() -> Iterator[Item]:
    """Floor, walls, ceiling and what is fixed flat to them."""
    side = room(LOW, HIGH)
    floor = finish("floor", p.checker(2, 2.0), (0.42, 0.31, 0.22), (0.78, 0.7, 0.58), (0.25, 0.6), 1)
    yield Item(side["floor"], floor, 1.2)
    ceiling = finish("ceiling", p.planks(11, 4), (0.6, 0.58, 0.53), (0.85, 0.84, 0.8), (0.6, 0.9), 2)
    yield Item(side["ceiling"], ceiling, 1.6)
    back = finish("wall_back", p.stripes(2, 0), (0.55, 0.66, 0.6), (0.8, 0.84, 0.76), (0.5, 0.9), 3)
    yield Item(side["back"], back, 0.8)
    front = finish("wall_front", p.wallpaper(1), (0.72, 0.55, 0.4), (0.85, 0.8, 0.68), (0.45, 0.85), 4)
    yield Item(side["front"], front, 0.6)
    left = finish("wall_left", p.marble(12, 1), (0.5, 0.6, 0.72), (0.82, 0.84, 0.84), (0.45, 0.85), 5)
    yield Item(side["left"], left, 1.0)
    right = finish("wall_right", p.spots(13, 2, 0.38), (0.85, 0.72, 0.56), (0.68, 0.42, 0.3), (0.4, 0.85), 6)
    yield Item(side["right"], right, 0.7)
    tiles = finish("splashback", p.tiles(14, 4), (0.3, 0.42, 0.46), (0.74, 0.85, 0.82), (0.2, 0.5), 7)
    yield Item(box((-2.002, 0.918, -1.752), (1.25, 1.449, -1.735)), tiles, 0.72)
    rug = finish("rug", p.woven(2), (0.45, 0.16, 0.18), (0.84, 0.64, 0.44), (0.7, 0.9), 8)
    yield Item(box((-0.75, -SINK, -0.35), (1.25, 0.012, 1.15)), rug, 0.6)
    door = finish("door", p.wood(15, 2), (0.42, 0.5, 0.36), (0.7, 0.78, 0.58), (0.3, 0.65), 9)
    yield Item(box((-1.75, 0.004, 1.71), (-0.85, 2.05, 1.752)), door, 0.7)
    frame = finish("door_frame", p.gradient(), (0.5, 0.42, 0.32), (0.84, 0.8, 0.7), (0.3, 0.7), 10)
    bars = [
        box((-1.86, -SINK, 1.69), (-1.752, 2.15, 1.752)),
        box((-0.848, -SINK, 1.69), (-0.74, 2.15, 1.752)),
        box((-1.754, 2.052, 1.692), (-0.846, 2.148, 1.752)),
    ]
    yield Item(join(*bars), frame, 0.5)
    knob = box((-0.98, 0.98, 1.66), (-0.92, 1.08, 1.712))
    yield Item(knob, finish("door_knob", p.gradient(), (0.5, 0.4, 0.15), (0.8, 0.68, 0.35), (0.2, 0.4), 11), 0.1)


def base_units() -> Iterator[Item]:
    """Cupboards below the worktop, the worktop and the hob."""
    body = finish("base_units", p.wood(20, 2), (0.5, 0.36, 0.24), (0.76, 0.62, 0.45), (0.4, 0.8), 20)
    yield Item(box((-2.002, 0.1, -1.752), (1.265, 0.87, -1.17)), body, 0.5)
    plinth = finish("plinth", p.planks(21, 3), (0.3, 0.28, 0.28), (0.58, 0.56, 0.54), (0.3, 0.7), 21)
    yield Item(box((-2.002, -SINK, -1.752), (1.263, 0.102, -1.23)), plinth, 0.6)
    doors = [
        ("base_door_1", p.wood(22, 2), (0.4, 0.52, 0.62), (0.68, 0.8, 0.85)),
        ("base_door_2", p.wood(23, 2), (0.48, 0.6, 0.5), (0.8, 0.85, 0.7)),
        ("base_door_3", p.stripes(2, 1), (0.5, 0.54, 0.64), (0.8, 0.82, 0.85)),
        ("base_door_4", p.marble(25, 1), (0.42, 0.5, 0.58), (0.74, 0.82, 0.82)),
        ("base_door_5", p.wood(26, 2), (0.5, 0.54, 0.42), (0.82, 0.84, 0.7)),
    ]
    handles = []
    for i, (name, mask, dark, light) in enumerate(doors):
        x = -1.99 + 0.648 * i
        finished = finish(name, mask, dark, light, (0.22, 0.6), 22 + i)
        yield Item(box((x + 0.015, 0.125, -1.172), (x + 0.633, 0.845, -1.145)), finished, 0.45)
        handles.append(box((x + 0.2, 0.74, -1.147), (x + 0.45, 0.775, -1.11)))
    brass = finish("base_handles", p.gradient(0), (0.5, 0.38, 0.18), (0.82, 0.7, 0.42), (0.2, 0.45), 28)
    yield Item(join(*handles), brass, 0.25)
    top = finish("worktop", p.spots(29, 3, 0.4), (0.68, 0.6, 0.5), (0.38, 0.3, 0.26), (0.2, 0.55), 29)
    yield Item(box((-2.002, 0.868, -1.752), (1.27, 0.92, -1.12)), top, 0.45)
    hob = finish("hob", p.checker(1), (0.16, 0.16, 0.2), (0.46, 0.46, 0.5), (0.2, 0.4), 30)
    yield Item(box((-0.62, 0.918, -1.66), (0.0, 0.932, -1.2)), hob, 0.3)


def wall_units() -> Iterator[Item]:
    """Cupboards on the back wall, the hood, the fridge."""
    body = finish("wall_units", p.wood(40, 2), (0.55, 0.4, 0.26), (0.8, 0.68, 0.5), (0.4, 0.8), 40)
    left, right = box((-2.002, 1.447, -1.752), (-0.66, 2.15, -1.42)), box((0.04, 1.447, -1.752), (1.25, 2.15, -1.42))
    yield Item(join(left, right), body, 0.5)
    doors = [
        ("wall_door_1", -1.99, p.stripes(2, 0), (0.56, 0.5, 0.36), (0.85, 0.82, 0.66)),
        ("wall_door_2", -1.325, p.wood(42, 2), (0.58, 0.42, 0.36), (0.85, 0.74, 0.62)),
        ("wall_door_3", 0.05, p.marble(43, 1), (0.52, 0.52, 0.4), (0.84, 0.82, 0.64)),
        ("wall_door_4", 0.645, p.wallpaper(1), (0.56, 0.5, 0.42), (0.84, 0.8, 0.72)),
    ]
    handles = []
    for i, (name, x, mask, dark, light) in enumerate(doors):
        width = 0.645 if x < 0 else 0.585
        finished = finish(name, mask, dark, light, (0.22, 0.65), 41 + i)
        yield Item(box((x + 0.015, 1.47, -1.422), (x + width, 2.13, -1.395)), finished, 0.45)
        handles.append(box((x + 0.2, 1.5, -1.397), (x + 0.4, 1.53, -1.362)))
    brass = finish("wall_handles", p.gradient(0), (0.45, 0.42, 0.4), (0.8, 0.78, 0.75), (0.2, 0.45), 46)
    yield Item(join(*handles), brass, 0.2)
    hood = finish("hood", p.stripes(2, 0), (0.42, 0.44, 0.46), (0.72, 0.74, 0.76), (0.25, 0.5), 47)
    canopy, duct = box((-0.655, 1.5, -1.752), (0.035, 1.62, -1.25)), box((-0.46, 1.618, -1.752), (-0.16, 2.602, -1.5))
    yield Item(join(canopy, duct), hood, 0.4)
    fridge = finish("fridge", p.gradient(1), (0.56, 0.66, 0.68), (0.84, 0.85, 0.85), (0.2, 0.5), 48)
    yield Item(box((1.272, -SINK, -1.752), (2.002, 1.82, -1.14)), fridge, 0.5)
    doors_of_fridge = [box((1.28, 0.08, -1.142), (1.99, 0.68, -1.1)), box((1.28, 0.7, -1.142), (1.99, 1.8, -1.1))]
    front = finish("fridge_doors", p.wallpaper(1), (0.5, 0.6, 0.62), (0.8, 0.85, 0.84), (0.2, 0.5), 49)
    yield Item(join(*doors_of_fridge), front, 0.6)
    bars = [box((1.34, 0.4, -1.102), (1.38, 0.64, -1.06)), box((1.34, 0.74, -1.102), (1.38, 1.1, -1.06))]
    steel = finish("fridge_handles", p.gradient(1), (0.3, 0.3, 0.32), (0.6, 0.6, 0.62), (0.2, 0.4), 50)
    yield Item(join(*bars), steel, 0.24)


def frames() -> tuple[Item, Item]:
    """The frames around window and ceiling lamp. The panes lie just in front of them: a frame that stood out would be
    lit from the closest distance, and speckle the room with noise.
    """
    bars = [
        box((-2.002, 1.0, -0.78), (-1.94, 1.1, 0.88)),
        box((-2.002, 2.0, -0.78), (-1.94, 2.1, 0.88)),
        box((-2.002, 1.098, -0.778), (-1.942, 2.002, -0.68)),
        box((-2.002, 1.098, 0.78), (-1.942, 2.002, 0.878)),
        box((-2.002, 1.098, 0.01), (-1.942, 2.002, 0.09)),
    ]
    window = finish("window_frame", p.wood(60, 2), (0.5, 0.42, 0.34), (0.84, 0.78, 0.68), (0.3, 0.6), 60)
    rim = [
        box((-0.4, 2.54, -0.2), (-0.32, 2.602, 0.5)),
        box((0.32, 2.54, -0.2), (0.4, 2.602, 0.5)),
        box((-0.322, 2.542, -0.198), (0.322, 2.602, -0.12)),
        box((-0.322, 2.542, 0.42), (0.322, 2.602, 0.498)),
    ]
    lamp = finish("lamp_frame", p.gradient(0), (0.4, 0.4, 0.42), (0.8, 0.8, 0.78), (0.3, 0.5), 61)
    return Item(join(*bars), window, 0.35), Item(join(*rim), lamp, 0.3)
