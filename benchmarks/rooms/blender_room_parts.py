"""For Blender's Python: boxes, turned parts and sheets, materials of one roughness each, and their pictures."""

from collections.abc import Callable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

SIDE = 512
"""Pixels along a side of a picture."""
COLUMNS = 16
"""Spines side by side in the picture of the books."""
ROUGHNESS = {
    "wall paint": 0.80, "ceiling paint": 0.90, "wallpaper": 0.70, "floor": 0.48, "rug": 0.95, "sofa cloth": 0.90,
    "cushion print": 0.82, "cushion plain": 0.86, "curtain": 0.88, "oak": 0.40, "walnut": 0.44, "pine": 0.60,
    "cupboard paint": 0.52, "white lacquer": 0.55, "tiles": 0.18, "porcelain": 0.15, "glaze": 0.22, "soil": 0.95,
    "terracotta": 0.80, "leaves": 0.56, "books": 0.65, "black plastic": 0.28, "frame": 0.42, "shade": 0.92,
    "hills": 0.55, "painting": 0.62, "checks": 0.78, "brass": 0.28, "steel": 0.20, "mirror": 0.0, "glass": 0.0,
}  # fmt: skip
"""One for each material."""
PLAIN = {
    "wall paint": (0.72, 0.70, 0.63), "ceiling paint": (0.80, 0.80, 0.79), "cupboard paint": (0.14, 0.30, 0.29),
    "white lacquer": (0.76, 0.76, 0.74), "sofa cloth": (0.16, 0.22, 0.32), "cushion plain": (0.62, 0.42, 0.08),
    "shade": (0.70, 0.62, 0.46), "porcelain": (0.80, 0.79, 0.76), "glaze": (0.08, 0.18, 0.42),
    "terracotta": (0.48, 0.20, 0.11), "soil": (0.06, 0.04, 0.03), "leaves": (0.10, 0.28, 0.06),
    "black plastic": (0.03, 0.03, 0.03), "frame": (0.05, 0.04, 0.04), "glass": (1.0, 1.0, 1.0),
    "brass": (0.80, 0.62, 0.32), "steel": (0.62, 0.62, 0.64), "mirror": (0.92, 0.92, 0.92),
}  # fmt: skip
METALS = ("brass", "steel", "mirror")


def paint(name: str, colour: Any, roughness: float, metallic: float = 0.0) -> Any:
    """A Principled BSDF of a linear colour, three numbers or a picture [SIDE, SIDE, 3], and one roughness."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.distribution = "GGX"
    for key, value in (("Roughness", roughness), ("Metallic", metallic), ("IOR", 1.5)):
        shader.inputs[key].default_value = value
    if np.ndim(colour) == 1:
        shader.inputs["Base Color"].default_value = (*colour, 1.0)
        return made
    linear = np.clip(colour, 0.02, 0.9)
    coded = 1.055 * linear ** (1 / 2.4) - 0.055  # sRGB above 0.0031
    image = bpy.data.images.new(name, SIDE, SIDE)
    image.pixels = np.concatenate((coded, np.ones_like(coded[..., :1])), -1).ravel().tolist()
    image.pack()
    texture = made.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    made.node_tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    return made


def solid(name: str, corners: Any, faces: Any, material: Any, tile: float = 1.0, uvs: Any = None) -> Any:
    """An object of polygons.

    Args:
        name: of the object.
        corners: [n, 3], metres.
        faces: indices of each one's corners.
        material: of all of it.
        tile: metres after which its picture repeats, laid on along the axis that a face looks to most.
        uvs: in place of that, a pair for each corner.
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, corner)) for corner in corners], [], faces)
    mesh.update()
    mesh.materials.append(material)
    layer = mesh.uv_layers.new(name="UVMap")
    for polygon in mesh.polygons:
        axes = ((1, 2), (0, 2), (0, 1))[int(np.argmax(np.abs(polygon.normal)))]
        for loop in polygon.loop_indices:
            corner = mesh.loops[loop].vertex_index
            place = [mesh.vertices[corner].co[axis] / tile for axis in axes]
            layer.uv[loop].vector = place if uvs is None else uvs[corner]
    made = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(made)
    return made


