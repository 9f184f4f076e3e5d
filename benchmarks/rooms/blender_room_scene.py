"""For Blender's Python: a furnished room as a .blend file, and its photographs by Cycles.

    python blender_room_scene.py ROOM.blend PHOTOGRAPHS [--samples N] [--size W H] [--views TRAIN TEST] [--seconds N]

Photographs that are there already are kept, so that a call goes on where another one ended.
"""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from blender_room_parts import (  # type: ignore[import-not-found]  # it lies beside this file
    COLUMNS,
    box,
    cushion,
    lathe,
    materials,
    solid,
    surface,
    turn,
)  # fmt: skip

WIDE, DEEP, HIGH = 5.0, 4.0, 2.7
FIELD = 75.0
"""Degrees across a photograph."""
NEAREST, MEAN_NEAREST = 0.45, 1.7
"""Metres between a camera and what it sees, and their mean."""
BOXES = (
    ("sill", (1.6, 3.86, 0.87), (3.4, 4.05, 0.904), "white lacquer", 0.01),
    ("skirting left", (0, 0, 0), (0.015, 4, 0.09), "white lacquer"),
    ("skirting right", (4.985, 0, 0), (5, 4, 0.09), "white lacquer"),
    ("skirting front", (1.4, 0, 0), (5, 0.015, 0.091), "white lacquer"),
    ("skirting back", (0, 3.985, 0), (5, 4, 0.091), "white lacquer"),
    ("door frame", (0.3, 0, 0), (1.4, 0.03, 2.12), "oak", 0.005, 0.8),
    ("door", (0.37, 0.005, 0.01), (1.33, 0.05, 2.05), "white lacquer", 0.006),
    ("door panel low", (0.5, 0.04, 0.25), (1.2, 0.06, 1.0), "white lacquer", 0.009),
    ("door panel high", (0.5, 0.04, 1.15), (1.2, 0.06, 1.9), "white lacquer", 0.009),
    ("lamp frame left", (1.08, 1.58, 2.67), (1.92, 2.42, 2.7), "steel", 0.004),
    ("lamp frame right", (3.08, 1.58, 2.67), (3.92, 2.42, 2.7), "steel", 0.004),
    ("window pane", (1.72, 4.075, 0.92), (3.28, 4.081, 2.18), "glass"),
    ("window bar left", (1.7, 4.05, 0.9), (1.76, 4.11, 2.2), "white lacquer", 0.006),
    ("window bar right", (3.24, 4.05, 0.9), (3.3, 4.11, 2.2), "white lacquer", 0.006),
    ("window bar middle", (2.475, 4.05, 0.9), (2.525, 4.11, 2.2), "white lacquer", 0.006),
    ("window bar low", (1.7, 4.052, 0.9), (3.3, 4.108, 0.96), "white lacquer", 0.006),
    ("window bar high", (1.7, 4.052, 2.14), (3.3, 4.108, 2.2), "white lacquer", 0.006),
    ("sofa base", (0.12, 0.9, 0.12), (0.95, 2.9, 0.36), "sofa cloth", 0.04),
    ("sofa back", (0.1, 0.9, 0.3), (0.34, 2.9, 0.86), "sofa cloth", 0.08),
    ("sofa arm front", (0.1, 0.78, 0.12), (0.97, 1.0, 0.62), "sofa cloth", 0.07),
    ("sofa arm back", (0.1, 2.8, 0.12), (0.97, 3.02, 0.62), "sofa cloth", 0.07),
    ("sofa seat front", (0.3, 1.0, 0.34), (0.98, 1.9, 0.5), "sofa cloth", 0.05),
    ("sofa seat back", (0.3, 1.9, 0.34), (0.98, 2.8, 0.5), "sofa cloth", 0.05),
    ("rug", (1.15, 0.85, 0.0), (2.75, 3.0, 0.012), "rug", 0.004, 2.2),
    ("low table", (1.5, 1.4, 0.38), (2.1, 2.5, 0.42), "walnut", 0.008, 0.7),
    ("shelf side front", (4.68, 2.3, 0), (4.99, 2.33, 2.0), "pine", 0.003, 0.6),
    ("shelf side back", (4.68, 3.67, 0), (4.99, 3.7, 2.0), "pine", 0.003, 0.6),
    ("shelf back", (4.98, 2.3, 0.02), (4.99, 3.7, 1.98), "pine", 0.0, 0.6),
    ("radio", (4.73, 2.5, 2.01), (4.9, 2.85, 2.2), "black plastic", 0.02),
    ("cupboard", (4.5, 0.25, 0.06), (4.99, 1.35, 1.9), "cupboard paint", 0.006),
    ("cupboard foot", (4.54, 0.27, 0), (4.99, 1.33, 0.07), "black plastic"),
    ("table", (2.95, 1.1, 0.71), (4.25, 1.95, 0.75), "oak", 0.008, 0.9),
    ("runner", (3.45, 1.08, 0.749), (3.75, 1.97, 0.753), "checks", 0.0, 0.8),
    ("sideboard", (1.8, 0.02, 0.1), (3.6, 0.45, 0.82), "white lacquer", 0.006),
    ("sideboard top", (1.78, 0.02, 0.82), (3.62, 0.47, 0.85), "oak", 0.006, 0.9),
    ("sideboard foot", (1.84, 0.04, 0), (3.56, 0.4, 0.1), "black plastic"),
    ("tiled wall", (1.8, 0.0, 0.85), (3.6, 0.012, 1.3), "tiles", 0.0, 0.6),
)
"""Name, lower and upper corner, material, bevel, and metres after which its picture repeats."""
PLATE = ((0.07, 0), (0.075, 0.004), (0.12, 0.016), (0.122, 0.02), (0.118, 0.02), (0.072, 0.009), (0.01, 0.008))
CUP = ((0.022, 0), (0.035, 0.03), (0.04, 0.07), (0.036, 0.07), (0.03, 0.03), (0.005, 0.006))
BOWL = ((0.05, 0), (0.06, 0.01), (0.13, 0.07), (0.14, 0.085), (0.13, 0.083), (0.055, 0.02), (0.01, 0.015))
VASE = ((0.045, 0), (0.075, 0.08), (0.06, 0.17), (0.03, 0.23), (0.045, 0.27), (0.035, 0.268), (0.02, 0.22))
JUG = ((0.05, 0), (0.08, 0.08), (0.05, 0.2), (0.06, 0.25), (0.05, 0.248), (0.04, 0.2))
FOOT = ((0.15, 0), (0.15, 0.02), (0.03, 0.04), (0.014, 0.06), (0.014, 1.42))
POT = ((0.11, 0), (0.16, 0.28), (0.17, 0.3), (0.15, 0.3), (0.145, 0.27))
TURNED = (
    ("lamp foot", FOOT, (0.45, 3.45, 0), "steel"), ("bowl", BOWL, (1.75, 1.75, 0.42), "glaze"),
    ("urn", VASE, (4.83, 3.5, 2.0), "glaze"), ("pot", POT, (4.25, 3.55, 0), "terracotta"),
    ("soil", ((0.1, 0.25), (0.146, 0.27)), (4.25, 3.55, 0), "soil"), ("jug", JUG, (2.1, 0.25, 0.85), "porcelain"),
    ("vase", VASE, (3.6, 1.53, 0.753), "glaze"),
)  # fmt: skip
PICTURES = (
    ("hills", (0.0, 1.35, 1.55), (0.8, 0.6), "frame"), ("painting", (0.0, 2.4, 1.55), (0.8, 0.6), "frame"),
    ("checks", (WIDE, 1.83, 1.6), (0.5, 0.65), "oak"), ("mirror", (2.7, 0.0, 1.8), (1.2, 0.7), "brass"),
)  # fmt: skip
"""What is framed, its middle on a wall, width and height, and what of."""


