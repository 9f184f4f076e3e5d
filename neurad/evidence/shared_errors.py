"""Errors that all photographs share, by what several of them show of the same surface points.

A matt surface has one radiance from wherever it is seen. What a photograph shows of a point, over what others show of
it, is then one, whatever materials and light are; and where it depends on the place in the picture, or on the
photograph, that is the camera's doing: vignetting, a border, a watermark, exposures. Views are the independent units:
every standard error is that over views, by leaving out one at a time or by their scatter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays, in_view, project, to_camera
from neurad.core.protocols import PhotoSource
from neurad.core.records import BoolArray, Camera, Float64Array, IntArray, PixelBatch, SurfaceInteraction
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy

Develop = Callable[[PixelBatch], PixelBatch]

VIEWS = 32
"""Photographs that are compared; where there are more, as many of them, evenly."""
GRID = 64
"""Columns and rows of the pixels that are looked at in each, the outermost ones among them."""
LEAST_VIEWS = 5
"""Views that must show something at one place of the picture for it to be judged."""
CHANCE = 0.01
"""Probability that anything is said by chance of photographs that have nothing wrong in common."""
MATTERS = 0.1
"""Relative effect that is not worth a word, however sure it is."""
MEASURES = 4
"""Edges, the fall towards corners, exposures, and light."""
MARKS = 3
"""Places of the picture from which on something in all photographs is a mark, such as a watermark."""
EDGE = 0.8
"""Part of an outermost row or column that has to be marked for it to be a border."""
_PARTNERS = 4  # other views of a point: those that see it from the nearest directions, where highlights differ least
_DARK = 0.02  # of the median brightness, added before the logarithm
_ROUNDS, _PASSES = 6, 3
_ALIKE = 0.1
"""Times the usual scatter over photographs below which a place of the picture is left out at first: a border."""


def bound(error: Any, units: Any, trials: float = MEASURES, matters: float = MATTERS) -> Any:
    """The size from which on an effect counts: it matters, and by Student's t of an error over independent units any of
    all trials passes by chance with a probability of :data:`CHANCE` (Bonferroni).
    """
    from scipy.special import stdtrit  # imported where it is needed: it loads slowly

    return np.maximum(matters, -stdtrit(np.maximum(units - 1, 1), CHANCE / (2.0 * trials)) * error)


class Estimate(NamedTuple):
    """A number that is estimated."""

    value: float
    error: float
    """Its standard error ..."""
    units: int
    """... over so many independent ones."""

    def off(self, usual: float) -> float:
        """Squared distance from the usual one in standard errors, twice the logarithm of a ratio of likelihoods."""
        return ((self.value - usual) / self.error) ** 2

    def differs(self, usual: float = 0.0) -> bool:
        """Whether it is surely another than the usual one, see :func:`bound`."""
        return abs(self.value - usual) > float(bound(self.error, self.units))


@dataclass(frozen=True)
class SharedErrors:
    """What photographs have in common that surfaces do not."""

    falloff: Estimate
    """Logarithm of the brightness towards the corners over that in the middle; negative with vignetting."""
    spread: Estimate
    """Standard deviation over photographs of the logarithm of their gains; the error is that of one gain."""
    border: dict[str, float]
    """Sides (left, right, top, bottom) with something that is the same in all photographs, and how far it reaches, as a
    fraction of the picture."""
    marked: float
    """Fraction of the rest of the picture where all photographs differ from what lies behind in the same way."""


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
class _Pairs:
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

    def __getitem__(self, rows: BoolArray) -> _Pairs:
        a, b, cell, other = (x[rows] for x in (self.a, self.b, self.cell, self.other))
        return _Pairs(a, b, cell, other, self.far[rows], self.value[rows])


def some_views(count: int, most: int = VIEWS) -> list[int]:
    """Indices of at most so many views, evenly."""
    return sorted({i * count // min(most, count) for i in range(min(most, count))})


def brightness_of(
    photographs: PhotoSource, develop: Develop | None, view: Tensor, pixel: Tensor, left_out: Tensor | None
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


@torch.no_grad()
def shared_errors(
    world: World, cameras: Sequence[Camera], photographs: PhotoSource, develop: Develop | None = None
) -> SharedErrors | None:
    """Compare photographs where they show the same surface points; None where too few do.

    Args:
        develop: corrects them by what a fit has recovered of how they were taken.
    """
    size = tuple(min(GRID, *(getattr(camera, side) for camera in cameras)) for side in ("height", "width"))
    with world.tracer.uncounted():
        pairs, alike = _pairs(world, cameras, photographs, develop, size)
    marked = alike
    views = len(set(pairs.a.tolist()))
    if views < LEAST_VIEWS or len(pairs.a) < 100 * views:
        return None
    for _ in range(_PASSES):  # what is marked decides nothing else
        kept = pairs[~marked[pairs.cell] & ~marked[pairs.other]]
        if len(kept.a) < 100:
            kept = pairs
        gains, slopes = _solved(kept, len(cameras))
        differs = _marked(pairs, pairs.value - _model(pairs, gains, slopes), marked)
        marked = alike | differs
    kept = pairs[~marked[pairs.cell] & ~marked[pairs.other]]
    falloff, spread = _judged(kept, len(cameras))
    picture, known = marked.reshape(size), np.bincount(pairs.cell, minlength=len(marked)).reshape(size) > 0
    border, rest = _border(picture, known)
    inside = known & rest
    marks = int((differs.reshape(size) & inside).sum())
    return SharedErrors(falloff, spread, border, marks / int(inside.sum()) if marks >= MARKS else 0.0)


def _pairs(
    world: World, cameras: Sequence[Camera], photographs: PhotoSource, develop: Develop | None, size: tuple[int, ...]
) -> tuple[_Pairs, BoolArray]:
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
    pairs = _Pairs(
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
    photographs: PhotoSource,
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
    camera: Camera, view: int, xy: Tensor, photographs: PhotoSource, develop: Develop | None, left_out: Tensor | None
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


# ---- gains of photographs, and how brightness falls off: robust least squares


def _shapes(pairs: _Pairs) -> Float64Array:
    """Differences of what the falloff is a sum of [n, 2]: squared distance and its square."""
    first, second = pairs.far.T
    return np.stack((first - second, first**2 - second**2), 1)


def _model(pairs: _Pairs, gains: Float64Array, slopes: Float64Array) -> Float64Array:
    """What gains [views] and falloff [2] make of the logarithms."""
    made: Float64Array = gains[pairs.a] - gains[pairs.b] + _shapes(pairs) @ slopes
    return made


def _normal(pairs: _Pairs, weight: Float64Array, views: int) -> tuple[Float64Array, Float64Array]:
    """Normal equations of each pair of views [views, views, 3, 3] and their right sides [views, views, 3], for the
    difference of gains and both shapes.
    """
    rows = np.concatenate((np.ones((len(weight), 1)), _shapes(pairs)), 1)
    key, left, right = pairs.a * views + pairs.b, np.empty((views, views, 3, 3)), np.empty((views, views, 3))
    for i in range(3):
        right[..., i] = np.bincount(key, weight * rows[:, i] * pairs.value, views**2).reshape(views, views)
        for j in range(3):
            left[..., i, j] = np.bincount(key, weight * rows[:, i] * rows[:, j], views**2).reshape(views, views)
    return left, right


def _solution(left: Float64Array, right: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Gains [views] of mean 0 and slopes [2] by all pairs of views together."""
    views = len(left)
    matrix, vector, n = np.zeros((views + 2, views + 2)), np.zeros(views + 2), left[..., 0, 0]
    matrix[:views, :views] = np.diag(n.sum(1) + n.sum(0)) - n - n.T
    cross = left[..., 0, 1:].sum(1) - left[..., 0, 1:].sum(0)
    matrix[:views, views:], matrix[views:, :views] = cross, cross.T
    matrix[views:, views:] = left[..., 1:, 1:].sum((0, 1))
    vector[:views], vector[views:] = right[..., 0].sum(1) - right[..., 0].sum(0), right[..., 1:].sum((0, 1))
    matrix += 1e-6 * max(float(n.sum()) / views, 1e-12) * np.eye(views + 2)  # gains have a common factor
    found: Float64Array = np.linalg.solve(matrix, vector).astype(np.float64)
    seen = (n.sum(1) + n.sum(0)) > 0
    gains: Float64Array = np.where(seen, found[:views] - found[:views][seen].mean(), 0.0)
    return gains, found[views:]