def box(name: str, low: Any, high: Any, material: Any, bevel: float = 0.0, tile: float = 1.0, uvs: Any = None) -> Any:
    """A box between two corners, its edges rounded by ``bevel`` metres; ``uvs`` as of :func:`solid`."""
    corners = [(x, y, z) for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    made = solid(name, corners, faces, material, tile, uvs)
    if bevel > 0.0:
        made.data.shade_smooth()
        rounded = made.modifiers.new("bevel", "BEVEL")
        rounded.width, rounded.segments, rounded.harden_normals = bevel, 3, True
    return made


def turn(made: Any, centre: Any, angle: float, axis: str = "Z") -> None:
    """Turn an object's mesh about an axis through a centre."""
    there = Matrix.Translation(Vector(centre))
    made.data.transform(there @ Matrix.Rotation(angle, 4, axis) @ there.inverted())


def surface(
    name: str,
    place: Callable[[Any, Any], Any],
    shape: tuple[int, int],
    material: Any,
    thick: float,
    repeat: float = 1.0,
) -> Any:
    """A smooth sheet.

    Args:
        name: of the object.
        place: from two parameters in [0, 1] [n] to points [n, 3].
        shape: quads along both parameters.
        material: of it.
        thick: metres; 0 leaves a sheet.
        repeat: how often its picture goes across.
    """
    u, v = (x.ravel() for x in np.meshgrid(*(np.linspace(0, 1, n + 1) for n in shape), indexing="ij"))
    k = np.arange(len(u)).reshape(shape[0] + 1, shape[1] + 1)
    faces = np.stack((k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]), -1).reshape(-1, 4).tolist()
    made = solid(name, np.asarray(place(u, v)), faces, material, uvs=np.stack((u, v), 1) * repeat)
    made.data.shade_smooth()
    if thick > 0.0:
        made.modifiers.new("thick", "SOLIDIFY").thickness = thick
    return made


def lathe(name: str, profile: Sequence[tuple[float, float]], centre: Any, material: Any, thick: float = 0.0) -> Any:
    """A profile of radii and heights, turned about the vertical axis through ``centre``; a ``thick`` sheet is open."""
    ends = [] if thick > 0.0 else [0.0001]
    along = np.array([*((r, profile[0][1]) for r in ends), *profile, *((r, profile[-1][1]) for r in ends)])

    def place(u: Any, v: Any) -> Any:
        r, z = along[np.rint(v * (len(along) - 1)).astype(int)].T
        return np.stack((r * np.cos(2 * np.pi * u), r * np.sin(2 * np.pi * u), z), 1) + np.asarray(centre)

    made = surface(name, place, (32, len(along) - 1), material, thick, 2.0)
    weld = made.modifiers.new("weld", "WELD")
    weld.merge_threshold = 1e-5
    made.data.set_sharp_from_angle(angle=0.7)
    return made


def cushion(name: str, centre: Any, size: Any, material: Any) -> Any:
    """A filled cushion that lies: two sheets that meet at a seam."""

    def place(u: Any, v: Any) -> Any:
        x, y = 2.0 * u - 1.0, np.where(v < 0.5, 4.0 * v - 1.0, 3.0 - 4.0 * v)  # first the upper side, then the lower
        height = np.sqrt((1 - np.abs(x) ** 3) * (1 - np.abs(y) ** 3)) * np.where(v < 0.5, 1.0, -1.0)
        pinch = 1.0 - 0.06 * (1 - np.abs(height))
        return np.stack((x * pinch, y * pinch, height), 1) * (0.5 * np.asarray(size)) + np.asarray(centre)

    return surface(name, place, (20, 40), material, 0.0, 2.0)


# ---- pictures, linear [SIDE, SIDE, 3]


def clouds(rng: Any, across: float, along: float) -> Any:
    """Periodic smooth noise of unit variance, with features of so many pixels across rows and along them."""
    f = np.fft.fftfreq(SIDE)
    keep = np.exp(-2.0 * (np.pi * f[:, None] * across) ** 2 - 2.0 * (np.pi * f * along) ** 2)
    made = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * keep).real
    return made / made.std()


def mixed(weight: Any, one: Any, other: Any) -> Any:
    """From one colour to another."""
    return np.asarray(one) + np.clip(weight, 0.0, 1.0)[..., None] * (np.asarray(other) - np.asarray(one))


