"""Materials of the kitchen: wood, tiles, stone, paint, cloth and fruit, each with a roughness of its own.

Roughness does not follow colour: it comes from glaze, varnish and wear, which lie over the pattern. Random numbers are
those of :mod:`benchmarks.rooms.patterns`, so that every machine gets the same bytes.
"""

import numpy as np

from benchmarks.rooms.patterns import Colour, Mask, blended, grid, material, uniform
from neurad.core.reflection import ConductorModel
from neurad.core.scene_records import Constant, Material


def waves(seed: int, u: Mask, v: Mask, across: int, along: int) -> Mask:
    """Periodic noise of zero mean and unit variance with up to so many periods across u and along v."""
    pairs = [(i, j) for i in range(across + 1) for j in range(-along, along + 1) if (i, j) > (0, 0)]
    pairs = [(i, j) for i, j in pairs if (i / max(across, 1)) ** 2 + (j / max(along, 1)) ** 2 <= 1.0]
    phase = 2 * np.pi * uniform(seed, len(pairs))
    total = np.zeros(np.broadcast_shapes(u.shape, v.shape))
    for (i, j), shift in zip(pairs, phase, strict=True):
        total += np.cos(2 * np.pi * (i * u + j * v) + shift)
    return np.asarray(total * np.sqrt(2.0 / len(pairs)))


def patches(seed: int, u: Mask, v: Mask, share: float = 0.3) -> Mask:
    """Large soft patches in [0, 1] that cover about ``share`` of the map: where something is worn."""
    field = waves(seed, u, v, 2, 2)
    return np.asarray(0.5 + 0.5 * np.tanh(1.6 * (field - np.quantile(field, 1.0 - share))))


def metal(name: str, reflectance: Colour) -> Material:
    """A smooth metal, which is known and not recovered."""
    return Material(
        name, ConductorModel(), Constant(np.array(reflectance, np.float32)), Constant(np.zeros(1, np.float32))
    )


def paint(name: str, colour: Colour, smooth: float, worn: float, seed: int) -> Material:
    """A coat of paint or glaze: one colour, smooth in places and rubbed dull in others."""
    u, v = grid(64, 64)
    return material(name, colour, smooth + (worn - smooth) * patches(seed, u, v))


def boards(
    name: str,
    dark: Colour,
    light: Colour,
    smooth: float,
    worn: float,
    seed: int,
    count: int,
    length: int,
    size: tuple[int, int],
    gap: float,
    share: float = 0.3,
) -> Material:
    """Boards along v, ``count`` across u and ``length`` in each row, with grain, joints and tones of their own.

    Args:
        name: of the material.
        dark: linear colour of the grain.
        light: linear colour between.
        smooth: roughness of the varnish.
        worn: roughness where it is worn.
        seed: of grain, tones and wear.
        count: rows of boards; 1 is one board without joints.
        length: boards in a row.
        size: texels along v and u.
        gap: width of a joint over that of a board; 0 for none.
        share: of the surface that is worn.
    """
    u, v = grid(*size)
    row = np.minimum((u * count).astype(int), count - 1)
    start = uniform(seed, count)[row] if count > 1 else np.zeros_like(u)
    place = (v + start) * length % length
    board = row * length + np.minimum(place.astype(int), length - 1)
    tone = uniform(seed + 1, count * length)[board]
    shift = uniform(seed + 2, count * length)[board]
    bend = 0.16 * waves(seed + 3, u, v, 2, 1)
    figure = np.sin(2 * np.pi * (3.0 * count * u + 7.0 * shift + 1.5 * bend + 0.4 * np.sin(2 * np.pi * (v + shift))))
    fine = waves(seed + 4, u, v, 10 + 3 * count, 2)
    blend = np.clip(0.5 + 0.55 * (tone - 0.5) + 0.14 * figure + 0.07 * fine, 0.0, 1.0)
    albedo = blended(dark, light, blend)
    if gap > 0.0:
        side = np.abs(u * count - np.round(u * count))
        end = np.abs(place - np.round(place)) * (count / length)
        joint = np.clip(1.5 - np.minimum(side, end) / (0.5 * gap), 0.0, 1.0) if count > 1 else np.zeros_like(tone)
        albedo = albedo * (1.0 - 0.55 * joint[..., None])
    return material(name, albedo, smooth + (worn - smooth) * patches(seed + 5, u, v, share))


def tiling(name: str, glaze: Colour, grout: Colour, smooth: float, dull: float, seed: int) -> Material:
    """Glazed tiles with grout between them. Some tiles shine, others are dull, whatever their colour; ``seed`` is that
    of the tiles' tones and of which of them are dull.
    """
    u, v = grid(256, 256)
    rows, columns = 8, 4
    row = np.minimum((v * rows).astype(int), rows - 1)
    along = (u * columns + 0.5 * (row % 2)) % columns  # every other row is moved by half a tile
    column = np.minimum(along.astype(int), columns - 1)
    tile = row * columns + column
    tone = 1.0 + 0.10 * (uniform(seed, rows * columns)[tile] - 0.5)
    to_side = 0.5 - np.abs(along - column - 0.5)
    to_row = 0.5 - np.abs(v * rows - row - 0.5)
    inside = np.minimum(np.clip(to_side / 0.04 - 0.5, 0, 1), np.clip(to_row / 0.08 - 0.5, 0, 1))
    albedo = np.array(grout) + (np.array(glaze) * tone[..., None] - np.array(grout)) * inside[..., None]
    dullness = np.clip(
        0.25 + 0.22 * waves(seed + 1, u, v, 2, 2) + 0.5 * (uniform(seed + 2, rows * columns)[tile] > 0.7), 0, 1
    )
    return material(name, albedo, smooth + (dull - smooth) * dullness)


def stone(name: str, base: Colour, fleck: Colour, smooth: float, worn: float, seed: int) -> Material:
    """Polished stone with soft clouds and flecks, dull where things were cut on it."""
    u, v = grid(128, 128)
    cloud = 0.5 + 0.22 * waves(seed, u, v, 5, 5) + 0.16 * waves(seed + 1, u, v, 14, 14)
    albedo = blended(base, fleck, np.clip(cloud, 0.0, 1.0))
    return material(name, albedo, smooth + (worn - smooth) * patches(seed + 2, u, v, 0.3))


def cloth(name: str, ground: Colour, stripe: Colour, seed: int, count: int, checked: bool = True) -> Material:
    """Woven cloth with stripes, crossed where ``checked``; a little smoother where it was ironed."""
    u, v = grid(128, 128)
    warp = 1.0 / (1.0 + np.exp(-40.0 * (np.abs(u * count % 1.0 - 0.5) - 0.33))) * np.ones_like(v)
    weft = 1.0 / (1.0 + np.exp(-40.0 * (np.abs(v * count % 1.0 - 0.5) - 0.33))) * np.ones_like(u)
    blend = 0.5 * (warp + weft) if checked else warp
    albedo = blended(ground, stripe, blend)
    return material(name, albedo, 0.46 + 0.03 * np.tanh(waves(seed, u, v, 2, 2)))


def skin(name: str, one: Colour, other: Colour, smooth: float, dull: float, seed: int) -> Material:
    """Skin of fruit: two colours that run into each other, waxed in places."""
    u, v = grid(64, 64)
    blend = 0.5 + 0.5 * np.tanh(0.9 * waves(seed, u, v, 2, 2))
    albedo = blended(one, other, blend)
    return material(name, albedo, smooth + (dull - smooth) * patches(seed + 1, u, v))
