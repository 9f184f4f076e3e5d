"""Compiled gradient of a layer's weights: float32 on the CPU."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from neurad.fields.intrinsics import TILE_COLUMNS, TILE_ROWS, add_products
from neurad.runtime.jit import kernel

Floats = npt.NDArray[np.float32]

_ROWS = 64
"""Rows that are read again and again before the next ones: of width 64 they fit into a processor's first cache."""


@kernel
def weight_gradient(g: Floats, x: Floats, by_weight: Floats, by_bias: Floats) -> None:  # pragma: no cover - compiled
    """Add ``g^T x`` to ``by_weight`` [o, i] and the sum of ``g`` to ``by_bias`` [o], for gradients ``g`` [n, o] by what
    a layer gave for inputs ``x`` [n, i]. Twice as fast as torch's product, which is not made for so few numbers.
    """
    n, outputs, inputs = g.shape[0], g.shape[1], x.shape[1]
    whole = outputs - outputs % TILE_ROWS
    for start in range(0, n, _ROWS):
        end = min(start + _ROWS, n)
        for r in range(0, whole, TILE_ROWS):
            for c in range(0, inputs, TILE_COLUMNS):
                add_products(
                    np.uint64(g[start, r:].ctypes.data), np.uint64(x[start, c:].ctypes.data),
                    np.uint64(by_weight[r, c:].ctypes.data), end - start, outputs, inputs, inputs, inputs - c,
                )  # fmt: skip
        for k in range(start, end):
            for r in range(whole, outputs):
                for c in range(inputs):
                    by_weight[r, c] += g[k, r] * x[k, c]
            for r in range(outputs):
                by_bias[r] += g[k, r]
