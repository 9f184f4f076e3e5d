"""Procedural material maps: smooth periodic masks on the unit square, and finishes made of them.

Random numbers are the raw words of PCG64, whose stream is fixed for good, and maps are rounded to 1/1024, so that every
machine gets the same bytes.
"""

import numpy as np
import numpy.typing as npt

from neurad.core.records import FloatArray
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Bitmap, Constant, Material, Texture

SIZE = 128
"""Texels along each side of a map."""
LEVELS = 1024

Mask = npt.NDArray[np.float64]
Colour = tuple[float, float, float]


def uniform(seed: int, count: int) -> Mask:
    """Uniform numbers in [0, 1): [count]."""
    return np.asarray(np.random.PCG64(seed).random_raw(count) / 2.0**64)


def grid(rows: int = SIZE, columns: int = SIZE) -> tuple[Mask, Mask]:
    """Texel centres u [1, columns] and v [rows, 1] in [0, 1)."""
    return ((np.arange(columns) + 0.5) / columns)[None, :], ((np.arange(rows) + 0.5) / rows)[:, None]


def blended(one: Colour, other: Colour, weight: Mask) -> Mask:
    """From one colour, where the weight [h, w] is 0, to another, where it is 1: [h, w, 3]."""
    return np.asarray(np.array(one) + (np.array(other) - np.array(one)) * weight[..., None])


def material(name: str, albedo: Mask | Colour, roughness: Mask | float) -> Material:
    """A principled material from maps [h, w, 3] and [h, w], or from constants."""
    return Material(name, PrincipledModel(), _texture(np.asarray(albedo), 3), _texture(np.asarray(roughness), 1))


def _texture(values: Mask, channels: int) -> Texture:
    rounded: FloatArray = (np.round(values * LEVELS) / LEVELS).astype(np.float32)
    if rounded.ndim < 2:
        return Constant(rounded.reshape(channels))
    return Bitmap(rounded.reshape(*rounded.shape[:2], channels))


def _soft(x: Mask, sharpness: float) -> Mask:
    """Maps [-1, 1] to [0, 1] with soft steps: a square wave out of a sine."""
    return np.asarray(0.5 + 0.5 * np.tanh(sharpness * x) / np.tanh(sharpness))


def noise(seed: int, frequency: int) -> Mask:
    """Periodic smooth noise in about [0, 1], with up to ``frequency`` periods along each side: [s, s]."""
    x, y = grid()
    phase = 2 * np.pi * uniform(seed, 2 * (2 * frequency + 1) ** 2)
    total = np.zeros((SIZE, SIZE))
    k = 0
    for i in range(frequency + 1):
        for j in range(-frequency, frequency + 1):
            if 0 < i * i + j * j <= frequency * frequency:
                a, b = 2 * np.pi * i * x + phase[k], 2 * np.pi * j * y
                total += np.cos(a) * np.cos(b) - np.sin(a) * np.sin(b)
                k += 1
    return _soft(np.clip(total / np.sqrt(k), -1.6, 1.6) / 1.6, 1.2)


def wood(seed: int, grains: int) -> Mask:
    """Wavy grain along the second axis: [s, s]."""
    x, _ = grid()
    bend = noise(seed, 2) - 0.5
    return _soft(np.sin(2 * np.pi * (grains * x + 0.55 * bend)), 1.4) * 0.75 + 0.25 * noise(seed + 1, 4)


def planks(seed: int, count: int) -> Mask:
    """Boards along the second axis, each of its own tone, with a faint grain: [s, s]."""
    x, y = grid()
    tone = uniform(seed, count * 2).reshape(2, count)
    near = 0.5 + 0.5 * np.tanh(4 * np.sin(2 * np.pi * (y + 0.37)))
    mask = np.zeros((SIZE, SIZE))
    for i in range(count):
        window = np.clip(count * (0.5 / count - np.abs((x - (i + 0.5) / count + 0.5) % 1.0 - 0.5)) * 5 + 0.5, 0, 1)
        mask += window * (tone[0, i] * near + tone[1, i] * (1 - near))
    return 0.75 * mask + 0.25 * noise(seed + 1, 4)


