"""How fine a grid has to be for what the photographs show."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch

from neurad.assembly.region import Region
from neurad.core.camera import Cameras
from neurad.core.protocols import Tracer
from neurad.core.records import Rays
from neurad.core.rng import Stream
from neurad.fields.settings import FieldConfig
from neurad.fields.unit_cube import UnitCube
from neurad.scene.description import Scene

RAYS = 8192
"""Camera rays behind a figure."""
CLOSER_FRACTION = 0.1
"""Fraction of what the photographs show that is seen closer than the figure says."""

Config = TypeVar("Config", bound=FieldConfig)


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
        tracer: casts the rays.
        scene: whose training views count.
        device: where rays are cast; they are drawn on the CPU, the same ones everywhere.
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
