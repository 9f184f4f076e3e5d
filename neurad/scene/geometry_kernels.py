"""Kernels of :meth:`neurad.scene.geometry.Geometry.interact_at`, and of the first hits that are kept for camera rays
(:mod:`neurad.integrators.primary_hits`): one pass over the lanes, float32 on the CPU.

Compiled at first use and cached on disk; they release the interpreter lock and run on the calling thread.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import BoolArray, FloatArray, IntArray
from neurad.runtime.jit import inlined, kernel

_ZERO, _PINCH, _TINY = np.float32(0.0), np.float32(1e-12), np.float32(1e-12)


@inlined
def _interact(
    row: FloatArray, a: Any, b: Any, p: FloatArray, ng: FloatArray, n: FloatArray, uv: FloatArray, bary: FloatArray
) -> None:  # pragma: no cover - compiled
    """Fill one lane's ``p``, ``ng``, ``n`` [3], ``uv`` and ``bary`` [2] from its triangle's row of the table."""
    for k in range(3):
        p[k] = row[k] + (a * row[8 + k] + b * row[16 + k])
        ng[k] = row[24 + k]
    x = row[3] + (a * row[11] + b * row[19]) + _PINCH * row[24]
    y = row[4] + (a * row[12] + b * row[20]) + _PINCH * row[25]
    z = row[5] + (a * row[13] + b * row[21]) + _PINCH * row[26]
    length = math.sqrt(x * x + y * y + z * z)
    n[0], n[1], n[2] = x / length, y / length, z / length
    uv[0] = row[6] + (a * row[14] + b * row[22])
    uv[1] = row[7] + (a * row[15] + b * row[23])
    bary[0], bary[1] = a, b


@kernel
def interact(
    low: int, high: int,
    prim: IntArray, u: FloatArray, v: FloatArray, table: FloatArray, p: FloatArray, ng: FloatArray, n: FloatArray,
    uv: FloatArray, bary: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill lanes ``low .. high - 1`` of ``p``, ``ng``, ``n`` [n, 3], ``uv`` and ``bary`` [n, 2] for triangles and
    barycentrics [n].
    """
    for i in range(low, high):
        _interact(table[max(prim[i], 0)], u[i], v[i], p[i], ng[i], n[i], uv[i], bary[i])


@kernel
def put_known(
    prim: IntArray, valid: BoolArray, known: BoolArray, material: IntArray, constant: FloatArray, values: FloatArray,
    replaced: BoolArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Replace ``values`` [n, c] on triangles that are ``known`` [F], whose ``material`` [F] has ``constant`` [m, c];
    fill ``replaced`` [n], whether that was done.
    """
    for i in range(prim.shape[0]):
        face = max(prim[i], 0)
        replaced[i] = valid[i] and known[face]
        if replaced[i]:
            for k in range(values.shape[1]):
                values[i, k] = constant[material[face], k]


@kernel
def interact_kept(
    low: int, high: int,
    kept: npt.NDArray[np.int32], kept_bary: FloatArray, first: IntArray, chosen: IntArray, view: IntArray,
    origin: FloatArray, away: FloatArray, table: FloatArray, prim: IntArray, valid: Any, p: FloatArray, ng: FloatArray,
    n: FloatArray, wo: FloatArray, uv: FloatArray, bary: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Surface points at kept hits, lanes ``low .. high - 1`` of as many as ``chosen`` [b, k] has.

    ``kept`` [m, 3] are triangles (-1 at a miss) and, as ``kept_bary`` [m, 3] shows the same bytes, barycentrics. Lane i
    of pixel j takes the one ``first[j] + chosen[j, i]``, seen from ``origin[view[j]]``; a miss from the directions
    ``away`` [lanes, 3], or if that is [0, 3] from nowhere.
    """
    count = chosen.shape[1]
    for i in range(low, high):
        pixel = i // count
        k = first[pixel] + chosen[pixel, i - pixel * count]
        prim[i], valid[i] = kept[k, 0], kept[k, 0] >= 0
        _interact(
            table[max(kept[k, 0], 0)], kept_bary[k, 1], kept_bary[k, 2], p[i], ng[i], n[i], uv[i], bary[i]
        )  # fmt: skip
        if valid[i]:
            o = origin[view[pixel]]
            x, y, z = o[0] - p[i, 0], o[1] - p[i, 1], o[2] - p[i, 2]
            length = max(np.float32(math.sqrt(x * x + y * y + z * z)), _TINY)
            wo[i, 0], wo[i, 1], wo[i, 2] = x / length, y / length, z / length
        elif away.shape[0] > 0:
            wo[i, 0], wo[i, 1], wo[i, 2] = away[i, 0], away[i, 1], away[i, 2]
        else:
            wo[i, 0], wo[i, 1], wo[i, 2] = _ZERO, _ZERO, _ZERO


@kernel
def number_distinct(chosen: IntArray, last: IntArray, lanes: IntArray, source: IntArray) -> int:
    """How many different positions the rows of ``chosen`` [b, k], positions of pixels, have together.

    Args:
        chosen: below the length of ``last``.
        last: filled with -1.
        lanes: filled with the first lane of each [b * k].
        source: filled with the number that every lane's position has among them [b * k].
    """
    count = 0  # pragma: no cover - compiled
    for pixel in range(chosen.shape[0]):
        begin = count
        for i in range(chosen.shape[1]):
            position, lane = chosen[pixel, i], pixel * chosen.shape[1] + i
            if last[position] < begin:
                last[position], lanes[count] = count, lane
                count += 1
            source[lane] = last[position]
    return count


@kernel
def add_rows(values: FloatArray, rows: IntArray, sums: FloatArray) -> None:  # pragma: no cover - compiled
    """Add ``values`` [n, c] to the ``rows`` [n] of ``sums``."""
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            sums[rows[i], k] += values[i, k]
