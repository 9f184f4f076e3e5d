"""The part of a scene that the grids of fields and guide resolve, and how finely: what training rays meet."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import Cameras
from neurad.core.frame import Frame, faceforward
from neurad.core.protocols import Tracer
from neurad.core.records import Float64Array, FloatArray, Hit, Rays
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere
from neurad.fields.settings import FieldConfig
from neurad.fields.unit_cube import SHELL, UnitCube
from neurad.integrators.world import World
from neurad.scene.description import Scene, is_used

RAYS = 8192
"""Camera rays behind a region, and behind the size of its cells."""
RAYS_UNDER_A_SKY = 65536
"""Their number where it is to be known, too, where light of an environment enters."""
BOUNCES = 2
"""Diffuse bounces that follow each of them."""
IGNORED = 0.01
"""Fraction of what rays meet that may lie beyond each side of the region, each point weighted by the inverse length
of its path: what is far is seen coarsely, so it needs no fine cells.
"""
MARGIN = 0.05
"""Free space around what rays meet, as a fraction of its longest side."""
LARGER = 1.5
"""A region takes the place of the whole scene where that is at least so many times as large."""

CLOSER_FRACTION = 0.1
"""Fraction of what the photographs show that is seen closer than the size of cells says."""

Config = TypeVar("Config", bound=FieldConfig)


@dataclass(frozen=True)
class Region:
    """A box that the grids span."""

    bounds: FloatArray
    """Smallest and largest corner [2, 3]."""
    outside: float | None = None
    """Fraction of the training pixels that show what lies outside; None where the box holds every triangle."""

    @property
    def contracted(self) -> bool:
        """Whether something lies outside, which grids contract into their outermost cells."""
        return self.outside is not None

    @property
    def radius(self) -> float:
        """Radius of its bounding sphere."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0])) / 2

    def stretched(self, config: Config) -> Config:
        """``config`` with its cells counted over the whole unit cube."""
        if not self.contracted or not config.has_levels or config.grid.finest is None:
            return config
        coarsest, finest = (min(self.cells(x), 1 << 20) for x in (config.grid.coarsest, config.grid.finest))
        return replace(config, grid=replace(config.grid, coarsest=coarsest, finest=finest))

    def cells(self, count: int, multiple: int = 1) -> int:
        """``count`` cells along the region in cells of the whole unit cube, of which it may take the middle only; a
        multiple of a number.
        """
        return multiple * round(count / (1.0 - 2.0 * SHELL) / multiple) if self.contracted else count

    def sentence(self, scene: Scene) -> str | None:
        """What the grids leave out of a scene, or None if that is nothing."""
        left_out = []
        stray = sum(_outside(m.vertices[~is_used(m)], scene.bounds) for m in scene.meshes)
        if stray:
            left_out.append(f"{stray} {'vertex' if stray == 1 else 'vertices'} that no triangle uses")
        if self.outside is not None:
            far = sum(_outside(m.vertices[m.faces].reshape(-1, 9), np.tile(self.bounds, 3)) for m in scene.meshes)
            count = sum(len(m.faces) for m in scene.meshes)
            left_out.append(
                f"parts of {far} of {count} triangles, resolved the more coarsely the farther out they lie "
                f"({100.0 * self.outside:.2g} % of what the photographs show)"
            )
        if not left_out:
            return None
        low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in self.bounds)
        return f"grids span ({low}) to ({high}), what training rays meet; outside: {' and '.join(left_out)}"


def _outside(values: FloatArray | Float64Array, bounds: FloatArray) -> int:
    """Rows of ``values`` [n, k] that leave ``bounds`` [2, k] anywhere."""
    return int(((values < bounds[0]) | (values > bounds[1])).any(-1).sum())


@dataclass(frozen=True)
class TrainingPaths:
    """What camera rays of the training views and their diffuse bounces meet."""

    points: Float64Array
    """Where they meet surfaces [n, 3]."""
    weight: Float64Array
    """Inverse length of the path to each point [n]."""
    first: Float64Array
    """The first such points of each path [k, 3]."""
    leaving: Rays
    """Bounces that leave the scene, through panes, too, from the surfaces on."""
    bounces: int
    """Number of all bounces."""


def training_region(scene: Scene, paths: TrainingPaths) -> Region:
    """The box around what camera rays of the training views and their diffuse bounces meet, but for few of them.

    One triangle at the horizon would leave a room a few cells. Where all triangles together are not much larger than
    that box, as in any room whose walls are seen, the region is the box of all triangles.
    """
    everything = Region(scene.bounds)
    if len(paths.points) == 0:
        return everything
    low, high = (_quantile(paths.points, paths.weight, q) for q in (IGNORED, 1.0 - IGNORED))
    # Rounded outwards to a 32nd of a power of 2: nothing hangs on the last digits of a ray.
    space = MARGIN * float((high - low).max())
    if not space > 0.0:
        return everything
    step = 2.0 ** (math.ceil(math.log2(space)) - 2)
    bounds = np.stack((np.floor((low - space) / step) * step, np.ceil((high + space) / step) * step))
    bounds = np.clip(bounds, *scene.bounds.astype(np.float64))
    box = bounds.astype(np.float32)
    if (scene.bounds[1] - scene.bounds[0]).max() < LARGER * (box[1] - box[0]).max():
        return everything
    return Region(box, _outside(paths.first, box) / max(len(paths.first), 1))


