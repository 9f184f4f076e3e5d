"""Seams: whether both sides of every chart border show what the field says there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from neurad.core.protocols import Materials
from neurad.core.records import FloatArray
from neurad.core.rng import Stream
from neurad.export.bake import asked
from neurad.export.charts import Chart, find_borders
from neurad.export.raster_kernels import Array, IntArray
from neurad.export.room import Room
from neurad.scene.geometry import Geometry

PER_SIDE = 4
"""Positions along the side of a texel over which the field's mean is taken; not those that were baked."""
POINTS = 1 << 16
"""Points on the sides of borders that are looked at in a room; all of them if there are fewer."""
SEED = 20260102
BOUND = 2.0 / 255.0
"""Largest difference of a value in [0, 1] that is no seam: two steps of an 8-bit picture."""


@dataclass(frozen=True)
class Seams:
    """What was found along the borders of charts."""

    sides: int
    """Sides of triangles on borders in the whole room."""
    points: int
    """Points on them that were looked at."""
    largest: float
    """Difference between what a bilinear lookup shows of albedo and roughness and the mean of the fields, in [0, 1]."""
    mean: float
    beyond: float
    """Fraction of the points that differ by more than :data:`BOUND`."""
    where: str
    """The mesh with the largest difference."""

    def as_json(self) -> dict[str, Any]:
        """What ``verify.json`` holds."""
        steps = {"largest_of_255": round(255 * self.largest, 3), "mean_of_255": round(255 * self.mean, 4)}
        return {
            "sides": self.sides,
            "points": self.points,
            **steps,
            "beyond_2_of_255": self.beyond,
            "worst": self.where,
        }


@torch.no_grad()
def find_seams(
    room: Room,
    geometry: Geometry,
    materials: Materials,
    points: int = POINTS,
    done: Callable[[int], None] = lambda meshes: None,
) -> Seams:
    """Compare bilinear lookups on both sides of every border between charts with the fields.

    A lookup reads four texels. What it ought to show is the mean of the fields over these four, by its weights, in the
    plane of the triangle whose side it is on; a texel of another chart, or one in a wrong plane, differs.

    Args:
        room: the baked one.
        geometry: of the scene that was baked, with the same triangles.
        materials: the fields that were baked.
        points: looked at in the whole room.
        done: called with 1 after each mesh.
    """
    borders = [np.zeros(0, np.int64) if chart is None else find_borders(chart.mesh) for chart in room.charts]
    sides = sum(len(border) for border in borders)
    first = np.cumsum([0, *(len(mesh.faces) for mesh in room.scene.meshes)])
    stream = Stream(SEED, 0)
    largest, total, beyond, count, where = 0.0, 0.0, 0, 0, ""
    for index, (chart, baked, border) in enumerate(zip(room.charts, room.baked, borders, strict=True)):
        if chart is not None and baked is not None and len(border):
            share = max(round(points * len(border) / sides), min(len(border), 64))
            side = border[stream.integers(len(border), share).numpy()] if share < len(border) else border
            x, y = _along(chart, side, stream.uniform(len(side)).numpy().astype(np.float64))
            shown = _bilinear(baked.pixels, x, y)
            meant = _meant(chart, int(first[index]), geometry, materials, side // 3, x, y)
            off = np.abs(shown - meant).max(1)
            if off.max() > largest:
                largest, where = float(off.max()), room.names[index]
            total, beyond, count = total + float(off.sum()), beyond + int((off > BOUND).sum()), count + len(off)
        done(1)
    return Seams(sides, count, largest, total / max(count, 1), beyond / max(count, 1), where)


def _along(chart: Chart, side: IntArray, part: Array) -> tuple[Array, Array]:
    """Positions (x, y) [k] in texels, this part of the way along sides of triangles."""
    corners, face, edge = chart.corners, side // 3, side % 3
    a, b = corners[face, edge], corners[face, (edge + 1) % 3]
    at = a + (b - a) * part[:, None]
    return at[:, 0], at[:, 1]


def _bilinear(pixels: FloatArray, x: Array, y: Array) -> FloatArray:
    """Lookups [n, c] at positions in texels."""
    height, width = pixels.shape[:2]
    shown = np.zeros((len(x), pixels.shape[2]), np.float32)
    for column, row, weight in _four(x, y):
        texel = pixels[row.astype(np.int64) % height, column.astype(np.int64) % width].astype(np.float32)
        shown += weight[:, None] * texel
    return shown


def _meant(
    chart: Chart, first: int, geometry: Geometry, materials: Materials, face: IntArray, x: Array, y: Array
) -> FloatArray:
    """Means of the fields [n, 4] over the texels that lookups at (x, y) [n] on the triangles ``face`` [n] read."""
    meant = np.zeros((len(face), 4), np.float32)
    inside = (np.arange(PER_SIDE) + 0.5) / PER_SIDE
    dx, dy = (offset.reshape(-1, 1) for offset in np.meshgrid(inside, inside))
    for column, row, weight in _four(x, y):
        at_x, at_y = (column + dx).ravel(), (row + dy).ravel()
        values = asked(chart, first, geometry, materials, np.tile(face, len(dx)), at_x, at_y)
        meant += weight[:, None] * values.reshape(len(dx), len(face), 4).mean(0)
    return meant


def _four(x: Array, y: Array) -> list[tuple[Array, Array, Array]]:
    """Columns, rows and weights [n] of the four texels that bilinear lookups at (x, y) [n] read."""
    left, top = np.floor(x - 0.5), np.floor(y - 0.5)
    right, down = x - 0.5 - left, y - 0.5 - top
    return [
        (left + i, top + j, ((right if i else 1.0 - right) * (down if j else 1.0 - down)).astype(np.float32))
        for j in (0, 1)
        for i in (0, 1)
    ]
