"""What lies under the texels of a mesh: means of surface parameters over positions in each."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch

from neurad.core.parameters import ALBEDO, ROUGHNESS, SurfaceParameter
from neurad.core.protocols import Materials
from neurad.core.records import Array, BoolArray, FloatArray, IntArray
from neurad.export import raster_kernels
from neurad.export.charts import Chart, triangle_areas
from neurad.runtime.threads import parallel_map, split, torch_on_one
from neurad.scene.geometry import Geometry

GUTTER = 2.0
"""Texels around a chart that are still baked, in the plane of its nearest triangle; a bilinear lookup reads one."""
BATCH = 1 << 21
"""Positions in flight in a thread, which bounds the memory: 80 bytes each."""
CHUNK = 1 << 16
"""Positions that go through the fields at once."""
STRETCH = 4.0
"""A texel of the gutter may lie so many times further from the mesh than texels are apart on it, not more."""


def uncertain(values: FloatArray, covered: BoolArray, spread: FloatArray, per: int) -> FloatArray:
    """Estimates of the error of means over grids of ``per`` x ``per`` positions, of the value that errs most [h, w].

    Where triangles are smaller than texels, values are as good as drawn by lot, and the error falls with the root of
    how many there are; what merely jumps or bends is known better. What jumps between two positions in a corner is not
    seen at all: there neighbours differ, and up to half of the way between two rows of positions may be theirs.

    Args:
        values: means over the texels of a texture [h, w, c].
        covered: texels that have one [h, w].
        spread: standard deviations over their positions [h, w].
        per: positions along the side of a texel.
    """
    contrast = np.zeros(spread.shape, np.float32)

    def work(low: int, high: int) -> None:
        here, known, out = values[low:high], covered[low:high], contrast[low:high]
        for there, is_known in zip(beside(values, low, high), beside(covered, low, high), strict=True):
            apart = reduce(np.maximum, np.moveaxis(np.abs(here - there), -1, 0))  # a tenth of the time of max(-1)
            np.maximum(out, np.where(known & is_known, apart, 0.0), out=out)

    split(work, len(values), 64)
    error: FloatArray = np.maximum(spread, np.float32(0.25) * contrast) / np.float32(per)
    return error


def beside(picture: Array, low: int, high: int) -> Iterator[Array]:
    """The texel above, below, left and right of those of some rows of a texture [h, w, ...], 0 beyond its edges."""
    above, below = max(low - 1, 0), min(high + 1, len(picture))
    edges = (above - low + 1, high + 1 - below), (1, 1), *[(0, 0)] * (picture.ndim - 2)
    padded = np.pad(picture[above:below], edges)
    yield from (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])


@dataclass(frozen=True)
class Means:
    """Means over the texels of a texture."""

    values: FloatArray
    """[h, w, channels], zero where there is nothing; float32."""
    covered: BoolArray
    """Texels that have anything: on the mesh or in the gutter around its charts [h, w]."""
    inside: BoolArray
    """Texels whose positions all lie on the mesh itself [h, w]."""
    spread: FloatArray
    """Standard deviation over the positions of a texel from a plane through them, of the value that varies most [h, w]:
    means over a grid know planes exactly."""
    least: FloatArray
    """Smallest values at any position [channels]."""
    most: FloatArray
    """Largest ones [channels]."""


def averaged(owner: IntArray, asked: FloatArray, per: int) -> tuple[FloatArray, FloatArray]:
    """:attr:`Means.values` [n, channels] and :attr:`Means.spread` [n] of texels.

    Args:
        owner: the triangle of each of their positions, row by row, -1 for none [n, per * per].
        asked: values at the positions that have a triangle, texel by texel [m, channels].
        per: positions along the side of a texel.
    """
    owned = owner >= 0
    count = np.maximum(owned.sum(1), 1)[:, None]
    values = np.zeros((*owner.shape, asked.shape[1]))
    values[owned] = asked
    mean = values.sum(1) / count
    off = np.where(owned[..., None], values - mean[:, None], 0.0)
    variance = np.square(off).sum(1) / count
    if per > 1:
        place = (np.arange(per) + 0.5) / per - 0.5
        slopes = np.einsum("nsc,sk->nkc", off, np.stack((np.tile(place, per), place.repeat(per)), -1))
        variance -= np.square(slopes).sum(1) / (count**2 * (1.0 - 1.0 / per**2) / 12.0)
    return mean.astype(np.float32), np.sqrt(np.maximum(variance.max(1), 0.0)).astype(np.float32)


def numbers_of(chart: Chart, first: int | IntArray) -> IntArray:
    """Numbers of a mesh's triangles in a scene [f], from that of the first or from themselves."""
    return np.arange(first, first + len(chart.mesh.faces)) if isinstance(first, int) else first


