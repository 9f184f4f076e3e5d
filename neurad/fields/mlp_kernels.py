"""What layers of a network leave to be gained, compiled: float32 on the CPU. Torch's and oneDNN's products are made for
larger matrices.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from neurad.fields.intrinsics import TILE_COLUMNS, TILE_ROWS, add_products
from neurad.runtime.jit import fastmath_kernel, kernel

Floats = npt.NDArray[np.float32]

_ZERO = np.float32(0)
_ROWS = 64
"""Rows that are read again and again before the next ones: of width 64 they fit into a processor's first cache."""


@kernel
def weight_gradient(g: Floats, x: Floats, by_weight: Floats, by_bias: Floats) -> None:  # pragma: no cover - compiled
    """Add ``g^T x`` to ``by_weight`` [o, i] and the sum of ``g`` to ``by_bias`` [o], for gradients ``g`` [n, o] by what
    a layer gave for inputs ``x`` [n, i].
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


@fastmath_kernel
def last_layer(x: Floats, weight: Floats, bias: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    """Fill ``out`` [n, o] with ``x weight^T + bias``, for few outputs; ``x`` may have more rows."""
    for i in range(out.shape[0]):
        for r in range(weight.shape[0]):
            total = bias[r]
            for c in range(weight.shape[1]):
                total += x[i, c] * weight[r, c]
            out[i, r] = total


@kernel
def last_gradient(
    g: Floats, x: Floats, weight: Floats, by_x: Floats, by_weight: Floats, by_bias: Floats
) -> None:  # pragma: no cover - compiled
    """Gradients of :func:`last_layer` after a ReLU for those ``g`` [n, o] by its outputs: fill ``by_x`` [n or more, i],
    0 where ``x`` is and beyond ``g``, and add to those of the weights and of the bias.
    """
    n, outputs, inputs = g.shape[0], g.shape[1], x.shape[1]
    for i in range(n):
        for c in range(inputs):
            by_x[i, c] = g[i, 0] * weight[0, c]
            by_weight[0, c] += g[i, 0] * x[i, c]
        by_bias[0] += g[i, 0]
        for r in range(1, outputs):
            for c in range(inputs):
                by_x[i, c] += g[i, r] * weight[r, c]
                by_weight[r, c] += g[i, r] * x[i, c]
            by_bias[r] += g[i, r]
        for c in range(inputs):
            if not x[i, c] > _ZERO:
                by_x[i, c] = _ZERO
    by_x[n:] = _ZERO
