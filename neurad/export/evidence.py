"""Which texels some photograph saw: what of a texture is measured, and what is a guess."""

from __future__ import annotations

import numpy as np
import torch

from neurad.export import raster_kernels as kernels
from neurad.export.bake import GUTTER
from neurad.export.charts import Chart, in_texels
from neurad.export.images import Bytes
from neurad.metrics.scores import BoolArray
from neurad.metrics.seen import SeenBy

COARSER = 4
"""Texels along the side of one of the evidence: it costs a ray for every camera."""
SEEN, UNSEEN, NOTHING = 255, 96, 0
"""Grey of texels that a training view sees, that none does, and that lie on no surface."""


@torch.no_grad()
def evidence(chart: Chart, first: int, seen_by: SeenBy) -> tuple[Bytes, float]:
    """The picture of a mesh [h, w], and the fraction of its texels that some training view sees.

    Args:
        chart: the mesh.
        first: number of its first triangle in the scene.
        seen_by: the training cameras.
    """
    height, width = max(chart.height // COARSER, 4), max(chart.width // COARSER, 4)
    corners = in_texels(chart.mesh, width, height)
    owner = np.full((height, width), -1, np.int64)
    reach = GUTTER * width / chart.width
    kernels.nearest(corners, np.arange(len(corners)), 0, 1, reach, np.full(owner.shape, reach**2), owner)
    lane = np.flatnonzero(owner.ravel() >= 0)
    y, x = np.divmod(lane, width)
    u, v = np.empty((2, len(lane)))
    points = chart.mesh.vertices[chart.mesh.faces].astype(np.float64)
    kernels.locate(corners, points, owner.ravel()[lane], x + 0.5, y + 0.5, 0.0, u, v)  # limit 0: on the triangle
    prim = torch.from_numpy(owner.ravel()[lane] + first)
    geometry = seen_by.geometry
    at_u, at_v = (torch.from_numpy(z).float() for z in (u, v))
    si = geometry.interact_at(prim, at_u, at_v, geometry.face_normal[prim], torch.ones_like(prim, dtype=torch.bool))
    seen: BoolArray = seen_by.any(si).numpy()
    picture = np.full(owner.shape, NOTHING, np.uint8)
    picture.ravel()[lane] = np.where(seen, SEEN, UNSEEN)
    return picture, float(seen.mean()) if len(seen) else 0.0