@torch.no_grad()
def training_paths(world: World, scene: Scene, device: torch.device | str = "cpu") -> TrainingPaths:
    """Cast camera rays of the training views, or of the held-out ones where there are no others, and diffuse bounces
    from what they meet.

    Args:
        device: where rays are cast; they are drawn on the CPU, the same ones everywhere.
    """
    nothing = np.zeros((0, 3))
    if not scene.train and not scene.test:
        return TrainingPaths(nothing, nothing[:, 0], nothing, Rays(torch.zeros(0, 3), torch.zeros(0, 3)), 0)
    with world.tracer.uncounted():
        return _traced(world, scene, device)


def _traced(world: World, scene: Scene, device: torch.device | str) -> TrainingPaths:
    views = scene.train or scene.test
    cameras = Cameras.of([view.camera for view in views], "cpu")
    stream = Stream(0, 4)
    count = RAYS_UNDER_A_SKY if scene.features.has_environment else RAYS
    view = stream.integers(len(views), count)
    home = world.geometry.vertices.device
    rays = cameras.rays(view, stream.uniform(count, 2) * cameras.size[view]).to(home)
    tracer = _Elsewhere(world, device)
    length = torch.zeros(count, device=home)
    points, weights, leaving, bounces = [], [], [rays[:0]], 0
    for bounce in range(1 + BOUNCES):
        si = world.geometry.interact(rays, tracer.closest(rays))
        hidden = torch.zeros_like(si.valid)
        if world.delta is not None:
            si, _, hidden = world.delta.follow(world.geometry, tracer, si, stream.uniform(len(si)).to(home))
        if bounce > 0:
            leaving.append(rays[~si.valid & ~hidden])
            bounces += len(rays)
        length = (length + (si.p - rays.o).norm(dim=-1))[si.valid]
        si = si[si.valid]
        points.append(si.p.double().cpu().numpy())
        weights.append(1.0 / length.double().clamp_min(torch.finfo(torch.float32).tiny).cpu().numpy())
        wi = Frame.around(faceforward(si)).to_world(cosine_hemisphere(stream.uniform(len(si), 2).to(home)))
        rays = world.geometry.spawn(si, wi)
    left = Rays(torch.cat([rays.o for rays in leaving]), torch.cat([rays.d for rays in leaving]))
    return TrainingPaths(np.concatenate(points), np.concatenate(weights), points[0], left, bounces)


def _quantile(points: Float64Array, weight: Float64Array, fraction: float) -> Float64Array:
    """Coordinates [3] below which a fraction of the weight of ``points`` [n, 3] lies, each for itself."""
    found = []
    for values in points.T:
        order = np.argsort(values, kind="stable")
        below = np.cumsum(weight[order])
        found.append(values[order][np.searchsorted(below, fraction * below[-1])])
    return np.array(found)


class _Elsewhere:
    """A world's tracer for rays that are cast on another device than that of the world."""

    def __init__(self, world: World, device: torch.device | str) -> None:
        self.tracer, self.device = world.tracer, device

    def closest(self, rays: Rays) -> Hit:
        return self.tracer.closest(rays.to(self.device)).to(rays.o.device)

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        return self.tracer.occluded(rays.to(self.device), t_max.to(self.device)).to(rays.o.device)


def resolve_finest(config: Config, cells: Callable[[], int]) -> Config:
    """``config`` with a ``finest`` level of ``cells`` where the config leaves it open, and only then calls it."""
    if not config.has_levels or config.grid.finest is not None:
        return config
    return replace(config, grid=replace(config.grid, finest=max(config.grid.coarsest, cells())))


@torch.no_grad()
def finest_cells(tracer: Tracer, scene: Scene, device: torch.device | str = "cpu", region: Region | None = None) -> int:
    """Cells along the longest side of the region, each as large as a pixel where the training views are close: a tenth
    of what they show is closer. Finer cells would hold little but the photographs' noise.

    A pixel grows with the length of its ray. The figure is a power of the root of 2, so that nothing hangs on the last
    digit of that length.

    Args:
        region: what the grids span; None: all triangles.
    """
    cameras = Cameras.of([view.camera for view in scene.train], "cpu")
    stream = Stream(0, 3)
    view = stream.integers(len(scene.train), RAYS)
    xy = stream.uniform(RAYS, 2) * cameras.size[view]
    rays = cameras.rays(view, xy)
    hit = tracer.closest(Rays(rays.o.to(device), rays.d.to(device)))
    valid = hit.valid.cpu()
    if not bool(valid.any()):
        return 1
    pixel = (hit.t.cpu() * cameras.footprint(view, xy))[valid]
    side = 1.0 / float(UnitCube(torch.from_numpy((region or Region(scene.bounds)).bounds)).inverse_side)
    cells = side / max(float(pixel.quantile(CLOSER_FRACTION)), 1e-6 * side)
    return int(2.0 ** (0.5 * round(2.0 * math.log2(cells))) + 0.5)
