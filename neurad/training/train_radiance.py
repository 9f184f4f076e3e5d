"""The radiance field of a scene whose materials are known, for ``neurad render --integrator radiometric``."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neurad.assembly.build import Assembly, build_radiance, make_guide
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.region import training_paths, training_region
from neurad.core.camera import Cameras
from neurad.core.protocols import Materials, PhotoSource
from neurad.core.records import DatasetStats, PixelBatch
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera, View
from neurad.fields.radiance import RadianceField
from neurad.integrators.bounce import bounce
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.training.session import TrainingRun

PIXELS = 1024
"""Pixels of a batch."""
UNIT_RAYS = 8192
"""Camera rays behind the unit of radiance."""


class UnphotographedPixels(PhotoSource):
    """Random pixels of cameras that took no photographs. Their alpha is 0, so they train the prior alone.

    Args:
        cameras: where to look from.
        mean_square: squared unit of radiance.
    """

    has_alpha = False
    has_photographs = False

    def __init__(self, cameras: list[Camera], mean_square: float, pixels: int, seed: int) -> None:
        self.counts = torch.tensor([camera.width * camera.height for camera in cameras])
        self.mean_square, self.pixels, self.seed = mean_square, pixels, seed

    def dataset_stats(self, left_out: Tensor | None = None) -> DatasetStats:
        """The unit of radiance, whatever is left out."""
        return DatasetStats(self.mean_square, self.batch(0), [])

    def colors(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Black: nothing was photographed."""
        return torch.zeros(len(view), 3)

    def spread_fireflies(self, left_out: Tensor, beyond: Callable[[], Tensor] | None = None) -> float:
        """There are none."""
        return 0.0

    def request_blurred(self) -> None:
        """Black means are the pixels' colours already."""

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """Random pixels of an iteration."""
        index = Stream(self.seed, iteration, rank, 5).integers(int(self.counts.sum()), self.pixels)
        ends = self.counts.cumsum(0)
        view = torch.searchsorted(ends, index, right=True)
        nothing = torch.zeros(len(index), 3)
        return PixelBatch(view, index - (ends - self.counts)[view], nothing, nothing[:, 0], iteration)


@torch.no_grad()
def mean_square_reflected(world: World, materials: Materials, cameras: list[Camera], seed: int) -> float:
    """The squared radiance that the surfaces in view reflect, by one bounce: what direct light gives on average, over
    one minus what a bounce keeps of the light, as if it were the same everywhere. 1 where nothing is reflected.
    """
    stream = Stream(seed, 1)
    views = Cameras.of(cameras, "cpu")
    view = stream.integers(len(cameras), UNIT_RAYS)
    rays = views.rays(view, stream.uniform(UNIT_RAYS, 2) * views.size[view])
    si = world.trace_past_delta(rays, stream.uniform(UNIT_RAYS)).si
    si = si[si.valid]
    if len(si) == 0:
        return 1.0
    step = bounce(world, si, materials(si), stream.uniform(len(si), DIMENSIONS))
    kept = float(step.next.where_hit(step.weight).mean())
    mean = float(step.direct.mean()) / max(1.0 - kept, 1e-3)
    return mean * mean if mean > 0 else 1.0


def radiance_run(
    scene: Scene,
    world: World,
    materials: Any,
    cameras: list[Camera],
    settings: ModelSettings,
    pixels: int = PIXELS,
) -> TrainingRun:
    """A run that solves the rendering equation by a radiance field: forward neural radiosity (Hadadan et al. 2021).

    The step of ``neurad fit`` with known materials and without photographs: the radiometric prior (Eq. 10) at the first
    hits of the cameras' rays and at hits of one more bounce. Only the numbers of samples differ: without photographs
    nothing is gained by many samples in one pixel, and points far apart say more.

    Args:
        world: its geometry and lights, on the CPU; it gets a guide where the scene takes one.
        cameras: where to look from.
    """
    scene = replace(scene, train=[View(f"camera {i}", camera) for i, camera in enumerate(cameras)])
    settings = replace(
        settings,
        materials="known",
        sampling=replace(
            settings.sampling, spp=2, samples_per_vertex=4, cached_spp=0, field_fraction=1.0, extra_bounce_fraction=0.5
        ),
        objective=replace(settings.objective, lhs=0.0),
    )
    torch.manual_seed(settings.seed)
    region = training_region(scene, training_paths(world, scene))
    field = build_radiance(scene, settings.radiance, region)
    world.guide = make_guide(scene, settings.sampling.guide, settings.method, region)
    mean_square = mean_square_reflected(world, materials, cameras, settings.seed)
    source = UnphotographedPixels(cameras, mean_square, pixels, settings.seed)
    return TrainingRun(Assembly(scene, settings, world, materials, field, None, region), source, emitters_train=True)


def train_radiance(
    scene: Scene,
    world: World,
    materials: Any,
    cameras: list[Camera],
    settings: ModelSettings,
    steps: int,
    seconds: float | None = None,
    report: Callable[[int, float], None] | None = None,
    pixels: int = PIXELS,
) -> RadianceField:
    """The radiance field that :func:`radiance_run` finds; the world keeps the guide that it has.

    Args:
        steps: largest number of iterations.
        seconds: longest time; the learning rates fall with whichever ends first. None for no limit.
        report: called with the iterations done and the loss, after every 100th.
    """
    guide = world.guide
    try:
        run = radiance_run(scene, world, materials, cameras, settings, pixels)
        begin = time.monotonic()
        for index in range(steps):
            spent = (time.monotonic() - begin) / seconds if seconds is not None else 0.0
            if spent >= 1.0:
                break
            loss = run.advance(max(index / steps, spent))
            if report is not None and (index + 1) % 100 == 0:
                report(index + 1, float(loss))
    finally:
        world.guide = guide
    field = run.assembly.radiance
    assert field is not None
    return field
