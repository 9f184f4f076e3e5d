"""The size of a scene, for steps and tolerances that grow with it."""

import numpy as np
import numpy.typing as npt

OUTLYING = 1024.0
"""How many times farther out than usual something counts as an outlier."""
SOME = 65536
"""Triangles that say what is usual."""


def typical_extent(largest: float, sizes: npt.NDArray[np.floating]) -> float:
    """``largest``, but no more than :data:`OUTLYING` times the median of ``sizes`` [n], none of them negative.

    Steps off surfaces grow with the size of a scene: one triangle at the horizon must not make them as large as a room.
    """
    middle = float(np.median(sizes)) if len(sizes) else 0.0
    return min(largest, OUTLYING * middle) if middle > 0.0 else largest


def subsample(count: int) -> slice:
    """About :data:`SOME` of ``count`` triangles."""
    return slice(None, None, max(1, count // SOME))
