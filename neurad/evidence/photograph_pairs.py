"""What photographs show of the same surface points, two by two."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays, in_view, project, to_camera
from neurad.core.protocols import PhotographedPixels
from neurad.core.records import BoolArray, Float64Array, IntArray, PixelBatch, SurfaceInteraction
from neurad.core.scene_records import Camera
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy

Develop = Callable[[PixelBatch], PixelBatch]

VIEWS = 32
"""Photographs that are compared; where there are more, as many of them, evenly."""
GRID = 64
"""Columns and rows of the pixels that are looked at in each, the outermost ones among them."""
LEAST_VIEWS = 5
"""Views that must show something at one place of the picture for it to be judged."""
_PARTNERS = 4  # other views of a point: those that see it from the nearest directions, where highlights differ least
_DARK = 0.02  # of the median brightness, added before the logarithm
_ALIKE = 0.1
"""Times the usual scatter over photographs below which a place of the picture is left out at first: a border."""


@dataclass(frozen=True)
class _Points:
    """Surface points at a grid of pixels of all views, side by side."""

    si: SurfaceInteraction
    view: IntArray
    row: IntArray
    column: IntArray
    color: Float64Array
    """Brightness in the view's own photograph, NaN where it does not count."""


@dataclass(frozen=True)
class Pairs:
    """Two photographs of one point, a row each: by views and places in the picture."""

    a: IntArray
    b: IntArray
    cell: IntArray
    other: IntArray
    """The place in the picture, of the first and of the second."""
    far: Float64Array
    """Squared distance from the axis over that of a corner, of both [n, 2]."""
    value: Float64Array
    """Logarithm of the first brightness over the second."""

    def __getitem__(self, rows: BoolArray) -> Pairs:
        a, b, cell, other = (x[rows] for x in (self.a, self.b, self.cell, self.other))
        return Pairs(a, b, cell, other, self.far[rows], self.value[rows])