def shell(m: dict[str, Any]) -> None:
    """Floor, walls with a window, ceiling, lamps, curtains."""
    w, d, h = WIDE, DEEP, HIGH
    for name, corners, material, tile in (
        ("floor", [(0, 0, 0), (w, 0, 0), (w, d, 0), (0, d, 0)], "floor", 1.6),
        ("ceiling", [(0, 0, h), (0, d, h), (w, d, h), (w, 0, h)], "ceiling paint", 1.0),
        ("papered wall", [(0, 0, 0), (0, d, 0), (0, d, h), (0, 0, h)], "wallpaper", 1.3),
        ("right wall", [(w, 0, 0), (w, 0, h), (w, d, h), (w, d, 0)], "wall paint", 1.0),
        ("front wall", [(0, 0, 0), (0, 0, h), (w, 0, h), (w, 0, 0)], "wall paint", 1.0),
    ):
        solid(name, corners, [(0, 1, 2, 3)], m[material], tile)
    outer = [(0, d, 0), (w, d, 0), (w, d, h), (0, d, h)]
    inner = [(1.7, d, 0.9), (3.3, d, 0.9), (3.3, d, 2.2), (1.7, d, 2.2)]
    behind = [(x, d + 0.16, z) for x, _, z in inner]
    faces = [(i + k, i + (k + 1) % 4, i + 4 + (k + 1) % 4, i + 4 + k) for i in (0, 4) for k in range(4)]
    solid("window wall", outer + inner + behind, faces, m["wall paint"])
    sky = box("sky", (1.6, d + 0.16, 0.8), (3.4, d + 0.21, 2.3), bpy.data.materials.new("sky"))
    sky.data.materials[0].use_nodes = True
    shader = sky.data.materials[0].node_tree.nodes["Principled BSDF"]
    for key, value in (
        ("Base Color", (0, 0, 0, 1)),
        ("Emission Color", (0.5, 0.7, 1.0, 1)),
        ("Emission Strength", 1.1),
    ):
        shader.inputs[key].default_value = value
    lamp("ceiling lamp left", "AREA", (1.5, 2.0, h - 0.032), 44.0, (1.0, 0.88, 0.72), 0.8)
    lamp("ceiling lamp right", "AREA", (3.5, 2.0, h - 0.032), 44.0, (1.0, 0.88, 0.72), 0.8)
    lamp("bulb", "POINT", (0.45, 3.45, 1.52), 10.0, (1.0, 0.75, 0.48), 0.07)
    lathe("lamp shade", ((0.24, 1.35), (0.16, 1.68)), (0.45, 3.45, 0), m["shade"], 0.004)
    for side, x in (("left", 1.0), ("right", 3.3)):

        def hang(u: Any, v: Any, x: float = x) -> Any:
            return np.stack((x + 0.7 * u, d - 0.11 + 0.045 * np.sin(26.0 * u + 0.4 * v), 0.12 + 2.3 * v), 1)

        surface(f"curtain {side}", hang, (60, 8), m["curtain"], 0.004, 2.0)
    rail = lathe("curtain rail", ((0.012, -1.6), (0.012, 1.6)), (2.5, d - 0.11, 2.46), m["brass"])
    turn(rail, (2.5, d - 0.11, 2.46), math.pi / 2, "Y")


