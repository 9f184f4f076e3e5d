"""What neighbouring lanes of a picture have in common while the camera moves."""

from collections.abc import Callable

import torch
from torch import Tensor

from neurad.core.frame import dot
from neurad.core.records import SurfaceInteraction
from neurad.scene.geometry import Geometry

TOGETHER = (2, 8)
"""Lanes in a row of which one stands for those that lie on the same mesh."""
ALIKE = 0.98
"""Cosine between normals from which they count as one surface."""

OfLanes = Callable[[SurfaceInteraction], Tensor]
"""Values [n] of lanes, each of which has its own."""


def by_neighbours(geometry: Geometry, si: SurfaceInteraction, values: OfLanes) -> Tensor:
    """``values`` of the lanes of ``si`` [n], asked for at few of them.

    Of :data:`TOGETHER` lanes in a row the first stands for those that hit the same mesh where it faces the same way.
    """
    lane = torch.arange(len(si), device=si.p.device)
    mesh = torch.where(si.valid, geometry.mesh_index[si.prim.clamp_min(0)], -1)
    stands = lane
    for together in TOGETHER:
        first = lane - lane % together
        alike = (mesh == mesh[first]) & (dot(si.n, si.n[first]) > ALIKE)
        stands = torch.where(alike, first, stands)
    own, place = torch.unique(stands, return_inverse=True)
    return values(si[own])[place]
