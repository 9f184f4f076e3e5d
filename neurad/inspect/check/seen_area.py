"""How much of each mesh's surface some photograph shows."""

from __future__ import annotations

import numpy as np
import torch

from neurad.core.records import IntArray
from neurad.core.rng import Stream
from neurad.metrics.seen import SeenBy
from neurad.scene.geometry import Geometry

POINTS = 1 << 14
"""Random points on all surfaces together, evenly by area."""


@torch.no_grad()
def seen_points(geometry: Geometry, seen_by: SeenBy, seed: int) -> tuple[IntArray, IntArray]:
    """For each mesh, how many random points lie on it, and how many of these a camera sees [meshes]."""
    device = geometry.vertices.device
    u = Stream(seed, 35, device=device).uniform(POINTS, 3)
    total = geometry.face_area.double().cumsum(0)
    prim = torch.searchsorted(total, u[:, 0].double() * total[-1]).clamp_max(len(total) - 1)
    root = u[:, 1].sqrt()
    ones = torch.ones(POINTS, dtype=torch.bool, device=device)
    si = geometry.interact_at(prim, root * (1.0 - u[:, 2]), root * u[:, 2], geometry.face_normal[prim], ones)
    seen = seen_by.any(si).cpu().numpy()
    mesh = geometry.mesh_index[prim].cpu().numpy()
    count = int(geometry.mesh_index.max()) + 1
    return np.bincount(mesh, minlength=count), np.bincount(mesh[seen], minlength=count)