def lamp(name: str, kind: str, place: Any, watts: float, colour: Any, size: float) -> None:
    """A lamp that photographs show: a square that shines down, or a ball, of a side or radius in metres."""
    light = bpy.data.lights.new(name, kind)
    light.energy, light.color = watts, colour
    setattr(light, "size" if kind == "AREA" else "shadow_soft_size", size)
    made = bpy.data.objects.new(name, light)
    made.location, made.visible_camera = place, True
    bpy.context.collection.objects.link(made)


def frame(name: str, middle: Any, size: tuple[float, float], rim: Any, content: Any) -> None:
    """A picture or mirror in a frame on a wall, its middle on the wall; it shows the square of its picture."""
    axis = 1 if middle[1] == 0.0 else 0
    out = np.eye(3)[axis] * (1.0 if middle[axis] < 1.0 else -1.0)
    half, edge = np.array([0.0, 0.0, size[1] / 2]), 0.03
    half[1 - axis] = size[0] / 2
    for k, move in enumerate((1 - axis, 1 - axis, 2, 2)):
        at, part = np.array(middle, float), half + edge
        at[move] += (-1) ** k * (half[move] + edge / 2)
        part[move], part[axis] = edge / 2, 0.0
        ends = np.sort([at - part, at + part + (0.03 if k < 2 else 0.028) * out], 0)  # no coplanar faces at corners
        box(f"{name} frame {k}", *ends, rim, 0.005)
    low, high = np.sort([middle - half, middle + half + 0.012 * out], 0)
    box(name, low, high, content, uvs=[((k >> 1 if axis == 0 else k) & 1, k >> 2) for k in range(8)])


