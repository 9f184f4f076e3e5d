"""Pixels that show an emitter, or that look past surfaces, found without keeping any camera ray."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays, project, to_camera
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.integrators.film import pixel_positions
from neurad.integrators.world import World
from neurad.runtime.progress import counted

POSITIONS = 16
"""Stratified positions of a pixel at which an emitter is looked for."""
_CHUNK = 1 << 14  # pixels
_WIDEST, _CELLS = 4.0, 1024  # of the pinhole that stands in for a lens: tangent of its half angle, pixels for that


def emitter_pixels(world: World, cameras: list[Camera], seed: int, device: torch.device) -> Tensor:
    """Whether any of some positions in a pixel sees an emitter's triangle [views, pixels], bool; True behind the last
    pixel of a view that is smaller than others.

    Rays are cast only where the bounding box of an emitting triangle's projection lies: a few pixels, as a rule.
    """
    emission = world.geometry.emission.amax(-1) > 0
    triangles = world.geometry.vertices[world.geometry.faces[emission]].double()
    counts = [camera.width * camera.height for camera in cameras]
    found = torch.arange(max(counts), device=device) >= torch.tensor(counts, device=device).unsqueeze(1)
    for index, camera in enumerate(cameras):
        pixels = shown_in(triangles, camera, world.geometry.scale).nonzero().squeeze(-1)
        stream = Stream(seed, index, 3, device=device)
        for begin in range(0, len(pixels), _CHUNK):
            part = pixels[begin : begin + _CHUNK]
            positions = pixel_positions(camera.width, part, POSITIONS, stream)
            seen = _any_sees(world, emission, camera, positions[:, :1])
            others = ~seen  # most pixels that show an emitter do so at their first position
            seen[others] = _any_sees(world, emission, camera, positions[others, 1:])
            found[index, part] = seen
    return found


def pixels_beyond(world: World, cameras: list[Camera], seed: int, device: torch.device) -> Tensor:
    """Whether a pixel, at one random position in it, shows a smooth surface or the environment [views, pixels], bool;
    True behind the last pixel of a view that is smaller than others.

    There single bright pixels may be right: the sun in the sky, or a small lamp behind glass or in a mirror.
    """
    counts = [camera.width * camera.height for camera in cameras]
    shows_sky = world.features.has_environment and not world.hide_environment
    found = torch.ones(len(cameras), max(counts), dtype=torch.bool, device=device)
    for index, camera in enumerate(counted(cameras, "looking for", len(cameras), "sky, mirrors and glass")):
        stream = Stream(seed, index, 4, device=device)
        for pixels in torch.split(torch.arange(counts[index], device=device), _CHUNK * POSITIONS):
            positions = pixel_positions(camera.width, pixels, 1, stream)
            hit = world.tracer.closest(camera_rays(camera, positions.view(-1, 2)))
            beyond = ~hit.valid & shows_sky
            if world.delta is not None:
                beyond |= hit.valid & world.delta.is_delta[hit.prim.clamp_min(0)]
            found[index, pixels] = beyond
    return found


def _any_sees(world: World, emission: Tensor, camera: Camera, positions: Tensor) -> Tensor:
    """Whether any of the film's ``positions`` [n, k, 2] sees a triangle of which ``emission`` [F], bool, says so."""
    hit = world.tracer.closest(camera_rays(camera, positions.reshape(-1, 2)))
    light = hit.valid & emission[hit.prim.clamp_min(0)]
    return light.view(positions.shape[:2]).any(-1)


def shown_in(triangles: Tensor, camera: Camera, scale: float) -> Tensor:
    """Pixels [h * w], bool, that may show a triangle: what :func:`projected` says, also through a lens that distorts.

    Such a picture is looked up in that of a pinhole with a film of its own; what lies beyond that film, far off the
    axis, may show anything.
    """
    if not camera.lens.bends:
        return projected(triangles, camera, scale)
    pinhole = Camera(camera.to_world, 2.0 * math.atan(_WIDEST), 2 * _CELLS, 2 * _CELLS)
    mask = projected(triangles, pinhole, scale).view(pinhole.height, pinhole.width)
    columns, rows = torch.arange(camera.width + 1), torch.arange(camera.height + 1)
    corners = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 2).double().to(triangles.device)
    local = camera_rays(replace(camera, to_world=np.eye(4, dtype=np.float32)), corners).d
    cell = torch.where(local[:, 2:] < 0, local[:, :2] / -local[:, 2:], math.inf) * (_CELLS / _WIDEST) + _CELLS
    cell[:, 1] = 2 * _CELLS - cell[:, 1]
    cell = cell.clamp(-2.0, 2 * _CELLS + 2.0).view(camera.height + 1, camera.width + 1, 2)
    four = torch.stack((cell[:-1, :-1], cell[1:, :-1], cell[:-1, 1:], cell[1:, 1:]))  # [4, h, w, 2]
    low, high = (four.amin(0) - 1.0).floor().long(), (four.amax(0) + 1.0).floor().long()
    beyond = ((low < 0) | (high >= 2 * _CELLS)).any(-1)
    total = torch.nn.functional.pad(mask.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32), (1, 0, 1, 0))
    (x0, y0), (x1, y1) = ((side.clamp(0, 2 * _CELLS - 1)).unbind(-1) for side in (low, high))
    inside = total[y1 + 1, x1 + 1] - total[y0, x1 + 1] - total[y1 + 1, x0] + total[y0, x0]
    return (beyond | (inside > 0)).flatten()


def projected(triangles: Tensor, camera: Camera, scale: float) -> Tensor:
    """Pixels [h * w], bool, that the bounding box of a triangle's picture touches, whatever lies before it, without
    distortion.

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
