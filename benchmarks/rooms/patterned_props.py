"""Objects in the patterned kitchen: table and stools, sideboard and shelf, crockery and fruit."""

from collections.abc import Iterator

from benchmarks.rooms import patterns as p
from benchmarks.rooms.furnished import SINK, Item
from benchmarks.rooms.patterns import finish
from benchmarks.rooms.solids import ball, cup, jar, turned
from neurad.scene.builtin.shapes import Point, box, join, rotated

TABLE = 0.75
WORKTOP = 0.92


def table() -> Iterator[Item]:
    """The table, its cloth and three stools."""
    top = finish("table_top", p.wood(70, 2), (0.46, 0.29, 0.16), (0.76, 0.58, 0.38), (0.22, 0.6), 70)
    yield Item(box((-0.35, TABLE - 0.045, 0.0), (0.95, TABLE, 0.8)), top, 0.5)
    corners = [(x, z) for x in (-0.29, 0.82) for z in (0.06, 0.67)]
    legs = [box((x, 0.01, z), (x + 0.07, TABLE - 0.043, z + 0.07)) for x, z in corners]
    apron = box((-0.25, 0.62, 0.09), (0.85, TABLE - 0.044, 0.7))
    wood = finish("table_legs", p.planks(71, 3), (0.42, 0.26, 0.16), (0.72, 0.54, 0.36), (0.35, 0.7), 71)
    yield Item(join(*legs, apron), wood, 0.5)
    cloth = finish("runner", p.woven(2), (0.34, 0.46, 0.6), (0.84, 0.82, 0.74), (0.7, 0.9), 72)
    yield Item(box((0.1, TABLE - SINK, -0.012), (0.5, TABLE + 0.008, 0.812)), cloth, 0.3)
    stools: list[tuple[str, float, float, float, p.Colour, p.Colour]] = [
        ("stool_1", -0.75, 0.3, 10.0, (0.6, 0.24, 0.16), (0.84, 0.5, 0.34)),
        ("stool_2", 0.1, 1.2, 32.0, (0.2, 0.42, 0.4), (0.48, 0.72, 0.66)),
        ("stool_3", 1.42, 0.55, -14.0, (0.62, 0.48, 0.14), (0.85, 0.76, 0.4)),
    ]
    masks = [p.stripes(2, 0), p.checker(1), p.woven(2)]
    for i, (name, x, z, degrees, dark, light) in enumerate(stools):
        corners = [(x + a, z + b) for a in (-0.15, 0.11) for b in (-0.15, 0.11)]
        feet = [box((a, -SINK, b), (a + 0.04, 0.442, b + 0.04)) for a, b in corners]
        ring = box((x - 0.12, 0.15, z - 0.12), (x + 0.12, 0.18, z + 0.12))
        seat = box((x - 0.18, 0.44, z - 0.18), (x + 0.18, 0.485, z + 0.18))
        solid = rotated(join(*feet, ring, seat), degrees, (x, 0.0, z))
        yield Item(solid, finish(name, masks[i], dark, light, (0.3, 0.75), 73 + i), 0.4)


def on_table() -> Iterator[Item]:
    """A bowl of fruit, a plate, a mug and a vase."""
    y = TABLE - SINK
    bowl = finish("fruit_bowl", p.stripes(2, 1), (0.3, 0.4, 0.66), (0.82, 0.83, 0.82), (0.2, 0.5), 80)
    yield Item(cup((0.3, TABLE + 0.006, 0.38), 0.07, 0.17, 0.1, 0.012, 0.2), bowl, 0.2)
    fruit: list[tuple[str, Point, float, p.Colour, p.Colour]] = [
        ("apple", (0.25, TABLE + 0.085, 0.42), 0.055, (0.5, 0.1, 0.08), (0.78, 0.5, 0.2)),
        ("orange", (0.36, TABLE + 0.085, 0.41), 0.053, (0.7, 0.3, 0.06), (0.85, 0.56, 0.2)),
        ("pear", (0.3, TABLE + 0.09, 0.32), 0.056, (0.44, 0.5, 0.12), (0.8, 0.8, 0.36)),
    ]
    for i, (name, centre, radius, dark, light) in enumerate(fruit):
        finished = finish(name, p.noise(81 + i, 2), dark, light, (0.25, 0.6), 81 + i)
        yield Item(ball(centre, radius, 0.34), finished, 0.34)
    plate = finish("plate", p.stripes(2, 1), (0.5, 0.62, 0.46), (0.84, 0.85, 0.8), (0.2, 0.45), 85)
    yield Item(cup((-0.12, y, 0.52), 0.08, 0.145, 0.025, 0.015, 0.16), plate, 0.16)
    mug = finish("mug", p.spots(86, 2, 0.4), (0.82, 0.76, 0.6), (0.6, 0.22, 0.2), (0.2, 0.5), 86)
    yield Item(cup((0.72, y, 0.2), 0.045, 0.05, 0.11, 0.008, 0.16), mug, 0.16)
    profile = [
        (0.0, 0.0),
        (0.05, 0.0),
        (0.085, 0.07),
        (0.09, 0.12),
        (0.05, 0.2),
        (0.035, 0.24),
        (0.05, 0.28),
        (0.0, 0.27),
    ]
    vase = finish("vase", p.marble(87, 1), (0.22, 0.44, 0.5), (0.66, 0.8, 0.78), (0.2, 0.55), 87)
    yield Item(turned(profile, (0.72, y, 0.58), 0.28), vase, 0.28)


