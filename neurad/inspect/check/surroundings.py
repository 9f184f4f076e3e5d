"""What lies around a camera in all directions: free space of a room, the inside of a wall, or nothing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.frame import dot
from neurad.core.records import Rays
from neurad.core.scene_records import Camera
from neurad.integrators.world import World

DIRECTIONS = 512
"""Rays from each camera, in pairs of opposite ones."""


@dataclass(frozen=True)
class Surroundings:
    """What surrounds one camera."""

    free: float
    """Fraction of the directions in which nothing is met."""
    open_half: float
    """The same of the half space where it is largest: 1 outside of the convex hull of all surfaces."""
    width: float
    """Median over directions of the distance between what lies ahead and what lies behind, in scene units; infinity
    where that is mostly nothing."""
    backs: float
    """Fraction of what is met that is met from behind, by the triangles' winding; 0 where nothing is."""


def both_ways(pairs: int) -> Tensor:
    """Directions evenly over the sphere [2 pairs, 3]: a spiral over one half, then the opposite ones."""
    index = torch.arange(pairs).double() + 0.5
    z, phi = 1.0 - index / pairs, index * (math.pi * (3.0 - math.sqrt(5.0)))
    radius = (1.0 - z.square()).sqrt()
    half = torch.stack((radius * phi.cos(), radius * phi.sin(), z), -1)
    return torch.cat((half, -half)).float()


@torch.no_grad()
def surroundings(world: World, cameras: Sequence[Camera]) -> list[Surroundings]:
    """Cast rays to all sides from each camera."""
    geometry = world.geometry
    d = both_ways(DIRECTIONS // 2).to(geometry.vertices.device)
    half = (d @ d.T > 0).float()
    found = []
    for camera in cameras:
        eye = torch.as_tensor(camera.to_world, dtype=d.dtype, device=d.device)[:3, 3]
        hit = world.tracer.closest(Rays(eye.expand_as(d).contiguous(), d))
        ahead, behind = torch.where(hit.valid, hit.t, math.inf).chunk(2)
        back = dot(geometry.face_normal[hit.prim.clamp_min(0)], d) > 0
        met = int(hit.valid.sum())
        backs = float((back & hit.valid).sum()) / met if met else 0.0
        open_half = float((half @ (~hit.valid).float() / half.sum(1)).max())
        found.append(Surroundings(1.0 - met / len(d), open_half, float((ahead + behind).median()), backs))
    return found
