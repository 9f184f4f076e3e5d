"""Sums at the nodes of a regular grid in the unit cube: scattered and read trilinearly, kept where there are any."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from neurad.core.grid import trilinear
from neurad.core.records import Float64Array, IntArray


@dataclass(frozen=True)
class Nodes:
    """Rows of sums at the occupied nodes."""

    side: int
    """Cells along an edge of the unit cube; one node more."""
    index: IntArray
    """Indices of the occupied nodes, ascending [k], int64."""
    values: Float64Array
    """Sums there [k, c]."""

    @classmethod
    def scattered(cls, x: Float64Array, values: Float64Array, side: int) -> Self:
        """Spread ``values`` [n, c] at positions ``x`` [n, 3] in [0, 1] over the eight nodes around each."""
        node, weight = _trilinear(x, side)
        index, place = np.unique(node, return_inverse=True)
        place = place.reshape(node.shape)
        sums = np.zeros((len(index), values.shape[1]))
        for channel in range(values.shape[1]):
            spread = weight * values[:, channel, None]
            sums[:, channel] = np.bincount(place.ravel(), spread.ravel(), len(index))
        return cls(side, index, sums)

    def read(self, x: Float64Array) -> Float64Array:
        """Trilinear means [n, c] at positions ``x`` [n, 3] in [0, 1]; nodes without anything count as 0."""
        result = np.zeros((len(x), self.values.shape[1]))
        if len(self.index) == 0:
            return result
        node, weight = _trilinear(x, self.side)
        place = np.searchsorted(self.index, node).clip(0, len(self.index) - 1)
        weight = np.where(self.index[place] == node, weight, 0.0)
        for corner in range(8):
            result += weight[:, corner, None] * self.values[place[:, corner]]
        return result


def _trilinear(x: Float64Array, side: int) -> tuple[IntArray, Float64Array]:
    """:func:`neurad.core.grid.trilinear` of arrays."""
    node, weight = trilinear(torch.from_numpy(x), side)
    return node.numpy(), weight.numpy()
