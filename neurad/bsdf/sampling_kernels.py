"""Warps of :mod:`neurad.core.sampling` to be compiled into kernels; all arithmetic is float32."""

import math
from typing import Any

import numpy as np

from neurad.runtime.jit import inlined

_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_QUARTER_PI, _HALF_PI = np.float32(math.pi / 4), np.float32(math.pi / 2)


@inlined
def concentric_disk(u0: Any, u1: Any) -> Any:  # pragma: no cover - compiled
    """:func:`neurad.core.sampling.concentric_disk` of one pair of numbers: (x, y)."""
    a, b = _TWO * u0 - _ONE, _TWO * u1 - _ONE
    if abs(a) > abs(b):
        r, phi = a, _QUARTER_PI * (b / a)
    else:
        r, phi = b, _HALF_PI - _QUARTER_PI * (a / (b if b != _ZERO else _ONE))
    return r * np.float32(math.cos(phi)), r * np.float32(math.sin(phi))
