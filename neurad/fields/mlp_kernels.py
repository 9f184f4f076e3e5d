"""Compiled kernels of small networks: float32 on the CPU. Some rows pass through all layers while what they read and
write stays in a processor's first cache; libraries make one product at a time, each too small for them.

A network is an array ``sizes`` of the channels before, between and after its layers, and an array ``flat`` of weight
[o, i], bias [o], weight, bias, ... in a row. What hidden layers give stands in ``hidden``, layer after layer
[rows, channels].
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import IntArray
from neurad.fields.intrinsics import TILE_COLUMNS, TILE_ROWS, add_products
from neurad.runtime.jit import fastmath_kernel, inlined, kernel, subroutine

Floats = npt.NDArray[np.float32]

_ZERO = np.float32(0)
BLOCK = 64
"""Rows that pass through the layers together, a multiple of ``TILE_ROWS``."""


def rows(count: int) -> int:
    """Rows of arrays in which so many are worked on."""
    return -(-count // TILE_ROWS) * TILE_ROWS


@inlined
def _at(address: Any, index: Any) -> Any:
    return address + np.uint64(4) * np.uint64(index)


@subroutine
def _multiply(
    a: Any, row_a: int, step_a: int, b: Any, step_b: int, out: Any, step_out: int, rows: int, count: int, columns: int
) -> None:  # pragma: no cover - compiled
    """Add ``a b`` to ``out`` [rows, columns], for matrices at addresses; see ``add_products``. ``rows`` is rounded up
    to the next multiple of ``TILE_ROWS``.
    """
    for c in range(0, columns, TILE_COLUMNS):
        for r in range(0, rows, TILE_ROWS):
            add_products(
                _at(a, r * row_a), _at(b, c), _at(out, r * step_out + c), count, row_a, step_a, step_b, step_out,
                columns - c,
            )  # fmt: skip


@fastmath_kernel
def _last_layer(x: Floats, weight: Floats, bias: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    """Fill ``out`` [n, o] with ``x weight^T + bias``, for few outputs; ``x`` [n or more, i]."""
    for i in range(out.shape[0]):
        for r in range(weight.shape[0]):
            total = bias[r]
            for c in range(weight.shape[1]):
                total += x[i, c] * weight[r, c]
            out[i, r] = total


@kernel
def forward(
    x: Floats, flat: Floats, sizes: IntArray, keep: bool, hidden: Floats, out: Floats, room: Floats, low: int, high: int
) -> None:  # pragma: no cover - compiled
    """Fill ``out[low:high]`` [n, outputs] with what a network says of ``x[low:high]`` [n or more, inputs].

    ``low`` is a multiple of ``BLOCK``. ``x`` and ``hidden`` have rows up to the next multiple of ``TILE_ROWS`` after n.
    With ``keep`` hidden values are left in ``hidden`` for :func:`backward`; otherwise it is not used. ``room`` is
    memory to work in: of two blocks of the widest layer and of ``flat``.
    """
    last = sizes.shape[0] - 2  # number of hidden layers
    one: Any = np.int64(1)  # a literal would have a version of its own compiled
    half = (room.shape[0] - flat.shape[0]) // 2
    turned = room[2 * half :]  # weights by input, then output
    at = 0
    for i in range(last):
        inputs, outputs = sizes[i], sizes[i + 1]
        for c in range(inputs):
            for r in range(outputs):
                turned[at + c * outputs + r] = flat[at + r * inputs + c]
        at += (inputs + 1) * outputs
    for start in range(low, high, BLOCK):
        size = min(BLOCK, high - start)
        rows = (size + TILE_ROWS - 1) // TILE_ROWS * TILE_ROWS
        before = x[start : start + rows]
        at = 0
        kept = 0
        for i in range(last):
            inputs, outputs = sizes[i], sizes[i + 1]
            begin = kept + start * outputs if keep else half * (i & 1)
            kept += x.shape[0] * outputs
            after = (hidden if keep else room)[begin : begin + rows * outputs].reshape(rows, outputs)
            bias = flat[at + inputs * outputs : at + (inputs + 1) * outputs]
            for k in range(rows):
                for c in range(outputs):
                    after[k, c] = bias[c]
            _multiply(
                np.uint64(before.ctypes.data), inputs, one, np.uint64(turned[at:].ctypes.data), outputs,
                np.uint64(after.ctypes.data), outputs, rows, inputs, outputs,
            )  # fmt: skip
            for k in range(rows):
                for c in range(outputs):
                    after[k, c] = _ZERO if after[k, c] < _ZERO else after[k, c]  # NaN stays NaN
            at += (inputs + 1) * outputs
            before = after
        inputs, outputs = sizes[last], sizes[last + 1]
        middle = at + inputs * outputs
        weight = flat[at:middle].reshape(outputs, inputs)
        _last_layer(before, weight, flat[middle:], out[start : start + size])


@kernel
def backward(
    g: Floats, x: Floats, hidden: Floats, flat: Floats, sizes: IntArray, columns: int, by_x: Floats, room: Floats,
    by_flat: Floats, low: int, high: int,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Gradients by the first ``columns`` inputs, into ``by_x[low:high]`` [n or more, columns], and by all weights and
    biases, added to ``by_flat``, for those ``g[low:high]`` [n, outputs] by what :func:`forward` gave and kept; ``room``
    as there.
    """
    last = sizes.shape[0] - 2
    one: Any = np.int64(1)
    half = room.shape[0] // 2
    for start in range(low, high, BLOCK):
        size = min(BLOCK, high - start)
        rows = (size + TILE_ROWS - 1) // TILE_ROWS * TILE_ROWS
        outputs = sizes[last + 1]
        outer = room[: rows * outputs].reshape(rows, outputs)
        for k in range(rows):
            for c in range(outputs):
                outer[k, c] = g[start + k, c] if k < size else _ZERO
        end = flat.shape[0]
        kept = hidden.shape[0]
        for step in range(last + 1):
            i = last - step
            inputs, outputs = sizes[i], sizes[i + 1]
            if i > 0:
                kept -= x.shape[0] * inputs
                begin = kept + start * inputs
                before = hidden[begin : begin + rows * inputs].reshape(rows, inputs)
            else:
                before = x[start : start + rows]
            middle, end = end - outputs, end - (inputs + 1) * outputs
            weight = flat[end:middle].reshape(outputs, inputs)
            by_weight = by_flat[end:middle].reshape(outputs, inputs)
            by_bias = by_flat[middle : middle + outputs]
            source = np.uint64(outer.ctypes.data)
            # ---------------------- Weights and biases ----------------------
            whole = outputs - outputs % TILE_ROWS
            _multiply(
                source, one, outputs, np.uint64(before.ctypes.data), inputs, np.uint64(by_weight.ctypes.data), inputs,
                whole, size, inputs,
            )  # fmt: skip
            for k in range(size):
                for r in range(whole, outputs):
                    for c in range(inputs):
                        by_weight[r, c] += outer[k, r] * before[k, c]
                for r in range(outputs):
                    by_bias[r] += outer[k, r]
            # ---------------------- What the layer read ----------------------
            begin = half * ((step + 1) & 1)
            inner = room[begin : begin + rows * inputs].reshape(rows, inputs) if i > 0 else by_x[start : start + rows]
            if i > 0 or columns > 0:
                inner[:] = _ZERO
                _multiply(
                    source, outputs, one, np.uint64(weight.ctypes.data), inputs, np.uint64(inner.ctypes.data),
                    inner.shape[1], rows, outputs, inner.shape[1],
                )  # fmt: skip
            if i > 0:
                for k in range(rows):
                    for c in range(inputs):
                        inner[k, c] = inner[k, c] if before[k, c] > _ZERO else _ZERO
            outer = inner
