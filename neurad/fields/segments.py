"""What smooth pieces of meshes have of their own in a field: a value, and entries of a hash grid."""

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from neurad.fields.hash_grid import keys_of
from neurad.scene.parts import SurfaceParts

PAINT_COLUMNS = 6
"""Of a segment's paint: colour c, variance s^2 of its error, fraction pi, variance tau^2 of textures."""


class Segments(nn.Module):
    """A value of each segment, which grid and network add to, and keys of the segments in hash grids.

    A grid alone smears an edge between two colours over a cell on either side, although the mesh says where it lies.
    Results show values ``a`` of three channels without clouds, as :mod:`neurad.evidence.paint` finds paint:

        c + (1 - p) (a - c),    p / (1 - p) = pi / (1 - pi) * N(a; c, s^2) / N(a; c, s^2 + tau^2).

    Args:
        parts: the segments, as of :func:`neurad.scene.parts.segments`.
    """

    keys: Tensor
    paint: Tensor

    def __init__(self, parts: SurfaceParts, channels: int) -> None:
        super().__init__()
        self._parts = parts
        self.values = nn.Parameter(torch.zeros(parts.count, channels))
        self.register_buffer("keys", keys_of(parts.count), persistent=False)
        self.register_buffer("paint", torch.zeros(parts.count, PAINT_COLUMNS))
        self.shows_paint = False
        """Whether values are those that results show; not while a fit trains."""

    def at(self, p: Tensor, prim: Tensor | None) -> Tensor:
        """Segment [n] at positions [n, 3] on triangles [n], or on the nearest ones."""
        return self._parts.at(p, prim)

    def forward(self, y: Tensor, segment: Tensor) -> Tensor:
        """What layers say [n, channels] and segments [n] together."""
        return y + embedding(segment, self.values)

    def shown(self, values: Tensor, segment: Tensor) -> Tensor:
        """Values [n, 3] on segments [n] as they are shown."""
        if not self.shows_paint or not bool(self.paint.any()):
            return values
        center, variance, pi, texture = torch.split(embedding(segment, self.paint), [3, 1, 1, 1], -1)
        known = variance > 0
        variance = torch.where(known, variance, 1.0)
        ratio = 1.0 + texture / variance
        away = values - center
        q = away.square().mean(-1, keepdim=True) / variance
        p = torch.sigmoid(torch.logit(pi) + 0.5 * (ratio.log() - q * (1.0 - 1.0 / ratio)))
        return torch.where(known, values - p * away, values)
