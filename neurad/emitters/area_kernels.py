"""Compiled parts of emitters: float32 on the CPU, one pass over the lanes."""

from typing import Any

import numpy as np

from neurad.core.records import FloatArray, IntArray
from neurad.runtime.jit import kernel

_ZERO = np.float32(0.0)


@kernel
def emitted(
    low: int, high: int,
    prim: IntArray, valid: Any, ng: FloatArray, wo: FloatArray, emission: FloatArray, out: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill lanes ``low .. high - 1`` of ``out`` [n, 3] with the ``emission`` [F, 3] of triangles ``prim`` [n] towards
    ``wo`` [n, 3]; 0 from behind and where not ``valid`` [n], bool.
    """
    for i in range(low, high):
        lit = valid[i] and ng[i, 0] * wo[i, 0] + ng[i, 1] * wo[i, 1] + ng[i, 2] * wo[i, 2] > _ZERO
        for k in range(3):
            out[i, k] = emission[prim[i], k] if lit else _ZERO
