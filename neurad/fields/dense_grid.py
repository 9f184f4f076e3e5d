"""A dense grid whose vertices are the field's values: the baseline that hash grid and network are compared with.

At 256^3 vertices a table of three channels takes 201 MB in float32, and 604 MB with the two moments of Adam; albedo,
roughness and radiance together 1.41 GB (a checkpoint as much), of which only the vertices next to surfaces are ever
read. 128^3 takes an eighth.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag


class DenseGrid(nn.Module):
    """Trilinear interpolation between ``size^3`` vertices of the unit cube, each with its own values.

    Values start at 0. They are what a field's output activation reads (sigmoid or softplus), so they are unbounded and
    the field stays in its range without clamping.

    Args:
        size: vertices along a side, at least 2.
        channels: values of a vertex.
        sparse: whether the table's gradient names the vertices that were read; on a GPU it is dense.
    """

    corners: Tensor
    """Rows of a cell's corners beyond that of its first, along x, then y, then z [8]."""

    def __init__(self, size: int, channels: int, sparse: bool = True) -> None:
        super().__init__()
        self.size = size
        self.channels = channels
        self.sparse = sparse
        corners = torch.tensor([x + size * (y + size * z) for z in (0, 1) for y in (0, 1) for x in (0, 1)])
        self.register_buffer("corners", corners, persistent=False)
        self.table = nn.Parameter(torch.zeros(size**3, channels))  # vertex (x, y, z) is row x + size (y + size z)

    def forward(self, x: Tensor) -> Tensor:
        """Values [n, channels] at positions [n, 3] in [0, 1]^3; the table alone gets a gradient.

        Raises:
            ValueError: ``x`` requires a gradient, which this encoding does not give.
        """
        if x.requires_grad:
            raise ValueError("DenseGrid: positions get no gradient; detach them")
        position = x * float(self.size - 1)  # [n, 3]
        cell = position.floor().nan_to_num(0.0).clamp(0.0, self.size - 2.0)
        low, t = cell.long(), position - cell
        entry = (low[:, 0] + self.size * (low[:, 1] + self.size * low[:, 2])).unsqueeze(-1) + self.corners  # [n, 8]
        w = torch.stack((1.0 - t, t), -1)  # [n, 3, 2]
        weight = (w[:, 2, :, None, None] * w[:, 1, None, :, None] * w[:, 0, None, None, :]).flatten(1)
        sparse = self.sparse and x.device.type == "cpu"
        return embedding_bag(entry, self.table, mode="sum", per_sample_weights=weight, sparse=sparse)
