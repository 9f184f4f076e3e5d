"""Textures from fields: albedo and roughness asked at the places on a mesh that its texels stand for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from neurad.core.protocols import Materials
from neurad.core.records import FloatArray
from neurad.export import raster_kernels as kernels
from neurad.export.charts import Chart, border_texels, triangle_areas
from neurad.export.fill import push_pull
from neurad.export.raster_kernels import Array, IntArray
from neurad.metrics.scores import BoolArray
from neurad.runtime.threads import split
from neurad.scene.geometry import Geometry

PER_TEXEL, MOST_PER_TEXEL = 2, 8
"""Positions along the side of a texel at which the field is asked: the first in large textures, up to the second in
small ones, where more cost nothing. A point in the middle alone aliases: patterns as fine as a texel come out as coarse
ones; with four a side nothing was gained over two in the pictures."""
PER_BORDER_TEXEL = 4
"""Positions along the side of a texel that lookups on borders of charts read: the other side averages other positions,
and an eye sees that they differ."""
SMALL = 1 << 20
"""Positions in a texture that cost next to nothing."""
GUTTER = 2.0
"""Texels around a chart that are still baked, in the plane of its nearest triangle; a bilinear lookup reads one."""
BAND = 1 << 22
"""Positions in flight, which bounds the memory."""
CHUNK = 1 << 18
"""Positions that go through the fields at once."""
STRETCH = 4.0
"""A texel of the gutter may lie so many times further from the mesh than texels are apart on it, not more."""


@dataclass(frozen=True)
class Baked:
    """The texture of one mesh, albedo and roughness side by side."""

    pixels: FloatArray
    """Linear albedo (three channels) and roughness [h, w, 4], float16; every texel is filled."""
    covered: BoolArray
    """Texels that lie on the mesh or in the gutter around its charts [h, w]."""


@torch.no_grad()
def bake(
    chart: Chart,
    first: int,
    geometry: Geometry,
    materials: Materials,
    done: Callable[[int], None] = lambda texels: None,
) -> Baked:
    """Ask the materials for every texel of a mesh: the mean over several positions in it, a box filter.

    Around a chart the positions lie in the plane of its nearest triangle beyond the edge. There the other side of a
    seam is close by, too, so both sides get about the same values and none can be seen.

    Args:
        chart: the mesh.
        first: number of its first triangle in ``geometry``.
        geometry: of the whole scene, with the same triangles.
        materials: what to ask, on the CPU or where ``geometry`` lies.
        done: called with numbers of texels as they get done.
    """
    per = positions(chart.width, chart.height)
    pixels, covered = texel_means(chart, first, geometry, materials, per, done=done)
    if per < PER_BORDER_TEXEL and (border := border_texels(chart)).any():
        again, found = texel_means(chart, first, geometry, materials, PER_BORDER_TEXEL, border)
        pixels[border & found] = again[border & found]
    return Baked(push_pull(pixels, covered).astype(np.float16), covered)


@torch.no_grad()
def texel_means(
    chart: Chart,
    first: int,
    geometry: Geometry,
    materials: Materials,
    per: int,
    wanted: BoolArray | None = None,
    done: Callable[[int], None] = lambda texels: None,
) -> tuple[FloatArray, BoolArray]:
    """Means of the materials over texels: of what lies under them, around a chart in the plane of its nearest triangle.

    Args:
        chart: the mesh.
        first: number of its first triangle in ``geometry``.
        geometry: of the whole scene, with the same triangles.
        materials: what to ask.
        per: positions along the side of a texel.
        wanted: texels [h, w] to do; None does all.
        done: called with numbers of texels as they get done.

    Returns:
        Albedo and roughness [h, w, 4], zero where there is nothing, and which texels have anything [h, w].
    """
    width, height = chart.width, chart.height
    pixels = np.zeros((height, width, 4), np.float32)
    covered = np.zeros((height, width), bool)
    for top, owner in _bands(chart, per, wanted):
        rows = owner.shape[0] // per
        lane = np.flatnonzero(owner.ravel() >= 0)
        down, right = np.divmod(lane, width * per)
        x, y = (right + 0.5) / per, (down + 0.5) / per + top
        values = asked(chart, first, geometry, materials, owner.ravel()[lane], x, y)
        texel = down // per * width + right // per
        count = np.bincount(texel, minlength=rows * width)
        summed = np.stack([np.bincount(texel, of, rows * width) for of in values.T], -1)
        pixels[top : top + rows] = (summed / np.maximum(count, 1)[:, None]).reshape(rows, width, 4)
        covered[top : top + rows] = (count > 0).reshape(rows, width)
        done(rows * width)
    return pixels, covered


def positions(width: int, height: int) -> int:
    """Positions along the side of a texel at which the field is asked for a texture of this size."""
    return min(max(math.isqrt(SMALL // (width * height)), PER_TEXEL), MOST_PER_TEXEL)


def _bands(chart: Chart, per: int, wanted: BoolArray | None = None) -> Iterator[tuple[int, IntArray]]:
    """Rows of texels with the triangles that own their samples: first row and owners [rows * per, width * per], -1 for
    none. Bands without a texel of ``wanted`` [h, w] are left out.
    """
    corners = chart.corners
    low, high = corners[:, :, 1].min(1) - GUTTER, corners[:, :, 1].max(1) + GUTTER
    width = chart.width
    step = max(1, BAND // (width * per * per))
    for top in range(0, chart.height, step):
        rows = min(step, chart.height - top)
        asked_for = np.ones((rows, width), bool) if wanted is None else wanted[top : top + rows]
        if not asked_for.any():
            continue
        chosen = np.flatnonzero((high >= top) & (low <= top + rows))
        samples = asked_for.repeat(per, 0).repeat(per, 1)
        owner = np.where(samples, -1, 0)  # what is owned at no distance is passed over
        distance = np.where(samples, GUTTER**2, 0.0)
        split(partial(_nearest, corners, chosen, top * per, per, distance, owner), rows * per, 64)
        owner[~samples] = -1
        yield top, owner


def _nearest(
    corners: Array, chosen: IntArray, first: int, per: int, distance: Array, owner: IntArray, low: int, high: int
) -> None:
    """The owners of rows ``low`` to ``high`` of samples, of which the band's first one is ``first``."""
    kernels.nearest(corners, chosen, first + low, per, GUTTER, distance[low:high], owner[low:high])