def some_views(count: int, most: int = VIEWS) -> list[int]:
    """Indices of at most so many views, evenly."""
    return sorted({i * count // min(most, count) for i in range(min(most, count))})


def brightness_of(
    photographs: PhotographedPixels, develop: Develop | None, view: Tensor, pixel: Tensor, left_out: Tensor | None
) -> Tensor:
    """Colours of pixels [n, 3], float64; NaN where they are clipped or masks leave them out."""
    color = photographs.colors(view, pixel)
    if develop is not None and len(view):
        color = develop(PixelBatch(view, pixel, color, torch.ones(len(view)), 0)).color.cpu()
    bad = torch.zeros(len(view), dtype=torch.bool)
    if left_out is not None:
        bad |= left_out[view, pixel].cpu()
    if (clipped := photographs.clipped(view, pixel)) is not None:
        bad |= clipped.any(-1).cpu()
    return torch.where(bad.unsqueeze(-1), torch.nan, color.double())


def pairs_of(
    world: World,
    cameras: Sequence[Camera],
    photographs: PhotographedPixels,
    develop: Develop | None,
    size: tuple[int, ...],
) -> tuple[Pairs, BoolArray]:
    """All pairs of photographs of the points at a grid of pixels, and which of its places all show alike."""
    chosen, left_out = some_views(len(cameras)), photographs.ignored()
    points = _points(world, cameras, chosen, photographs, develop, left_out, size)
    eyes = torch.stack([torch.as_tensor(cameras[i].to_world, dtype=torch.float32)[:3, 3] for i in chosen])
    eyes = eyes.to(points.si.p.device)
    towards, front = [_unit(eye - points.si.p) for eye in eyes], (points.si.wo * points.si.n).sum(-1) > 0
    near = torch.stack([(way * points.si.wo).sum(-1) for way in towards], 1).cpu()
    own = torch.from_numpy(np.searchsorted(chosen, points.view))
    near[torch.arange(len(own)), own] = -2.0
    behind = torch.stack([((way * points.si.n).sum(-1) > 0) != front for way in towards], 1).cpu()
    near[behind] = -2.0  # another side of a sheet has another light
    seen = SeenBy(world.geometry, world.tracer, [cameras[i] for i in chosen])
    inside = torch.stack([in_view(cameras[i], points.si.p).cpu() for i in chosen], 1)
    near = torch.where(inside, near, -2.0)
    value, best = near.topk(min(_PARTNERS, len(chosen) - 1), 1) if len(chosen) > 1 else (near[:, :0], own[:, None])
    parts: list[tuple[Any, ...]] = []
    for place, other in enumerate(chosen):
        lanes = ((best[:, : value.shape[1]] == place) & (value > -1.5)).any(1).nonzero().squeeze(-1)
        clear, _ = seen.by(place, points.si[lanes.to(points.si.p.device)])
        lanes = lanes[clear.cpu()]
        camera = cameras[other]
        xy = project(camera, to_camera(camera, points.si.p[lanes.to(points.si.p.device)])).double().cpu()
        theirs = brightness_between(camera, other, xy, photographs, develop, left_out)
        x, y = xy.numpy().T
        cell = _place(y / camera.height, size[0]) * size[1] + _place(x / camera.width, size[1])
        mine = lanes.numpy()
        parts.append((mine, np.full(len(mine), other), cell, _far(camera, x, y), theirs))
    lane, b, cell, far_b, theirs = (np.concatenate([part[k] for part in parts]) for k in range(5))
    mine = points.color[lane]
    known = np.concatenate((points.color[~np.isnan(points.color)], [1e-30]))
    dark = _DARK * max(float(np.median(known[known > 0])), 1e-30)
    value_of = np.log((np.maximum(mine, 0.0) + dark) / (np.maximum(theirs, 0.0) + dark))
    far_a = np.empty(len(lane))
    for view in chosen:
        rows, camera = points.view[lane] == view, cameras[view]
        x = _pixel(points.column[lane][rows], size[1], camera.width) + 0.5
        y = _pixel(points.row[lane][rows], size[0], camera.height) + 0.5
        far_a[rows] = _far(camera, x, y)
    pairs = Pairs(
        points.view[lane], b, points.row[lane] * size[1] + points.column[lane], cell, np.stack((far_a, far_b), 1),
        value_of,
    )  # fmt: skip
    cell, shown = points.row * size[1] + points.column, np.log(np.maximum(points.color, 0.0) + dark)
    return pairs[~np.isnan(value_of)], _alike(cell, shown, size[0] * size[1])


def _alike(cell: IntArray, value: Float64Array, cells: int) -> BoolArray:
    """Places of the picture [cells] where values hardly differ over the views."""
    cell, value = cell[~np.isnan(value)], value[~np.isnan(value)]
    count = np.maximum(np.bincount(cell, minlength=cells), 1)
    mean = np.bincount(cell, value, cells) / count
    scatter = np.sqrt(np.bincount(cell, (value - mean[cell]) ** 2, cells) / count)
    alike: BoolArray = scatter < _ALIKE * float(
        np.median(scatter[count >= LEAST_VIEWS]) if (count >= LEAST_VIEWS).any() else 0.0
    )
    return alike & (count >= LEAST_VIEWS)


def _points(
    world: World,
    cameras: Sequence[Camera],
    chosen: Sequence[int],
    photographs: PhotographedPixels,
    develop: Develop | None,
    left_out: Tensor | None,
    size: tuple[int, ...],
) -> _Points:
    """Surfaces at a grid of pixels of some views: no lamps, and nothing smooth or behind glass."""
    geometry, found = world.geometry, []
    row, column = (x.ravel() for x in np.mgrid[: size[0], : size[1]])
    for view in chosen:
        camera = cameras[view]
        x, y = _pixel(column, size[1], camera.width), _pixel(row, size[0], camera.height)
        xy = torch.from_numpy(np.stack((x, y), 1)).float().to(geometry.vertices.device) + 0.5
        si = world.intersect(camera_rays(camera, xy))
        good = matt(world, si)
        pixel = torch.from_numpy(y * camera.width + x)[good.cpu()]
        color = brightness_of(photographs, develop, torch.full_like(pixel, view), pixel, left_out).mean(-1)
        kept = good.cpu().numpy()
        found.append((si[good], np.full(int(kept.sum()), view), row[kept], column[kept], color.numpy()))
    si = SurfaceInteraction.cat(*(part[0] for part in found))
    view_, row_, column_, color_ = (np.concatenate([part[k] for part in found]) for k in range(1, 5))
    return _Points(si, view_, row_, column_, color_)


def matt(world: World, si: SurfaceInteraction) -> Tensor:
    """Lanes on a surface that neither shines nor is a smooth mirror or glass [n], bool."""
    prim = si.prim.clamp_min(0)
    good = si.valid & (world.geometry.emission.amax(-1) == 0)[prim] & world.reflects(si)
    return good if world.delta is None else good & ~world.delta.is_delta[prim]


def brightness_between(
    camera: Camera,
    view: int,
    xy: Tensor,
    photographs: PhotographedPixels,
    develop: Develop | None,
    left_out: Tensor | None,
) -> Float64Array:
    """Brightness of a photograph between pixels [n]."""
    q = xy - 0.5
    low = torch.minimum(q.floor().clamp_min(0), q.new_tensor([camera.width - 2, camera.height - 2])).clamp_min(0)
    fx, fy = (q - low).clamp(0.0, 1.0).unbind(-1)
    x, y = low.long().unbind(-1)
    found = torch.zeros(len(xy), dtype=torch.float64)
    for dx, dy, weight in ((0, 0, (1 - fx) * (1 - fy)), (1, 0, fx * (1 - fy)), (0, 1, (1 - fx) * fy), (1, 1, fx * fy)):
        pixel = (y + dy).clamp_max(camera.height - 1) * camera.width + (x + dx).clamp_max(camera.width - 1)
        found += weight * brightness_of(photographs, develop, torch.full_like(pixel, view), pixel, left_out).mean(-1)
    return found.numpy()


def _pixel(index: IntArray, count: int, side: int) -> IntArray:
    """The pixel of each of ``count`` columns or rows, the first and the last one among them."""
    return np.round(index * ((side - 1) / max(count - 1, 1))).astype(np.int64)


def _place(fraction: Float64Array, count: int) -> IntArray:
    """The column or row of the grid nearest to a place in the picture, from 0 to 1."""
    return np.clip(np.round(fraction * count - 0.5), 0, count - 1).astype(np.int64)


def _far(camera: Camera, x: Any, y: Any) -> Float64Array:
    """Squared distance of film positions from the axis, over that of a corner of the picture."""
    far: Float64Array = ((x - camera.cx) ** 2 + (y - camera.cy) ** 2) / (0.25 * (camera.width**2 + camera.height**2))
    return far


def _unit(x: Tensor) -> Tensor:
    return torch.nn.functional.normalize(x, dim=-1)
