"""Seams: whether both sides of every chart border show what the field says there."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from neurad.core.protocols import Materials
from neurad.core.records import Array, FloatArray, IntArray
from neurad.core.rng import Stream
from neurad.export.bake import BakedRoom
from neurad.export.charts import Chart, find_borders, four_texels, texels_read
from neurad.export.texel_means import TexelMeans, uncertain
from neurad.scene.geometry import Geometry

PER_SIDE = 7, 27, 81
"""Positions along the side of a texel over which the field's mean is taken: the next number where that is not known to
a quarter of :data:`BOUND` then. They are odd, and so never those that were baked."""
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
    """Difference between what a bilinear lookup shows of surface parameters and the mean of the fields, in [0, 1]."""
    mean: float
    beyond: float
    """Fraction of the points that differ by more than :data:`BOUND`."""
    where: str
    """The mesh with the largest difference."""

    def as_json(self) -> dict[str, Any]:
        """What ``verify.json`` holds."""
        return {
            "sides": self.sides,
            "points": self.points,
            "largest_of_255": round(255 * self.largest, 3),
            "mean_of_255": round(255 * self.mean, 4),
            "beyond_2_of_255": self.beyond,
            "worst": self.where,
        }


@torch.no_grad()
def find_seams(
    room: BakedRoom,
    geometry: Geometry,
    materials: Materials,
    points: int = POINTS,
    done: Callable[[int], None] = lambda meshes: None,
) -> Seams:
    """Compare bilinear lookups on both sides of every border between charts with the fields.

    A lookup reads four texels. What it ought to show is the mean of the fields over these four, by its weights: over
    what lies under them, and around the chart over the plane of its nearest triangle. A texel of another chart differs.
    """
    borders = [np.zeros(0, np.int64) if chart is None else find_borders(chart.mesh) for chart in room.charts]
    sides = sum(len(border) for border in borders)
    first = np.cumsum([0, *(len(mesh.faces) for mesh in room.scene.meshes)])
    stream = Stream(SEED, 0)
    largest, total, beyond, count, where = 0.0, 0.0, 0, 0, ""
    for index, (chart, baked, border) in enumerate(zip(room.charts, room.baked, borders, strict=True)):
        if chart is not None and baked is not None and len(border):
            share = max(round(points * len(border) / sides), min(len(border), 64))
            chosen = stream.integers(len(border), share).numpy() if share < len(border) else np.arange(len(border))
            x, y = along(chart, border[chosen], stream.uniform(len(chosen)).numpy().astype(np.float64))
            shown = bilinear(baked.pixels, x, y)
            mesh = TexelMeans(chart, int(first[index]), geometry, materials, baked.parameters)
            off = np.abs(shown - _meant(mesh, x, y)).max(1)
            if off.max() > largest:
                largest, where = float(off.max()), room.names[index]
            total, beyond, count = total + float(off.sum()), beyond + int((off > BOUND).sum()), count + len(off)
        done(1)
    count = max(count, 1)
    return Seams(sides, count, largest, total / count, beyond / count, where)


def along(chart: Chart, side: IntArray, part: Array) -> tuple[Array, Array]:
    """Positions (x, y) [k] in texels, this part of the way along sides of triangles."""
    corners, face, edge = chart.corners, side // 3, side % 3
    a, b = corners[face, edge], corners[face, (edge + 1) % 3]
    at = a + (b - a) * part[:, None]
    return at[:, 0], at[:, 1]


def bilinear(pixels: FloatArray, x: Array, y: Array) -> FloatArray:
    """Lookups [n, c] at positions in texels."""
    height, width = pixels.shape[:2]
    shown = np.zeros((len(x), pixels.shape[2]), np.float32)
    for column, row, weight in four_texels(x, y):
        texel = pixels[row.astype(np.int64) % height, column.astype(np.int64) % width].astype(np.float32)
        shown += weight[:, None] * texel
    return shown


def _meant(mesh: TexelMeans, x: Array, y: Array) -> FloatArray:
    """What lookups at (x, y) [n] ought to show [n, channels]: means of the fields over texels they read, by weight."""
    wanted = texels_read(mesh.chart, x, y)
    meant = mesh.means(PER_SIDE[0], wanted)
    error = uncertain(meant.values, meant.covered, meant.spread, PER_SIDE[0])
    for per in PER_SIDE[1:]:
        wanted = wanted & (error > 0.25 * BOUND)
        if not wanted.any():
            break
        finer = mesh.means(per, wanted)
        meant.values[wanted] = finer.values[wanted]
        error = uncertain(meant.values, meant.covered, finer.spread, per)
    return bilinear(meant.values, x, y)