def book(name: str, low: Any, high: Any, column: int, m: dict[str, Any]) -> list[Any]:
    """A book that stands: its cover, whose back to -x shows a spine, and the paper in it."""
    step, thin = 1.0 / COLUMNS, 0.004
    uvs = [((column + 0.03 + 0.94 * (k >> 1 & 1)) * step, (k >> 2) * 0.998 + 0.001) for k in range(8)]
    paper = [(0.5 * step, 0.1 * (k >> 2)) for k in range(8)]
    inside = (low[0] + thin, low[1] + thin, low[2]), (high[0] - 0.002, high[1] - thin, high[2] + 0.001)
    return [box(name, low, high, m["books"], uvs=uvs), box(f"{name} paper", *inside, m["books"], uvs=paper)]


def knob(name: str, centre: Any, scale: float, m: dict[str, Any]) -> None:
    """A handle of brass that points to +y."""
    profile = [(r * scale, z * scale) for r, z in ((0.006, 0), (0.006, 0.015), (0.016, 0.02), (0.012, 0.03))]
    turn(lathe(name, profile, centre, m["brass"]), centre, -math.pi / 2, "X")


def sofa(m: dict[str, Any]) -> None:
    """What lies on the sofa and the low table, and their legs."""
    for k, (x, y) in enumerate(((0.2, 0.85), (0.85, 0.85), (0.2, 2.95), (0.85, 2.95))):
        box(f"sofa leg {k}", (x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.13), m["walnut"])
    for y, kind, lean in ((1.22, "cushion print", 1.15), (2.6, "cushion plain", 1.2), (2.2, "cushion print", 1.0)):
        turn(cushion(f"cushion {y}", (0.5, y, 0.7), (0.44, 0.44, 0.17), m[kind]), (0.5, y, 0.7), lean, "Y")
    for k, (x, y) in enumerate(((1.55, 1.45), (2.05, 1.45), (1.55, 2.45), (2.05, 2.45))):
        lathe(f"low table leg {k}", ((0.016, 0.012), (0.026, 0.38)), (x, y, 0), m["brass"])
    for k in range(2):
        for part in book(f"lying book {k}", (1.62, 2.1, 0.4), (1.82, 2.13, 0.68), 3 + 4 * k, m):
            turn(part, (1.62, 2.1, 0.4), -math.pi / 2, "X")  # on its side
            part.data.transform(Matrix.Translation((0.0, -0.1 + 0.02 * k, 0.05 + 0.031 * k)))
            turn(part, (1.72, 2.15, 0), 0.2 - 0.45 * k)


