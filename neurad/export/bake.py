"""Textures from fields: what lies under texels, as bilinear lookups show it best."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neurad.core.parameters import SurfaceParameter, split
from neurad.core.records import BoolArray, FloatArray
from neurad.export.charts import Chart, border_texels
from neurad.export.texel_means import Means, TexelMeans, beside, uncertain
from neurad.formats.axes import Up
from neurad.runtime import threads
from neurad.scene.description import Scene

PER_TEXEL, MAX_PER_TEXEL = 2, 8
"""Positions along the side of a texel at which the field is asked where it is not settled: the first in large textures,
up to the second in small ones. A point in the middle alone aliases: patterns as fine as a texel come out as coarse
ones, so it stays alone only where it differs little from its neighbours; with four a side nothing was gained over two
in the pictures. What no point in the middle of a texel meets, lines thinner than one, say, stays unseen in large
textures; photographs cannot show it either, since texels are half as wide as their pixels where the budget allows."""
PER_BORDER_TEXEL, MAX_PER_BORDER_TEXEL = 4, 32
"""Positions along the side of a texel that lookups on borders of charts read: the other side averages other positions,
and an eye sees that they differ. Up to the second where values jump under a texel: triangles may be smaller than it."""
SETTLED = 0.5 / 255.0
"""Error of such a mean that is small enough."""
SETTLED_INSIDE = 1.0 / 255.0
"""Error of a texel's mean that is small enough away from borders, where there is no other side: one step of an 8-bit
texture. A point alone stays if it is within four such steps of its neighbours; texels of the kitchen that stay so are
off by 0.1/255 (rms)."""
CHEAP, AFFORDABLE = 1 << 16, 1 << 20
"""Positions in a texture that cost next to nothing, and few enough to ask so many where the field is not settled."""
GIVEN_BACK = 0.125
"""How far a texel is moved away from its four neighbours, as a fraction of the difference to each. The mean over a
texel and the lookup between texels spread what a texture shows, with a variance of 1/12 and 2/12 of a texel squared
along each axis; with an eighth none is left."""


@dataclass(frozen=True)
class Baked:
    """The texture of one mesh, its surface parameters side by side."""

    pixels: FloatArray
    """Linear [h, w, channels], float16; every texel is filled."""
    covered: BoolArray
    """Texels that lie on the mesh or in the gutter around its charts [h, w]."""
    parameters: Sequence[SurfaceParameter]
    """What the channels are."""

    @property
    def maps(self) -> dict[str, FloatArray]:
        """Textures [h, w, channels] by the name of their parameter."""
        return split(self.pixels, self.parameters)


@dataclass(frozen=True)
class BakedRoom:
    """What was recovered, as a scene whose every surface has a texture of its own: what all writers write."""

    scene: Scene
    """Mesh by mesh as the one that was fitted, triangles in the same order; one material a mesh, bitmaps float16."""
    names: list[str]
    """A name for each mesh that is unique and may be that of a file."""
    charts: list[Chart | None]
    """Where each mesh got its texture coordinates; None of meshes without textures."""
    baked: list[Baked | None]
    """Their textures."""
    up: Up
    hide_environment: bool
    """The photographs show no environment: they have an alpha channel."""

    @property
    def texels(self) -> int:
        """Number of texels of all textures."""
        return sum(chart.texels for chart in self.charts if chart is not None)


def bake(mesh: TexelMeans) -> Baked:
    """Ask the materials for every texel of a mesh: the mean over positions in it, a box filter. One position is enough
    in large textures where neighbours say that little happens between them.

    Around a chart the positions lie in the plane of its nearest triangle beyond the edge. There the other side of a
    seam is close by, too, so both sides get about the same values and none can be seen. Inside charts texels get back
    what the box filter and lookups between texels take of fine patterns.
    """
    chart = mesh.chart
    per = positions(CHEAP, chart, 1)
    means = mesh.means(per)
    border = border_texels(chart)
    inner = means.covered & ~border
    refine(mesh, means, inner, per, per, positions(AFFORDABLE, chart, PER_TEXEL), SETTLED_INSIDE)
    refine(mesh, means, border, per, PER_BORDER_TEXEL, MAX_PER_BORDER_TEXEL, SETTLED)
    pixels = sharpened(means, means.inside & ~border)
    return Baked(push_pull(pixels, means.covered).astype(np.float16), means.covered, mesh.parameters)


def refine(mesh: TexelMeans, means: Means, wanted: BoolArray, per: int, least: int, most: int, settled: float) -> None:
    """Ask texels at more and more positions, twice as many along a side, until their means are known.

    Args:
        means: of ``per`` positions along the side of a texel; replaced where more were asked, and their range widened.
        wanted: texels to begin with [h, w].
        per: positions along the side of a texel so far.
        least: positions along a side that all of them get.
        most: along a side, where that does not suffice.
        settled: error of a mean that is small enough.
    """
    error = uncertain(means.values, means.covered, means.spread, per)
    while per < most:
        wanted = wanted & ((per < least) | (error > settled))
        if not wanted.any():
            return
        per *= 2
        finer = mesh.means(per, wanted)
        found = wanted & finer.covered
        changed = np.zeros_like(error)
        changed[found] = np.abs(finer.values[found] - means.values[found]).max(-1)
        means.values[found] = finer.values[found]
        np.minimum(means.least, finer.least, out=means.least)
        np.maximum(means.most, finer.most, out=means.most)
        error = np.maximum(uncertain(means.values, means.covered, finer.spread, per), changed)


def sharpened(means: Means, mask: BoolArray) -> FloatArray:
    """Texels [h, w, channels] whose bilinear lookups show what lies under them, without the blur of filter and lookup.

    No texel gets a value beyond all of those that the mesh has.

    Args:
        mask: texels to change [h, w]; their neighbours have to belong to the same chart.
    """
    out = means.values.copy()

    def work(low: int, high: int) -> None:
        moved = np.zeros_like(out[low:high])
        for there, known in zip(beside(means.values, low, high), beside(means.covered, low, high), strict=True):
            moved += np.where(known[..., None], out[low:high] - there, 0.0)
        within = np.clip(out[low:high] + np.float32(GIVEN_BACK) * moved, means.least, means.most)
        out[low:high][mask[low:high]] = within[mask[low:high]]

    threads.split(work, len(mask), 64)
    return out


def positions(budget: int, chart: Chart, least: int) -> int:
    """Positions along the side of a texel, a power of two: as many as a texture of ``budget`` of them has, but from
    ``least`` to :data:`MAX_PER_TEXEL`.
    """
    most = max(math.isqrt(budget // chart.texels), 1)
    return min(max(1 << (most.bit_length() - 1), least), MAX_PER_TEXEL)


def push_pull(pixels: FloatArray, known: BoolArray) -> FloatArray:
    """The texture with every unknown texel filled by the mean of the known ones around it, so that smaller versions of
    it do not bleed.

    Means of 2 x 2 texels are taken level by level up to one texel; on the way back every unknown texel gets the value
    of the smallest level that knows it.

    Args:
        pixels: [h, w, c], sides powers of two; not read where unknown.
        known: [h, w].

    Returns:
        A new array; zeros where nothing at all is known.
    """
    if known.all() or not known.any():
        return np.where(known[..., None], pixels, 0.0).astype(np.float32)
    filled = np.where(known[..., None], pixels, np.float32(0.0))
    if max(known.shape) == 1:
        return filled
    height, width = known.shape
    rows, columns = min(height, 2), min(width, 2)
    shape = (height // rows, rows, width // columns, columns)
    count = known.reshape(shape).sum((1, 3), dtype=np.float32)
    total = filled.reshape(*shape, -1).sum((1, 3))
    upper = push_pull(total / np.maximum(count, 1.0)[..., None], count > 0)
    return np.where(known[..., None], filled, upper.repeat(rows, 0).repeat(columns, 1))