def _weights(residual: Float64Array) -> Float64Array:
    """Huber's weights: one below a robust standard deviation, falling above."""
    scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-6
    weight: Float64Array = 1.0 / np.maximum(np.abs(residual) / scale, 1.0)
    return weight


def _solved(pairs: _Pairs, views: int) -> tuple[Float64Array, Float64Array]:
    """Gains and slopes, iteratively reweighted."""
    weight = np.ones(len(pairs.a))
    for _ in range(_ROUNDS):
        gains, slopes = _solution(*_normal(pairs, weight, views))
        weight = _weights(pairs.value - _model(pairs, gains, slopes))
    return gains, slopes


def _judged(pairs: _Pairs, views: int) -> tuple[Estimate, Estimate]:
    """The falloff and the spread of gains."""
    gains, slopes = _solved(pairs, views)
    residual = pairs.value - _model(pairs, gains, slopes)
    left, right = _normal(pairs, _weights(residual), views)
    border = float(np.quantile(pairs.far[:, 0], 0.99)) if len(pairs.far) else 0.0
    reach = np.array([border, border**2])
    used = sorted(set(pairs.a.tolist()))
    found = []
    for view in used:  # the weights stay: only sums of pairs change
        kept = np.ones(views, np.bool_)
        kept[view] = False
        mask = np.outer(kept, kept)
        found.append(float(reach @ _solution(left * mask[..., None, None], right * mask[..., None])[1]))
    error = float(np.sqrt((len(used) - 1) * np.var(found)))  # jackknife
    # A gain's error is that of the means over pairs of views: what they disagree in.
    n = left[..., 0, 0]
    mean = (right[..., 0] - left[..., 0, 1:] @ slopes) / np.maximum(n, 1e-12) - (gains[:, None] - gains[None])
    squares, total = (n**2 * mean**2).sum(1) + (n**2 * mean**2).sum(0), n.sum(1) + n.sum(0)
    errors = np.sqrt(squares[used]) / np.maximum(total[used], 1e-12)
    spread = Estimate(float(gains[used].std()), float(np.sqrt(np.mean(errors**2))), len(used))
    return Estimate(float(reach @ slopes), error, len(used)), spread