def shelf(m: dict[str, Any], rng: Any) -> None:
    """Boards with books, the doors of the cupboard, a plant."""
    for row in range(6):
        z = 0.06 + 0.385 * row
        box(f"board {row}", (4.68, 2.33, z), (4.98, 3.67, z + 0.025), m["pine"], 0.002, 0.6)
        y, end = 2.35, 2.29 + rng.uniform(0.7, 1.3) * (row < 5)
        while y < end:
            thick, tall, deep, at = rng.uniform((0.02, 0.2, 0.15, 4.7), (0.05, 0.31, 0.23, 4.74))
            high = (at + deep, y + thick - 0.001, z + 0.025 + tall)
            book(f"book {row} {y:.2f}", (at, y, z + 0.025), high, int(rng.integers(1, COLUMNS)), m)
            y += thick
    for k, y in enumerate((0.27, 0.805)):
        handle = y + (0.48 if k == 0 else 0.045)
        box(f"cupboard door {k}", (4.48, y, 0.1), (4.505, y + 0.525, 1.86), m["cupboard paint"], 0.005)
        box(f"cupboard field {k}", (4.47, y + 0.09, 0.25), (4.49, y + 0.435, 1.7), m["cupboard paint"], 0.008)
        box(f"handle {k}", (4.445, handle - 0.008, 0.95), (4.46, handle + 0.008, 1.15), m["steel"], 0.005)
        for z in (0.97, 1.12):
            box(f"post {k} {z}", (4.455, handle - 0.005, z), (4.482, handle + 0.005, z + 0.01), m["steel"])
    for k in range(22):
        long, droop, rise = rng.uniform((0.35, 0.3, 0.5), (0.6, 1.1, 1.1))

        def leaf(u: Any, v: Any, a: float = 2.4 * k, s: float = long, g: float = droop, r: float = rise) -> Any:
            far, side = s * (0.08 + 0.5 * v), 0.09 * s * (2 * u - 1) * np.sin(np.pi * np.clip(v, 0.02, 0.98)) ** 0.6
            x, y = far * math.cos(a) - side * math.sin(a), far * math.sin(a) + side * math.cos(a)
            return np.stack((4.25 + x, 3.55 + y, 0.26 + r * v - 0.5 * g * v * v), 1)

        surface(f"leaf {k}", leaf, (4, 10), m["leaves"], 0.002)


def dining(m: dict[str, Any]) -> None:
    """Legs of the table, chairs, crockery, the sideboard's drawers and what stands on it."""
    for k, (x, y) in enumerate(((3.0, 1.15), (4.2, 1.15), (3.0, 1.9), (4.2, 1.9))):
        box(f"table leg {k}", (x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.71), m["oak"], 0.006, 0.5)
    for k, (x, y, facing) in enumerate(((3.3, 0.85, 0.0), (3.95, 0.8, 0.1), (3.25, 2.2, 3.2), (3.9, 2.25, 3.0))):
        parts = [
            box(f"chair seat {k}", (x - 0.2, y - 0.2, 0.43), (x + 0.2, y + 0.2, 0.46), m["walnut"], 0.01, 0.5),
            box(f"chair back {k}", (x - 0.19, y - 0.205, 0.72), (x + 0.19, y - 0.18, 0.92), m["walnut"], 0.01, 0.5),
            cushion(f"chair cushion {k}", (x, y, 0.475), (0.36, 0.36, 0.05), m["cushion plain"]),
        ]
        for a, b, tall in ((-0.17, -0.18, 0.915), (0.17, -0.18, 0.915), (-0.17, 0.17, 0.44), (0.17, 0.17, 0.44)):
            low, high = (x + a - 0.017, y + b - 0.017, 0.0), (x + a + 0.017, y + b + 0.017, tall)
            parts.append(box(f"chair leg {k} {a} {b}", low, high, m["walnut"], 0.005, 0.5))
        for part in parts:
            turn(part, (x, y, 0), facing)
    for k, (x, y) in enumerate(((3.3, 1.27), (3.95, 1.27), (3.27, 1.78), (3.92, 1.78))):
        lathe(f"plate {k}", PLATE, (x, y, 0.75), m["porcelain"])
        lathe(f"cup {k}", CUP, (x + 0.19, y, 0.75), m["porcelain"])
    for k in range(4):
        x = 1.815 + 0.4425 * k
        box(f"drawer {k}", (x, 0.44, 0.62), (x + 0.43, 0.465, 0.8), m["white lacquer"], 0.004)
        box(f"drawer door {k}", (x, 0.44, 0.12), (x + 0.43, 0.465, 0.605), m["white lacquer"], 0.004)
        for z in (0.71, 0.5):
            knob(f"knob {k} {z}", (x + 0.215, 0.463, z), 1.0, m)
    knob("door knob", (1.27, 0.05, 1.05), 2.0, m)
    for k in range(5):
        low = (3.2 + 0.045 * k, 0.1, 0.85)
        for part in book(f"cookery {k}", low, (low[0] + 0.22, 0.14, 1.08 + 0.02 * (k % 3)), 2 + k, m):
            turn(part, (low[0], 0.1, 0), math.pi / 2)  # its back into the room
            turn(part, (low[0] - 0.02, 0.21, 0), math.pi)


