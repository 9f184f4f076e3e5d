"""Lat-long maps of all directions: +Y up, rows from pole to pole, columns that wrap around; bilinear between texels."""

import math
from pathlib import Path

import numpy as np

from neurad.core.records import Float64Array, FloatArray
from neurad.images.image_io import read_exr
from neurad.runtime.numbers import RADIANCE, within
from neurad.runtime.reading import shown


def read_map(path: str | Path) -> FloatArray:
    """Radiance of a map in an EXR file [h, w, 3]; one of a single channel is grey.

    Raises:
        InputError: it cannot be read, or a value is none to compute with.
    """
    pixels = read_exr(path)[..., :3]
    within(pixels, f"{shown(path)}: radiance", 0.0, RADIANCE)
    return np.broadcast_to(pixels, (*pixels.shape[:2], 3)).copy()


def texel_directions(height: int, width: int) -> Float64Array:
    """Unit directions of the texels [h, w, 3]; the first row is the pole, the first column half a texel in."""
    theta = math.pi * np.arange(height)[:, None] / (height - 1)
    phi = 2.0 * math.pi * (np.arange(width) + 0.5) / width
    xyz = (np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi))
    return np.stack(np.broadcast_arrays(*xyz), -1)


def add_points(pixels: Float64Array, points: Float64Array, power: Float64Array) -> None:
    """Share light from points at infinity among texels so that the map sends as much light from there.

    Args:
        pixels: radiance of the map [h, w, 3]; changed.
        points: unit directions [n, 3].
        power: radiance times solid angle of each [n, 3].
    """
    height, width = pixels.shape[:2]
    x, y, z = points.T
    step = math.pi / (height - 1)
    row, column = np.arccos(y.clip(-1.0, 1.0)) / step, np.arctan2(x, -z) / (2.0 * math.pi) * width - 0.5
    top, left = np.minimum(np.floor(row).astype(int), height - 2), np.floor(column).astype(int)
    # The solid angle of a texel by its weight: a tent across both ways.
    tent = np.sin(step * np.arange(height)) * 2.0 * (1.0 - math.cos(step)) / step
    tent[[0, -1]] = 1.0 - math.sin(step) / step
    solid_angle = 2.0 * math.pi / width * tent
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - (row - top)) * np.abs(1 - j - (column - left))
            at = top + i, (left + j) % width
            np.add.at(pixels, at, weight[:, None] * power / solid_angle[at[0]][:, None])