def tiles(seed: int, count: int = 4) -> Mask:
    """Square tiles of varying tone; the joints, an eighth of a tile, are dark: [s, s]."""
    x, y = grid()
    tone = 0.55 + 0.45 * uniform(seed, count * count).reshape(count, count)
    row, column = np.minimum(y * count, count - 1e-9).astype(int), np.minimum(x * count, count - 1e-9).astype(int)
    edge = np.minimum(0.5 - np.abs(x * count % 1.0 - 0.5), 0.5 - np.abs(y * count % 1.0 - 0.5))
    inside = np.clip(edge / 0.12, 0.0, 1.0)
    return np.asarray(tone[row, column] * inside * inside * (3 - 2 * inside))


def checker(count: int, sharpness: float = 2.5) -> Mask:
    """A soft checkerboard of ``count`` periods: [s, s]."""
    x, y = grid()
    return _soft(np.sin(2 * np.pi * count * x) * np.sin(2 * np.pi * count * y), sharpness)


def stripes(count: int, along: int) -> Mask:
    """Soft stripes across axis ``along`` (0: they vary with u, 1: with v): [s, s]."""
    axis = grid()[along]
    return np.broadcast_to(_soft(np.sin(2 * np.pi * count * axis), 2.0), (SIZE, SIZE)).copy()


def woven(count: int) -> Mask:
    """Crossed bands, as of checked cloth: [s, s]."""
    return 0.5 * stripes(count, 0) + 0.5 * stripes(count, 1)


def marble(seed: int, veins: int) -> Mask:
    """Bent diagonal veins: [s, s]."""
    x, y = grid()
    return _soft(np.sin(2 * np.pi * (veins * x + y + 0.9 * noise(seed, 3))), 1.5)


def wallpaper(count: int) -> Mask:
    """Diamonds with a dot in every other one: [s, s]."""
    x, y = grid()
    diamonds = np.cos(2 * np.pi * count * (x + y)) * np.cos(2 * np.pi * count * (x - y))
    dots = np.cos(2 * np.pi * count * x) * np.cos(2 * np.pi * count * y)
    return _soft(0.75 * diamonds + 0.25 * dots, 2.0)


def spots(seed: int, count: int, radius: float) -> Mask:
    """One soft spot in every cell of a ``count`` x ``count`` grid, moved at random (terrazzo, dotted china): [s, s]."""
    x, y = grid()
    draw = uniform(seed, 3 * count * count).reshape(count, count, 3)
    mask = np.zeros((SIZE, SIZE))
    for i in range(count):
        for j in range(count):
            cx, cy = (j + 0.3 + 0.4 * draw[i, j, 0]) / count, (i + 0.3 + 0.4 * draw[i, j, 1]) / count
            dx, dy = (x - cx + 0.5) % 1.0 - 0.5, (y - cy + 0.5) % 1.0 - 0.5
            size = radius * (0.7 + 0.6 * draw[i, j, 2]) / count
            mask = np.maximum(mask, np.exp(-(((dx * dx + dy * dy) / (size * size)) ** 2)))
    return mask


def gradient(along: int = 1) -> Mask:
    """One smooth swell along an axis: [s, s]."""
    axis = grid()[along]
    return np.broadcast_to(0.5 - 0.5 * np.cos(2 * np.pi * axis), (SIZE, SIZE)).copy()


def finish(name: str, mask: Mask, dark: Colour, light: Colour, roughness: tuple[float, float], seed: int) -> Material:
    """A principled material: ``mask`` blends two colours, a drifting hue goes over it, and the roughness follows the
    mask only in part, so that neither map can be read off the other.

    Args:
        name: name of the material.
        mask: values in [0, 1] [s, s].
        dark: linear base colour where the mask is 0.
        light: linear base colour where the mask is 1.
        roughness: smallest and largest roughness.
        seed: of the hue and of the roughness.
    """
    albedo = blended(dark, light, mask)
    hue = noise(1000 + seed, 2) - 0.5
    albedo = albedo * (1.0 + hue[..., None] * np.array([0.16, 0.0, -0.16]))
    own = noise(2000 + seed, 3)
    blend = 0.35 * (mask if seed % 2 else 1.0 - mask) + (1.0 - 0.35) * own
    rough = roughness[0] + (roughness[1] - roughness[0]) * blend
    return material(name, np.clip(albedo, 0.03, 0.85), np.clip(rough, 0.2, 0.9))