def cameras(count: tuple[int, int], rng: Any) -> list[Any]:
    """Views that nothing near hides: from where a person could hold a camera, to anywhere in the room."""
    scene, graph = bpy.context.scene, bpy.context.evaluated_depsgraph_get()
    lens = bpy.data.cameras.new("lens")
    lens.sensor_width, lens.lens = 36.0, 18.0 / math.tan(math.radians(FIELD / 2))
    tall = scene.render.resolution_y / scene.render.resolution_x
    slope = math.tan(math.radians(FIELD / 2))
    film = [(x * slope, y * slope * tall) for x in np.linspace(-1, 1, 7) for y in np.linspace(-1, 1, 7)]
    names = [f"train_{k:03d}" for k in range(count[0])] + [f"test_{k:03d}" for k in range(count[1])]
    made: list[Any] = []
    while len(made) < len(names):
        eye = Vector(rng.uniform((0.3, 0.3, 0.7), (WIDE - 0.3, DEEP - 0.3, 2.2)))
        aim = Vector(rng.uniform((0.2, 0.2, 0.1), (WIDE - 0.2, DEEP - 0.2, 1.8)))
        if (aim - eye).length < 1.5 or abs((aim - eye).normalized().z) > 0.6:
            continue
        turned = (aim - eye).to_track_quat("-Z", "Y")
        hits = [scene.ray_cast(graph, eye, (turned @ Vector((x, y, -1.0))).normalized()) for x, y in film]
        far = [(hit[1] - eye).length for hit in hits]
        if min(far) < NEAREST or np.mean(far) < MEAN_NEAREST:
            continue
        camera = bpy.data.objects.new(names[len(made)], lens)
        camera.location, camera.rotation_euler = eye, turned.to_euler()
        bpy.context.collection.objects.link(camera)
        made.append(camera)
    return made


def settings(size: tuple[int, int], samples: int) -> None:
    """Light as it is, in linear pictures."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", samples
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = scene.cycles.blur_glossy = 0.0
    for kind in ("max", "diffuse", "glossy", "transmission"):
        setattr(scene.cycles, f"{kind}_bounces", 32)
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = size
    form = scene.render.image_settings
    form.file_format, form.color_mode, form.color_depth = "OPEN_EXR", "RGB", "16"


def main() -> None:
    """Write the room, then photograph it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("blend", type=Path)
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--samples", type=int, default=128, help="of a pixel")
    parser.add_argument("--size", type=int, nargs=2, default=(224, 168), help="pixels")
    parser.add_argument("--views", type=int, nargs=2, default=(28, 6), help="to learn from, and held out")
    parser.add_argument("--seed", type=int, default=51, help="of what is drawn: pictures, books, cameras")
    parser.add_argument("--seconds", type=float, default=math.inf, help="after which no more photograph is begun")
    asked = parser.parse_args()
    start = time.monotonic()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    settings(tuple(asked.size), asked.samples)
    m = materials(np.random.default_rng([asked.seed, 0]))
    shell(m)
    for name, low, high, kind, *rest in BOXES:
        box(name, low, high, m[kind], *rest)
    for name, profile, centre, kind in TURNED:
        lathe(name, profile, centre, m[kind])
    for kind, middle, size, rim in PICTURES:
        frame(kind, middle, size, m[rim], m[kind])
    sofa(m)
    shelf(m, np.random.default_rng([asked.seed, 1]))
    dining(m)
    bpy.context.view_layer.update()
    made = cameras(tuple(asked.views), np.random.default_rng([asked.seed, 2]))
    scene = bpy.context.scene
    scene.camera = made[0]
    bpy.ops.wm.save_as_mainfile(filepath=str(asked.blend.resolve()))
    for index, camera in enumerate(made):
        file = asked.photographs.resolve() / f"{camera.name}.exr"
        if file.is_file():
            continue
        if time.monotonic() - start > asked.seconds:
            raise SystemExit(f"{camera.name} and those after it are to be photographed yet: run this again")
        scene.camera, scene.cycles.seed = camera, index + 1
        scene.render.filepath = str(file)
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
