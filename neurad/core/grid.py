"""The nodes of a regular grid in the unit cube, and trilinear weights between them."""

from __future__ import annotations

import numpy as np

from neurad.core.records import Float64Array, IntArray

_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])


def trilinear(x: Float64Array, side: int) -> tuple[IntArray, Float64Array]:
    """The eight nodes around positions in a grid of ``side`` cells along each edge.

    Args:
        x: positions in the unit cube [n, 3]; what lies outside counts as on its surface.
        side: cells along an edge; there is one node more.

    Returns:
        Numbers of the nodes, the last axis fastest, and their weights, each [n, 8].
    """
    scaled = np.clip(np.asarray(x, np.float64), 0.0, 1.0) * side
    cell = np.minimum(scaled.astype(np.int64), side - 1)  # [n, 3]
    fraction = scaled - cell
    at = cell[:, None] + _CORNERS  # [n, 8, 3]
    weight = np.where(_CORNERS == 1, fraction[:, None], 1.0 - fraction[:, None]).prod(-1)
    return (at[..., 0] * (side + 1) + at[..., 1]) * (side + 1) + at[..., 2], weight
