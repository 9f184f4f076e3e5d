"""Cells on surfaces, from coarse to fine: what a map of a room is made of when only photographs' pixels limit it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurad.core.records import FloatArray, IntArray, SurfaceInteraction
from neurad.metrics.scores import Float64Array
from neurad.studies.bound.sparse import Rows

COARSEST, FINEST = 2, 12
"""Cells along the longest side of the region, as powers of two."""
PER_PIXEL = 1.5
"""Largest number of the finest cells, in training pixels: finer ones would hold nothing that a photograph shows."""
SIDES = 6
"""A cell's surfaces face one of these ways, so that the two sides of a thin wall share nothing."""


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
    parents: tuple[Rows, ...]
    """What interpolates each level but the first from the one above."""

    @classmethod
    def of(cls, low: FloatArray, high: FloatArray, codes: IntArray, pixels: int) -> SurfaceCells:
        """The cells of some points.

        Args:
            low: corner of the region [3].
            high: opposite corner [3].
            codes: of the points, from :func:`encode` with the same region, sorted and each once.
            pixels: that see them.
        """
        finest = FINEST
        while finest > COARSEST and len(codes) > PER_PIXEL * pixels:
            codes, finest = np.unique(_up(codes, finest)), finest - 1
        levels = [codes]
        for power in range(finest, COARSEST, -1):
            levels.insert(0, np.unique(_up(levels[0], power)))
        parents = [_interpolation(levels[i], levels[i - 1], COARSEST + i) for i in range(1, len(levels))]
        size = float(np.max(np.subtract(high, low)))
        return cls(np.asarray(low, np.float64), size, finest, tuple(levels), tuple(parents))

    @property
    def counts(self) -> list[int]:
        """Cells of every level."""
        return [len(codes) for codes in self.codes]

    def parent_of(self, index: int) -> IntArray:
        """For each cell of level ``index`` > 0 its cell in the level above."""
        return lookup(self.codes[index - 1], _up(self.codes[index], COARSEST + index))

    def find(self, codes: IntArray) -> IntArray:
        """Index among the cells of all levels, one level after the other, of the finest occupied cell at every point;
        -1 where there is none.

        Args:
            codes: of the points, from :func:`encode`, any order [n].
        """
        for power in range(FINEST, self.finest, -1):
            codes = _up(codes, power)
        found = np.full(len(codes), -1, np.int64)
        left = np.arange(len(codes))
        for index in range(len(self.codes) - 1, -1, -1):
            cell = lookup(self.codes[index], codes)
            hit = cell >= 0
            found[left[hit]] = cell[hit] + sum(self.counts[:index])
            left, codes = left[~hit], _up(codes[~hit], COARSEST + index)
        return found


def encode(si: SurfaceInteraction, low: FloatArray, high: FloatArray) -> IntArray:
    """Codes of the finest cells of surface points [n]: their place in the region, and the way that they face."""
    ng = si.ng.cpu().numpy()
    ng = ng * np.where((ng * si.wo.cpu().numpy()).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    axis = np.abs(ng).argmax(-1)
    side = 2 * axis + (np.take_along_axis(ng, axis[:, None], 1)[:, 0] > 0)
    scale = (1 << FINEST) / float(np.max(np.subtract(high, low)))
    place = ((si.p.cpu().numpy() - np.asarray(low, np.float32)) * scale).astype(np.int64)
    return _pack(side.astype(np.int64), np.clip(place, 0, (1 << FINEST) - 1), FINEST)


def lookup(codes: IntArray, wanted: IntArray) -> IntArray:
    """Index of every wanted code among the sorted ``codes``; -1 where it is not one of them."""
    index = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
    return np.where(codes[index] == wanted, index, -1)


def _pack(side: IntArray, place: IntArray, power: int) -> IntArray:
    packed: IntArray = (((side << power) + place[:, 0] << power) + place[:, 1] << power) + place[:, 2]
    return packed


def _unpack(codes: IntArray, power: int) -> tuple[IntArray, IntArray]:
    mask = (1 << power) - 1
    place = np.stack([codes >> 2 * power & mask, codes >> power & mask, codes & mask], -1)
    return codes >> 3 * power, place


def _up(codes: IntArray, power: int) -> IntArray:
    """The cells one level above, of cells of level ``power``."""
    side, place = _unpack(codes, power)
    return _pack(side, place >> 1, power - 1)


def _interpolation(codes: IntArray, above: IntArray, power: int) -> Rows:
    """Weights of the cells ``above`` at the centres of cells of level ``power``: linear along every axis, among those
    that are occupied.
    """
    side, place = _unpack(codes, power)
    parent, towards = place >> 1, np.where(place & 1, 1, -1)
    rows, columns, weights = [], [], []
    for corner in range(8):
        steps = np.array([corner >> k & 1 for k in range(3)])
        where = parent + steps * towards
        inside = ((where >= 0) & (where < 1 << power - 1)).all(-1)
        found = lookup(above, _pack(side, np.clip(where, 0, (1 << power - 1) - 1), power - 1))
        good = np.flatnonzero(inside & (found >= 0))
        rows.append(good)
        columns.append(found[good])
        weights.append(np.full(len(good), 0.25 ** steps.sum() * 0.75 ** (3 - steps.sum())))
    row, column, weight = (np.concatenate(x) for x in (rows, columns, weights))
    return Rows.of(row, column, weight, len(codes), len(above)).row_normalised()