class TexelMeans:
    """A mesh whose texels can be asked for what lies under them, around a chart in the plane of its nearest triangle.

    Args:
        first: number of its first triangle in ``geometry``, or those of all of them [f].
        geometry: of the whole scene, with the same triangles.
        materials: what to ask, on the CPU or where ``geometry`` lies.
    """

    def __init__(
        self,
        chart: Chart,
        first: int | IntArray,
        geometry: Geometry,
        materials: Materials,
        parameters: Sequence[SurfaceParameter] = (ALBEDO, ROUGHNESS),
    ) -> None:
        self.parameters, self.channels = parameters, sum(parameter.channels for parameter in parameters)
        self.chart, self.shape = chart, (chart.height, chart.width)
        self._prims, self._geometry, self._materials = numbers_of(chart, first), geometry, materials
        self._corners = chart.corners
        self._low, self._high = self._corners[:, :, 1].min(1) - GUTTER, self._corners[:, :, 1].max(1) + GUTTER
        self._points = chart.mesh.vertices[chart.mesh.faces].astype(np.float64)
        on_texture, in_space = (float(triangle_areas(x).sum()) for x in (self._corners, self._points))
        self._limit = STRETCH * math.sqrt(in_space / on_texture) if on_texture > 0 else 0.0

    @torch.no_grad()
    @torch_on_one()
    def means(self, per: int, wanted: BoolArray | None = None) -> Means:
        """Means over texels, a box filter.

        Args:
            per: positions along the side of a texel.
            wanted: texels [h, w] to do; None does all, others have nothing.
        """
        size = self.shape[0] * self.shape[1]
        values, spread = np.zeros((size, self.channels), np.float32), np.zeros(size, np.float32)
        covered, inside = np.zeros(size, bool), np.zeros(size, bool)
        least, most = np.ones(self.channels, np.float32), np.zeros(self.channels, np.float32)
        every = np.arange(size) if wanted is None else np.flatnonzero(wanted)
        step = max(1, BATCH // (per * per))
        for begin in range(0, len(every), step):
            texels = every[begin : begin + step]
            owner, inside[texels] = self._owners(texels, per)
            asked = self._asked(owner, texels, per)
            values[texels], spread[texels] = averaged(owner, asked, per)
            least, most = np.minimum(least, asked.min(0, initial=1.0)), np.maximum(most, asked.max(0, initial=0.0))
            covered[texels] = (owner >= 0).any(1)
        return Means(
            values.reshape(*self.shape, -1), covered.reshape(self.shape), inside.reshape(self.shape),
            spread.reshape(self.shape), least, most,
        )  # fmt: skip

    def _owners(self, texels: IntArray, per: int) -> tuple[IntArray, BoolArray]:
        """The triangle of each position in texels [n] in row-major order, -1 for none [n, per * per], and whether all
        positions lie on the mesh [n].
        """
        width = self.shape[1]
        top, bottom = int(texels[0] // width), int(texels[-1] // width) + 1
        slot = np.full((bottom - top) * width, -1, np.int32)
        slot[texels - top * width] = np.arange(len(texels), dtype=np.int32)
        rows = slot.reshape(-1, width)
        chosen = np.flatnonzero((self._high >= top) & (self._low <= bottom))
        distance = np.full((len(texels), per * per), GUTTER**2)
        owner = np.full(distance.shape, -1, np.int64)

        def work(low: int, high: int) -> None:
            raster_kernels.nearest(self._corners, chosen, rows[low:high], top + low, per, GUTTER, distance, owner)

        split(work, bottom - top, max(64 // per, 1))
        return owner, np.asarray(((owner >= 0) & (distance <= 0.0)).all(1))

    def _asked(self, owners: IntArray, texels: IntArray, per: int) -> FloatArray:
        """Values [m, channels] at those positions in texels [n] that have an owner [n, per * per], texel by texel."""
        texel, sample = np.nonzero(owners >= 0)
        owner = owners[texel, sample]
        y, x = np.divmod(texels[texel], self.shape[1])
        row, column = np.divmod(sample, per)
        x, y = x + (column + 0.5) / per, y + (row + 0.5) / per
        u, v = np.empty((2, len(owner)))

        def locate(low: int, high: int) -> None:
            part = slice(low, high)
            raster_kernels.locate(
                self._corners, self._points, owner[part], x[part], y[part], self._limit, u[part], v[part]
            )

        split(locate, len(owner), 4096)
        geometry, device = self._geometry, self._geometry.vertices.device
        out = np.empty((len(owner), self.channels), np.float32)

        def work(begin: int) -> None:
            part = slice(begin, begin + CHUNK)
            prim = torch.from_numpy(self._prims[owner[part]]).to(device)
            at_u, at_v = (torch.from_numpy(z[part]).float().to(device) for z in (u, v))
            towards = geometry.face_normal[prim]
            si = geometry.interact_at(prim, at_u, at_v, towards, torch.ones_like(prim, dtype=torch.bool))
            values = self._materials(si).stacked(self.parameters)
            out[part] = values.clamp(0.0, 1.0).cpu().numpy()

        deque(parallel_map(work, range(0, len(owner), CHUNK)), maxlen=0)
        return out