def asked(
    chart: Chart, first: int, geometry: Geometry, materials: Materials, owner: IntArray, x: Array, y: Array
) -> FloatArray:
    """Albedo and roughness [n, 4] at positions (x, y) [n] of the texture on or around the triangles ``owner`` [n]."""
    corners, points = chart.corners, chart.mesh.vertices[chart.mesh.faces].astype(np.float64)
    on_texture = float(triangle_areas(corners).sum())
    limit = STRETCH * math.sqrt(float(triangle_areas(points).sum()) / on_texture) if on_texture > 0 else 0.0
    u, v = np.empty((2, len(owner)))
    split(
        lambda low, high: kernels.locate(
            corners, points, owner[low:high], x[low:high], y[low:high], limit, u[low:high], v[low:high]
        ),
        len(owner),
        4096,
    )
    device = geometry.vertices.device
    out = np.empty((len(owner), 4), np.float32)
    for begin in range(0, len(owner), CHUNK):
        part = slice(begin, begin + CHUNK)
        prim = torch.from_numpy(owner[part] + first).to(device)
        at_u, at_v = (torch.from_numpy(z[part]).float().to(device) for z in (u, v))
        towards = geometry.face_normal[prim]
        si = geometry.interact_at(prim, at_u, at_v, towards, torch.ones_like(prim, dtype=torch.bool))
        surface = materials(si)
        values = torch.cat((surface.albedo, surface.roughness.expand(len(prim), 1)), -1)
        out[part] = values.clamp(0.0, 1.0).cpu().numpy()
    return out
