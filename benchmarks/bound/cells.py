"""Cells on surfaces, from coarse to fine: what a map of a room is made of when only photographs' pixels limit it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from neurad.core.records import Float64Array, FloatArray, IntArray, Surface, SurfaceInteraction

COARSEST, FINEST = 2, 12
"""Cells along the longest side of the region, as powers of two."""
PER_PIXEL = 2.0
"""Largest number of the finest cells, in training pixels. Several views see each place, so that even then a pixel
covers several cells."""
_MASKS = 0x0000FF0000FF, 0x00F00F00F00F, 0x0C30C30C30C3, 0x249249249249
"""Groups of 8, 4, 2 and 1 bits, each as far apart as three such groups are long."""


@dataclass(frozen=True)
class SurfaceCells:
    """The cells that training views see, level by level, each level with twice as many along a side.

    A value in a cell is the interpolated value of the level above plus a detail of its own: smooth where there is no
    detail. Cells know the points in them and no mesh.
    """

    low: Float64Array
    """Corner of the region [3]."""
    size: float
    """Its longest side."""
    finest: int
    """Power of two of the last level."""
    codes: tuple[IntArray, ...]
    """Sorted codes of the occupied cells of every level."""
    parents: tuple[csr_array, ...]
    """What interpolates each level but the first from the one above."""

    @classmethod
    def of(cls, low: FloatArray, size: float, codes: IntArray, pixels: int) -> SurfaceCells:
        """The cells of some points.

        Args:
            low: corner of the region [3].
            size: its longest side.
            codes: of the points, from :func:`encode` with the same region, sorted and each once.
            pixels: that see them.
        """
        finest = FINEST
        while finest > COARSEST and len(codes) > PER_PIXEL * pixels:
            codes, finest = np.unique(codes >> 3), finest - 1
        levels = [codes]
        for _ in range(finest, COARSEST, -1):
            levels.insert(0, np.unique(levels[0] >> 3))
        parents = [_interpolation(levels[i], levels[i - 1], COARSEST + i) for i in range(1, len(levels))]
        return cls(np.asarray(low, np.float64), size, finest, tuple(levels), tuple(parents))

    @property
    def counts(self) -> list[int]:
        """Cells of every level."""
        return [len(codes) for codes in self.codes]

    def parent_of(self, index: int) -> IntArray:
        """For each cell of level ``index`` > 0 its cell in the level above."""
        return lookup(self.codes[index - 1], self.codes[index] >> 3)

    def find(self, codes: IntArray) -> IntArray:
        """Index among the cells of all levels, one level after the other, of the finest occupied cell at every point;
        -1 where there is none.

        Args:
            codes: of the points, from :func:`encode`, any order [n].
        """
        codes = codes >> 3 * (FINEST - self.finest)
        found = np.full(len(codes), -1, np.int64)
        left = np.arange(len(codes))
        for index in range(len(self.codes) - 1, -1, -1):
            cell = lookup(self.codes[index], codes)
            hit = cell >= 0
            found[left[hit]] = cell[hit] + sum(self.counts[:index])
            left, codes = left[~hit], codes[~hit] >> 3
        return found


@dataclass(frozen=True)
class CellMaterials:
    """Values in cells as the :class:`neurad.core.protocols.Materials` of surfaces."""

    cells: SurfaceCells
    details: FloatArray
    """Albedo and roughness in the cells of all levels, less ``mean`` [cells, 4]."""
    mean: FloatArray
    """What holds where there is no cell [4]."""

    def __call__(self, si: SurfaceInteraction) -> Surface:
        """What the finest cell at each lane has."""
        place = self.cells.find(encode(si, self.cells.low, self.cells.size))
        there = np.where(place[:, None] >= 0, self.details[np.maximum(place, 0)], 0.0) + self.mean
        values = torch.from_numpy(there.astype(np.float32)).to(si.p.device)
        return Surface(values[:, :3], values[:, 3:])

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The first three values [n, 3]."""
        return self(si).albedo


def encode(si: SurfaceInteraction, low: FloatArray | Float64Array, size: float) -> IntArray:
    """Codes of the finest cells of surface points [n]: their place in the region, and which of six ways they face, so
    that the two sides of a thin wall share nothing.
    """
    ng = si.ng.cpu().numpy()
    ng = ng * np.where((ng * si.wo.cpu().numpy()).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    axis = np.abs(ng).argmax(-1)
    side = 2 * axis + (np.take_along_axis(ng, axis[:, None], 1)[:, 0] > 0)
    scale = (1 << FINEST) / size
    place = ((si.p.cpu().numpy() - np.asarray(low, np.float32)) * scale).astype(np.int64)
    return _pack(side.astype(np.int64), np.clip(place, 0, (1 << FINEST) - 1), FINEST)


def lookup(codes: IntArray, wanted: IntArray) -> IntArray:
    """Index of every wanted code among the sorted ``codes``; -1 where it is not one of them."""
    index = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
    return np.where(codes[index] == wanted, index, -1)


def _pack(side: IntArray, place: IntArray, power: int) -> IntArray:
    """Side first, then the bits of the three coordinates in turn (Morton): a cell's code less its last three bits is
    that of the cell above, and cells that lie near each other have codes that do.
    """
    packed: IntArray = side << 3 * power
    for axis in range(3):
        packed = packed | _spread(place[:, axis]) << axis
    return packed


def _spread(x: IntArray) -> IntArray:
    """The bits of ``x``, at most 16 of them, three places apart."""
    for shift, mask in zip((16, 8, 4, 2), _MASKS, strict=True):
        x = (x | x << shift) & np.int64(mask)
    return x


def _gathered(x: IntArray) -> IntArray:
    """Every third bit of ``x``: the reverse of :func:`_spread`."""
    x = x & np.int64(_MASKS[-1])
    for shift, mask in zip((2, 4, 8, 16), (*_MASKS[-2::-1], 0xFFFF), strict=True):
        x = (x | x >> shift) & np.int64(mask)
    return x


def _unpack(codes: IntArray, power: int) -> tuple[IntArray, IntArray]:
    place = codes & ((1 << 3 * power) - 1)
    return codes >> 3 * power, np.stack([_gathered(place >> axis) for axis in range(3)], -1)


def _interpolation(codes: IntArray, above: IntArray, power: int) -> csr_array:
    """Weights of the cells ``above`` at the centres of cells of level ``power``: linear along every axis, among those
    that are occupied.
    """
    side, place = _unpack(codes, power)
    parent, towards = place >> 1, np.where(place & 1, 1, -1)
    column, weight = np.zeros((len(codes), 8), np.int32), np.zeros((len(codes), 8), np.float32)
    for corner in range(8):
        steps = np.array([corner >> k & 1 for k in range(3)])
        where = parent + steps * towards
        inside = ((where >= 0) & (where < 1 << power - 1)).all(-1)
        found = lookup(above, _pack(side, np.clip(where, 0, (1 << power - 1) - 1), power - 1))
        column[:, corner] = np.maximum(found, 0)
        weight[:, corner] = np.where(inside & (found >= 0), 0.25 ** steps.sum() * 0.75 ** (3 - steps.sum()), 0.0)
    weight /= weight.sum(-1, keepdims=True)  # the cell's own parent is always there
    there = weight > 0
    start = np.concatenate(([0], np.cumsum(there.sum(-1))))
    return csr_array((weight[there], column[there], start), shape=(len(codes), len(above)))
