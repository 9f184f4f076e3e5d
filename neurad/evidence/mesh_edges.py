"""Where a camera sees edges of the geometry: outlines, steps in depth, creases and borders between materials."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neurad.core.camera import camera_rays, pixel_side, resized
from neurad.core.records import SurfaceInteraction
from neurad.core.scene_records import Camera
from neurad.integrators.world import World

CREASE = math.cos(math.radians(30.0))
"""Cosine between shading normals of neighbours below which there is a crease."""
STEP = 3.0
"""Distance from a neighbour to the plane of a point, in widths of a pixel there, from which on there is a step."""
_CROWD, _CROWDED = 9, 0.45
"""Where more than this fraction of the pixels around (a square of so many) has edges, as in leaves, none is kept."""
_ALL, _FIRST, _LAST = slice(None), slice(None, -1), slice(1, None)
_NEIGHBOURS = (((_FIRST, _ALL), (_LAST, _ALL)), ((_ALL, _FIRST), (_ALL, _LAST)))
"""Pixels of a grid and those below them, and those to the right of them."""


@dataclass(frozen=True)
class PrimaryGrid:
    """What one ray through the middle of each pixel of a camera meets."""

    camera: Camera
    si: SurfaceInteraction
    """Row by row [h * w]."""
    t: Tensor
    """Distances [h * w]; infinity where nothing is met."""
    emits: Tensor
    """Whether it is an emitter's surface [h * w], bool."""


@dataclass(frozen=True)
class MeshEdges:
    """Edges of the geometry in one view."""

    camera: Camera
    """Camera of the grid that was traced: the view's with another number of pixels."""
    mask: Tensor
    """Pixels of the grid beside an edge [h, w], bool: what is drawn."""
    place: Tensor
    """Film positions of edges between two pixels of the grid, in its pixels [m, 2]; crowded ones are left out."""
    point: Tensor
    """What the nearer of the two pixels shows there [m, 3]; harmless values beside pixels that show nothing."""


@torch.no_grad()
def primary_grid(world: World, camera: Camera, width: int) -> PrimaryGrid:
    """Trace the rays of a view.

    Args:
        width: of the grid in pixels.
    """
    grid = resized(camera, width)
    device = world.geometry.vertices.device
    rows, columns = torch.arange(grid.height, device=device), torch.arange(grid.width, device=device)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    rays = camera_rays(grid, torch.stack((x, y), -1).view(-1, 2) + 0.5)
    hit = world.tracer.closest(rays)
    si = world.geometry.interact(rays, hit)
    emits = si.valid & (world.geometry.emission.amax(-1) > 0)[si.prim.clamp_min(0)]
    return PrimaryGrid(grid, si, hit.t, emits)


@torch.no_grad()
def mesh_edges(world: World, grid: PrimaryGrid) -> MeshEdges:
    """Compare each ray of a grid with its neighbours to the right and below.

    There is an edge where one of both meets nothing, where materials differ or only one emits, where the surface turns
    by more than 30 degrees, and where each point lies off the tangent plane of the other.
    """
    h, w = grid.camera.height, grid.camera.width
    valid, si = grid.si.valid, grid.si
    label = torch.where(valid, world.geometry.material[si.prim.clamp_min(0)], -1).view(h, w)
    emits, points, normals = grid.emits.view(h, w), si.p.view(h, w, 3), si.n.view(h, w, 3)
    pixel = torch.where(valid, grid.t, math.inf).view(h, w) * pixel_side(grid.camera)
    away = grid.t.view(h, w)
    mask, places, nearer = torch.zeros_like(emits), [], []
    for dim, (a, b) in enumerate(_NEIGHBOURS):
        way = points[b] - points[a]
        off = torch.minimum((way * normals[a]).sum(-1).abs(), (way * normals[b]).sum(-1).abs())
        step = off > STEP * torch.minimum(pixel[a], pixel[b])
        crease = (normals[a] * normals[b]).sum(-1) < CREASE
        border = (label[a] != label[b]) | (emits[a] != emits[b])
        edge = border | ((step | crease) & (label[a] >= 0) & (label[b] >= 0))
        mask[a] |= edge
        row, column = edge.nonzero().unbind(-1)
        place = torch.stack((column, row), -1) + 0.5
        place[:, 1 - dim] += 0.5
        places.append(place)
        nearer.append(torch.where((away[a] <= away[b]).unsqueeze(-1), points[a], points[b])[edge])
    crowd = avg_pool2d(mask[None, None].float(), _CROWD, 1, _CROWD // 2, count_include_pad=False)[0, 0]
    place = torch.cat(places)
    column, row = place.long().unbind(-1)
    kept = crowd[row.clamp_max(h - 1), column.clamp_max(w - 1)] <= _CROWDED
    return MeshEdges(grid.camera, mask, place[kept], torch.cat(nearer)[kept])