def on_worktop() -> Iterator[Item]:
    """Pots on the hob, jars, a bread board and a bowl."""
    y = WORKTOP - SINK
    red = finish("pot", p.gradient(1), (0.56, 0.12, 0.1), (0.82, 0.4, 0.3), (0.2, 0.5), 90)
    yield Item(cup((-0.45, 0.93, -1.46), 0.1, 0.115, 0.15, 0.01, 0.24), red, 0.24)
    blue = finish("pan", p.stripes(2, 1), (0.14, 0.2, 0.36), (0.44, 0.54, 0.68), (0.25, 0.6), 91)
    handle = box((-0.04, 0.985, -1.43), (0.1, 1.005, -1.4))
    yield Item(join(cup((-0.17, 0.93, -1.41), 0.1, 0.13, 0.07, 0.01, 0.2), handle), blue, 0.2)
    jars: list[tuple[str, float, float, float, p.Mask, p.Colour, p.Colour]] = [
        ("jar_1", -1.8, 0.085, 0.3, p.stripes(2, 1), (0.6, 0.36, 0.2), (0.85, 0.74, 0.54)),
        ("jar_2", -1.58, 0.075, 0.24, p.checker(1), (0.3, 0.5, 0.36), (0.74, 0.82, 0.62)),
        ("jar_3", -1.38, 0.07, 0.19, p.noise(92, 2), (0.5, 0.34, 0.52), (0.82, 0.7, 0.8)),
    ]
    for i, (name, x, radius, height, mask, dark, light) in enumerate(jars):
        finished = finish(name, mask, dark, light, (0.2, 0.55), 92 + i)
        yield Item(jar((x, y, -1.5), radius, height, 0.24), finished, 0.24)
    board = finish("bread_board", p.wood(96, 2), (0.52, 0.36, 0.2), (0.82, 0.66, 0.44), (0.4, 0.75), 96)
    yield Item(rotated(box((-1.2, y, -1.52), (-0.8, WORKTOP + 0.025, -1.24)), 12.0, (-1.0, 0.0, -1.4)), board, 0.3)
    bread = finish("loaf", p.noise(97, 3), (0.44, 0.24, 0.1), (0.8, 0.58, 0.32), (0.6, 0.9), 97)
    yield Item(
        rotated(box((-1.12, WORKTOP + 0.023, -1.44), (-0.87, WORKTOP + 0.12, -1.32)), 20.0, (-1.0, 0.0, -1.38)),
        bread,
        0.25,
    )
    bowl = finish("mixing_bowl", p.spots(98, 2, 0.4), (0.84, 0.8, 0.7), (0.36, 0.48, 0.62), (0.2, 0.55), 98)
    yield Item(cup((0.38, y, -1.42), 0.08, 0.17, 0.13, 0.012, 0.25), bowl, 0.25)
    box_red = finish("bread_bin", p.planks(99, 3), (0.36, 0.5, 0.5), (0.76, 0.84, 0.78), (0.25, 0.6), 99)
    yield Item(box((0.72, y, -1.65), (1.16, WORKTOP + 0.24, -1.34)), box_red, 0.4)


