"""Products with sparse matrices of a few right-hand sides: rows of (column, weight), float32 on the CPU."""

import numpy as np
import numpy.typing as npt

from neurad.core.records import FloatArray, IntArray
from neurad.runtime.jit import kernel


@kernel
def product(
    start: IntArray, column: npt.NDArray[np.int32], weight: FloatArray, x: FloatArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """``out[r] = sum_k weight[k] x[column[k]]`` over the entries of row r, ``start[r] <= k < start[r + 1]``."""
    for r in range(len(out)):
        for c in range(out.shape[1]):
            out[r, c] = 0.0
        for k in range(start[r], start[r + 1]):
            for c in range(out.shape[1]):
                out[r, c] += weight[k] * x[column[k], c]


@kernel
def transposed(
    start: IntArray, column: npt.NDArray[np.int32], weight: FloatArray, x: FloatArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """``out[column[k]] += weight[k] x[r]``: the product with the transposed matrix, added to ``out``."""
    for r in range(len(x)):
        for k in range(start[r], start[r + 1]):
            for c in range(out.shape[1]):
                out[column[k], c] += weight[k] * x[r, c]
