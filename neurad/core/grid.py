"""The nodes of a regular grid in the unit cube, and trilinear weights between them."""

import torch
from torch import Tensor

_CORNERS = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])


def trilinear(x: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """The eight nodes around positions in a grid of ``cells`` along each edge.

    Args:
        x: positions in the unit cube [n, 3]; what lies outside counts as on its surface.
        cells: along an edge; there is one node more.

    Returns:
        Numbers of the nodes, the last axis fastest, and their weights, each [n, 8].
    """
    corners = _CORNERS.to(x.device)
    scaled = x.clamp(0.0, 1.0) * cells
    cell = scaled.long().clamp(max=cells - 1)  # [n, 3]
    fraction = (scaled - cell)[:, None]
    at = cell[:, None] + corners  # [n, 8, 3]
    weight = torch.where(corners == 1, fraction, 1.0 - fraction).prod(-1)
    return (at[..., 0] * (cells + 1) + at[..., 1]) * (cells + 1) + at[..., 2], weight