def wood(rng: Any, light: Any, dark: Any, planks: int = 1) -> Any:
    """Lines of grain along rows, and the joints of planks."""
    rows, columns = np.mgrid[0:SIDE, 0:SIDE]
    board = rows * planks // SIDE
    shifted = (columns + rng.integers(0, SIDE, planks)[board]) % SIDE
    bent, fine = clouds(rng, 30.0, 150.0)[rows, shifted], clouds(rng, 0.8, 40.0)
    rings = np.sin(2.0 * np.pi * (rows / 22.0 + 1.3 * bent)) ** 4
    grain = mixed(0.25 + 0.5 * rings + 0.16 * fine + rng.uniform(-0.12, 0.12, planks)[board], light, dark)
    if planks > 1:
        grain[(rows % (SIDE // planks) < 3) | (shifted < 3)] *= 0.35
    return grain


def printed(kind: str, one: Any, other: Any, count: int) -> Any:
    """A print that repeats ``count`` times."""
    v, u = np.mgrid[0:SIDE, 0:SIDE] * (count / SIDE) % 1.0 - 0.5
    weight = {
        "stripes": (np.abs(u) < 0.22) | ((np.abs(u) < 0.45) & (np.abs(u) > 0.38)),
        "dots": np.hypot(u, v) < 0.3,
        "leaves": (np.abs(np.hypot(u - 0.25, v) - 0.42) < 0.05) | (np.hypot(u + 0.1, 2.0 * v) < 0.17),
        "tiles": (np.abs(u) > 0.47) | (np.abs(v) > 0.47),
        "checks": (u > 0) * 0.5 + (v > 0) * 0.5,
    }  # fmt: skip
    return mixed(weight[kind].astype(float), one, other)


def blocks(rng: Any, colours: Any, count: int) -> Any:
    """Overlapping rectangles of colours on the first one."""
    made = np.broadcast_to(np.asarray(colours[0]), (SIDE, SIDE, 3)).copy()
    for k in range(count):
        (a, b), (c, d) = np.sort(rng.integers(20, SIDE - 20, (2, 2)), 1)
        made[a:b, c:d] = 0.25 * made[a:b, c:d] + 0.75 * np.asarray(colours[1 + k % (len(colours) - 1)])
    return made


def spines(rng: Any, columns: int) -> Any:
    """Spines of books side by side, the first column paper."""
    made, wide = np.empty((SIDE, SIDE, 3)), SIDE // columns
    made[:, :wide] = np.array([0.75, 0.7, 0.58]) * np.where(np.arange(SIDE) % 4 == 0, 0.85, 1.0)[:, None, None]
    for low in range(wide, SIDE, wide):
        spine = made[:, low : low + wide]
        cloth = rng.uniform(0.05, 0.6, 3) * rng.uniform(0.4, 1.0)
        gilt = np.array([0.75, 0.62, 0.3]) if rng.uniform() < 0.5 else 0.9 - 0.7 * cloth
        spine[:] = cloth
        for band in (40, 60, 430):
            spine[band : band + 8] = gilt
        letters = np.repeat(rng.uniform(size=24) < 0.75, 10)
        spine[150:390, 10:18][letters] = gilt
    return made


def materials(rng: Any) -> dict[str, Any]:
    """All that does not shine."""
    hills = np.linspace(-4, 5, 512)[:, None] + 0.6 * clouds(rng, 60, 60)
    colours = [(0.82, 0.8, 0.72), (0.7, 0.12, 0.08), (0.1, 0.22, 0.5), (0.85, 0.65, 0.12), (0.05, 0.05, 0.06)]
    colour = {
        **PLAIN,
        "hills": mixed(hills, (0.12, 0.2, 0.08), (0.4, 0.6, 0.8)),
        "painting": blocks(rng, colours, 14),
        "rug": blocks(rng, [(0.45, 0.12, 0.10), (0.62, 0.52, 0.38), (0.12, 0.14, 0.24)], 9),
        "wallpaper": printed("leaves", (0.50, 0.56, 0.50), (0.20, 0.34, 0.28), 4),
        "cushion print": printed("dots", (0.75, 0.72, 0.62), (0.65, 0.22, 0.1), 6),
        "curtain": printed("stripes", (0.66, 0.60, 0.48), (0.30, 0.16, 0.20), 5),
        "checks": printed("checks", (0.75, 0.72, 0.65), (0.35, 0.06, 0.06), 8),
        "tiles": printed("tiles", (0.30, 0.45, 0.55), (0.70, 0.68, 0.62), 4),
        "floor": wood(rng, (0.48, 0.30, 0.16), (0.24, 0.13, 0.06), 8),
        "oak": wood(rng, (0.52, 0.36, 0.20), (0.30, 0.18, 0.09)),
        "walnut": wood(rng, (0.22, 0.12, 0.07), (0.09, 0.045, 0.025)),
        "pine": wood(rng, (0.66, 0.48, 0.28), (0.46, 0.28, 0.13)),
        "books": spines(rng, COLUMNS),
    }
    made = {name: paint(name, colour[name], rough, float(name in METALS)) for name, rough in ROUGHNESS.items()}
    made["glass"].node_tree.nodes["Principled BSDF"].inputs["Transmission Weight"].default_value = 1.0
    return made
