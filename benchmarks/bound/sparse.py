"""Sparse matrices by rows, for few right-hand sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.bound import sparse_kernels as kernels
from neurad.core.records import FloatArray, IntArray


@dataclass(frozen=True)
class Rows:
    """A sparse matrix [rows, columns]."""

    start: IntArray
    """First entry of every row, and the number of entries [rows + 1]."""
    column: npt.NDArray[np.int32]
    """[entries]."""
    weight: FloatArray
    """[entries]."""
    columns: int

    @classmethod
    def of(cls, row: Any, column: Any, weight: Any, rows: int, columns: int) -> Rows:
        """From entries [n] in any order; those of one place are added."""
        place = np.asarray(row, np.int64) * columns + np.asarray(column, np.int64)
        found, inverse = np.unique(place, return_inverse=True)
        total = np.bincount(inverse, weights=np.broadcast_to(weight, place.shape), minlength=len(found))
        start = np.searchsorted(found, np.arange(rows + 1, dtype=np.int64) * columns)
        return cls(start, (found % columns).astype(np.int32), total.astype(np.float32), columns)

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """The product with ``x`` [columns, c]."""
        out = np.empty((len(self.start) - 1, x.shape[1]), np.float32)
        kernels.product(self.start, self.column, self.weight, np.ascontiguousarray(x, np.float32), out)
        return out

    def transposed(self, x: FloatArray) -> FloatArray:
        """The product of the transposed matrix with ``x`` [rows, c]."""
        out = np.zeros((self.columns, x.shape[1]), np.float32)
        kernels.transposed(self.start, self.column, self.weight, np.ascontiguousarray(x, np.float32), out)
        return out
