"""What smooth pieces of meshes have of their own in a field: a value, and entries of a hash grid."""

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from neurad.fields.hash_grid import keys_of
from neurad.scene.parts import SurfaceParts


class Segments(nn.Module):
    """A value of each segment, which grid and network add to, and keys of the segments in hash grids.

    A grid alone smears an edge between two colours over a cell on either side, although the mesh says where it lies.

    Args:
        parts: the segments, as of :func:`neurad.scene.parts.segments`.
        channels: of the field.
    """

    keys: Tensor

    def __init__(self, parts: SurfaceParts, channels: int) -> None:
        super().__init__()
        self._parts = parts
        self.values = nn.Parameter(torch.zeros(parts.count, channels))
        self.register_buffer("keys", keys_of(parts.count), persistent=False)

    def at(self, p: Tensor, prim: Tensor | None) -> Tensor:
        """Segment [n] at positions [n, 3] on triangles [n], or on the nearest ones."""
        return self._parts.at(p) if prim is None else self._parts.of(prim)

    def forward(self, y: Tensor, segment: Tensor) -> Tensor:
        """What layers say [n, channels] and segments [n] together."""
        return y + embedding(segment, self.values)
