"""Compiled CPU twin of :meth:`neurad.scene.geometry.Geometry.interact_at`: one pass over the lanes, float32.

Compiled at first use and cached on disk; it releases the interpreter lock and runs on the calling thread.
"""

from __future__ import annotations

import math

import numpy as np

from neurad.core.compiled import compiled
from neurad.core.records import FloatArray, IntArray

_PINCH = np.float32(1e-12)


@compiled
def interact(
    prim: IntArray, u: FloatArray, v: FloatArray, table: FloatArray, p: FloatArray, ng: FloatArray, n: FloatArray,
    uv: FloatArray, bary: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill ``p``, ``ng``, ``n`` [n, 3], ``uv`` and ``bary`` [n, 2] for triangles and barycentrics [n]."""
    for i in range(prim.shape[0]):
        row = table[max(prim[i], 0)]
        a, b = u[i], v[i]
        for k in range(3):
            p[i, k] = row[k] + (a * row[8 + k] + b * row[16 + k])
            ng[i, k] = row[24 + k]
        x = row[3] + (a * row[11] + b * row[19]) + _PINCH * row[24]
        y = row[4] + (a * row[12] + b * row[20]) + _PINCH * row[25]
        z = row[5] + (a * row[13] + b * row[21]) + _PINCH * row[26]
        length = math.sqrt(x * x + y * y + z * z)
        n[i, 0], n[i, 1], n[i, 2] = x / length, y / length, z / length
        uv[i, 0] = row[6] + (a * row[14] + b * row[22])
        uv[i, 1] = row[7] + (a * row[15] + b * row[23])
        bary[i, 0], bary[i, 1] = a, b
