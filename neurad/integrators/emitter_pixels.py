"""Pixels that show an emitter, found without keeping any camera ray."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neurad.core.camera import camera_rays, project, to_camera
from neurad.core.records import Camera
from neurad.core.rng import Stream
from neurad.integrators.film import pixel_positions
from neurad.integrators.world import World

POSITIONS = 16
"""Stratified positions of a pixel at which an emitter is looked for."""
_CHUNK = 1 << 14  # pixels


def emitter_pixels(world: World, cameras: list[Camera], seed: int, device: torch.device) -> Tensor:
    """Whether any of some positions in a pixel sees an emitter's triangle [views, pixels], bool.

    Rays are cast only where the bounding box of an emitting triangle's projection lies: a few pixels, as a rule.
    """
    emission = world.geometry.emission.amax(-1) > 0
    triangles = world.geometry.vertices[world.geometry.faces[emission]].double()
    found = torch.zeros(len(cameras), cameras[0].width * cameras[0].height, dtype=torch.bool, device=device)
    for index, camera in enumerate(cameras):
        pixels = projected(triangles, camera, world.geometry.scale).nonzero().squeeze(-1)
        stream = Stream(seed, index, 3, device=device)
        for begin in range(0, len(pixels), _CHUNK):
            part = pixels[begin : begin + _CHUNK]
            rays = camera_rays(camera, pixel_positions(camera.width, part, POSITIONS, stream).view(-1, 2))
            hit = world.tracer.closest(rays)
            light = hit.valid & emission[hit.prim.clamp_min(0)]
            found[index, part] = light.view(-1, POSITIONS).any(-1)
    return found


def projected(triangles: Tensor, camera: Camera, scale: float) -> Tensor:
    """Pixels [h * w], bool, that the bounding box of a triangle's picture touches, whatever lies before it.

    Args:
        triangles: corners [n, 3, 3] in world space, float64.
        camera: the view; what lies behind it is cut off.
        scale: size of the scene; a millionth of it is the near plane.
    """
    width, height = camera.width, camera.height
    count = triangles.new_zeros(height + 1, width + 1, dtype=torch.int32)
    p = to_camera(camera, triangles)  # [n, 3, 3]
    near = 1e-6 * scale
    before = -p[..., 2] > near
    after, edge = p.roll(-1, 1), before != before.roll(-1, 1)
    # Where an edge passes through the near plane, the picture of the part before it ends.
    t = (-near - p[..., 2]) / torch.where(edge, after[..., 2] - p[..., 2], 1.0)
    cut = p + t.unsqueeze(-1) * (after - p)
    points, real = torch.cat((p, cut), 1), torch.cat((before, edge), 1)
    points[..., 2] = torch.where(real, points[..., 2], -1.0)
    x, y = project(camera, points).unbind(-1)  # [n, 6]
    low, high = [], []
    for value, size in ((x, width), (y, height)):
        # One pixel more on each side than float32 rays could ever need.
        low.append((torch.where(real, value, math.inf).amin(1) - 1.0).clamp(0, size).floor().long())
        high.append((torch.where(real, value, -math.inf).amax(1) + 1.0).clamp(0, size).ceil().long())
    shown = (high[0] > low[0]) & (high[1] > low[1])
    for rows, columns, sign in ((low, low, 1), (low, high, -1), (high, low, -1), (high, high, 1)):
        index = (rows[1][shown], columns[0][shown])
        count.index_put_(index, count.new_full((), sign), accumulate=True)
    return (count.cumsum(0).cumsum(1)[:height, :width] > 0).flatten()