def around() -> Iterator[Item]:
    """Sideboard with plates on the front wall, shelf with jars and a picture on the right wall, a bin."""
    sideboard = finish("sideboard", p.wood(110, 2), (0.44, 0.28, 0.18), (0.74, 0.56, 0.38), (0.3, 0.7), 110)
    yield Item(box((-0.3, -SINK, 1.36), (1.55, 0.86, 1.752)), sideboard, 0.5)
    fronts: list[tuple[p.Mask, p.Colour, p.Colour]] = [
        (p.wood(111, 2), (0.5, 0.36, 0.3), (0.8, 0.68, 0.56)),
        (p.checker(1), (0.46, 0.5, 0.36), (0.76, 0.78, 0.6)),
        (p.marble(113, 1), (0.52, 0.4, 0.26), (0.84, 0.72, 0.5)),
    ]
    for i, (mask, dark, light) in enumerate(fronts):
        x = -0.27 + 0.607 * i
        finished = finish(f"sideboard_door_{i + 1}", mask, dark, light, (0.25, 0.7), 111 + i)
        yield Item(box((x, 0.08, 1.335), (x + 0.585, 0.8, 1.362)), finished, 0.42)
    shelf = finish("shelf", p.planks(115, 4), (0.5, 0.36, 0.24), (0.8, 0.66, 0.48), (0.3, 0.7), 115)
    yield Item(join(*(box((1.75, h, -0.55), (2.002, h + 0.04, 0.55)) for h in (1.2, 1.6))), shelf, 0.5)
    things: list[tuple[str, Point, float, float, p.Mask, p.Colour, p.Colour]] = [
        ("shelf_jar_1", (1.88, 1.238, -0.38), 0.075, 0.22, p.stripes(2, 1), (0.22, 0.42, 0.56), (0.68, 0.8, 0.84)),
        ("shelf_jar_2", (1.88, 1.238, -0.14), 0.08, 0.26, p.checker(1), (0.62, 0.4, 0.16), (0.85, 0.76, 0.48)),
        ("shelf_jar_3", (1.88, 1.638, 0.36), 0.08, 0.24, p.noise(118, 2), (0.56, 0.2, 0.26), (0.84, 0.62, 0.58)),
        ("shelf_jar_4", (1.88, 1.638, -0.3), 0.09, 0.2, p.spots(119, 2, 0.4), (0.82, 0.82, 0.72), (0.3, 0.5, 0.4)),
    ]
    for i, (name, centre, radius, height, mask, dark, light) in enumerate(things):
        finished = finish(name, mask, dark, light, (0.2, 0.6), 116 + i)
        yield Item(jar(centre, radius, height, 0.26), finished, 0.26)
    books = [box((1.8, 1.238, 0.08 + 0.07 * i), (1.98, 1.45 + 0.03 * (i % 3), 0.14 + 0.07 * i)) for i in range(5)]
    cover = finish("books", p.noise(120, 4), (0.44, 0.2, 0.24), (0.8, 0.66, 0.42), (0.4, 0.8), 120)
    yield Item(join(*books), cover, 0.6)
    picture = finish("picture", p.wallpaper(1), (0.3, 0.42, 0.62), (0.84, 0.68, 0.42), (0.3, 0.8), 121)
    yield Item(box((0.1, 1.25, 1.72), (1.2, 1.95, 1.752)), picture, 0.7)
    trolley = finish("crate", p.planks(122, 3), (0.44, 0.42, 0.2), (0.78, 0.74, 0.46), (0.4, 0.8), 122)
    yield Item(box((1.55, -SINK, 0.95), (2.002, 0.5, 1.3)), trolley, 0.4)
    profile = [(0.0, 0.0), (0.12, 0.0), (0.16, 0.42), (0.15, 0.46), (0.0, 0.5)]
    tin = finish("bin", p.stripes(2, 1), (0.3, 0.46, 0.42), (0.7, 0.8, 0.7), (0.2, 0.6), 123)
    yield Item(turned(profile, (-1.75, -SINK, -0.85), 0.4), tin, 0.4)
    chest = finish("chest", p.wallpaper(1), (0.5, 0.32, 0.36), (0.8, 0.66, 0.6), (0.3, 0.75), 124)
    yield Item(box((-2.002, -SINK, -0.35), (-1.6, 0.6, 0.75)), chest, 0.5)
    plant = finish("plant_pot", p.woven(1), (0.56, 0.3, 0.18), (0.84, 0.6, 0.4), (0.5, 0.9), 125)
    yield Item(cup((-1.79, 0.598, 0.45), 0.08, 0.12, 0.18, 0.015, 0.25), plant, 0.25)
    leaves = finish("plant", p.noise(126, 2), (0.14, 0.32, 0.1), (0.46, 0.64, 0.3), (0.35, 0.75), 126)
    crown = [
        ball((-1.79, 0.83, 0.45), 0.1, 0.4),
        ball((-1.74, 0.93, 0.5), 0.07, 0.4),
        ball((-1.8, 0.94, 0.4), 0.065, 0.4),
    ]
    yield Item(join(*crown), leaves, 0.4)