# ---- places of the picture where all photographs have the same


def _marked(pairs: _Pairs, residual: Float64Array, before: BoolArray) -> BoolArray:
    """Places of the picture [cells] where the photographs together differ from what others show of the same points."""
    cells, views = len(before), int(pairs.a.max()) + 1
    good = ~before[pairs.other]
    key, value = pairs.a[good] * cells + pairs.cell[good], residual[good]
    order = np.lexsort((value, key))
    key, value = key[order], value[order]
    names, first, count = np.unique(key, return_index=True, return_counts=True)
    median = value[first + count // 2]  # of each view at each place
    place = names % cells
    number = np.bincount(place, minlength=cells)
    mean = np.bincount(place, median, cells) / np.maximum(number, 1)
    variance = np.bincount(place, (median - mean[place]) ** 2, cells) / np.maximum(number - 1, 1)
    noise = 1.4826 * float(np.median(np.abs(median - np.median(median))))
    # A spread that is small by chance is none: a tenth of the usual one at least.
    error = np.sqrt((variance + (0.1 * noise) ** 2) / np.maximum(number, 1))
    known = number >= min(LEAST_VIEWS, views)
    marked: BoolArray = known & (np.abs(mean) > bound(error, number, max(int(known.sum()), 1)))
    return marked


def _border(picture: BoolArray, known: BoolArray) -> tuple[dict[str, float], BoolArray]:
    """How far each side of a picture [rows, columns] is marked, and what is left."""
    rest, found = np.ones_like(picture), {}
    for name, turns in (("left", 0), ("top", 1), ("right", 2), ("bottom", 3)):
        marks, seen, kept = (np.rot90(x, turns) for x in (picture, known, rest))
        columns = (marks & seen).sum(0) >= EDGE * np.maximum(seen.sum(0), 1)
        columns &= seen.any(0)
        depth = int(np.argmin(columns)) if not columns.all() else len(columns)
        if depth:
            found[name] = depth / len(columns)
            kept[:, :depth] = False  # a view of ``rest``
    return found, rest
