"""The radiance field of a scene whose materials are known, for ``neurad render --integrator radiometric``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neurad.assembly.build import Assembly, build_radiance, make_guide
from neurad.assembly.settings import ModelSettings
from neurad.core.camera import Cameras
from neurad.core.protocols import Materials
from neurad.core.records import Camera, PixelBatch, View
from neurad.core.rng import Stream
from neurad.fields.radiance import RadianceField
from neurad.integrators.method import Parts
from neurad.integrators.path import PathTracing
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.training.session import MemoryPhotographs, TrainingRun

PIXELS = 1024
"""Pixels of a batch."""
UNIT_RAYS, UNIT_DEPTH = 8192, 8
"""Camera rays behind the unit of radiance, and bounces of their paths."""


class UnphotographedPixels(MemoryPhotographs):
    """Pixels of cameras that took no photographs: they train the prior alone, since their alpha is 0.

    Args:
        scene: with the cameras as training views.
        world: its geometry and lights.
        materials: of its surfaces.
        pixels: of a batch.
        seed: of all draws.
    """

    def __init__(self, scene: Scene, world: World, materials: Materials, pixels: int, seed: int) -> None:
        self.world, self.materials = world, materials
        camera = scene.train[0].camera
        black = torch.zeros(1, 1, 3).expand(len(scene.train), camera.width * camera.height, 3)
        super().__init__(scene, black, pixels, seed)

    @torch.no_grad()
    def mean_square(self, counted: Tensor | None = None) -> float:
        """The squared mean radiance that the surfaces in view reflect, from short paths."""
        stream = Stream(self.seed, 1)
        cameras = Cameras.of([view.camera for view in self.scene.train], "cpu")
        film = torch.tensor([cameras.width, cameras.height])
        view = stream.integers(len(self.scene.train), UNIT_RAYS)
        rays = cameras.rays(view, stream.uniform(UNIT_RAYS, 2) * film)
        si = self.world.trace_past_delta(rays, stream.uniform(UNIT_RAYS)).si
        u = stream.uniform(len(si), DIMENSIONS)
        parts = Parts(self.world, self.materials)
        light = PathTracing(UNIT_DEPTH).reflected(parts, si, self.materials(si), u, stream).value
        mean = float(light[si.valid].mean()) if bool(si.valid.any()) else 0.0
        return mean * mean if mean > 0 else 1.0

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """Random pixels of an iteration, not photographed."""
        views, pixels = self.photographs.shape[:2]
        index = Stream(self.seed, iteration, rank, 5).integers(views * pixels, self.pixels)
        nothing = torch.zeros(len(index), 3)
        return PixelBatch(index // pixels, index % pixels, nothing, nothing[:, 0], iteration)


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
    """Solve the rendering equation by a radiance field: forward neural radiosity (Hadadan et al. 2021).

    The step of ``neurad fit`` with known materials and without photographs: the radiometric prior (Eq. 10) at the first
    hits of the cameras' rays and at hits of one more bounce. Only the numbers of samples differ: without photographs
    nothing is gained by many samples in one pixel, and points far apart say more.

    Args:
        scene: the scene.
        world: its geometry and lights, on the CPU.
        materials: the scene's own.
        cameras: where to look from.
        settings: of the model.
        steps: largest number of iterations.
        seconds: longest time; the learning rates fall with whichever ends first. None for no limit.
        report: called with the iterations done and the loss, after every 100th.
        pixels: of a batch.
    """
    width, height = cameras[0].width, cameras[0].height  # one size for all
    views = [View(f"camera {i}", replace(c, width=width, height=height)) for i, c in enumerate(cameras)]
    scene = replace(scene, train=views)
    settings = replace(
        settings,
        materials="known",
        sampling=replace(
            settings.sampling, spp=2, samples_per_vertex=4, cached_spp=0, field_fraction=1.0, extra_bounce_fraction=0.5
        ),
        objective=replace(settings.objective, lhs=0.0),
    )
    torch.manual_seed(settings.seed)
    field = build_radiance(scene, settings.radiance)
    guide, world.guide = world.guide, make_guide(scene, settings.sampling.guide, settings.method)
    try:
        assembly = Assembly(scene, settings, world, materials, field, None)
        unphotographed = UnphotographedPixels(scene, world, materials, pixels, settings.seed)
        run = TrainingRun(assembly, unphotographed, emitters_train=True)
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
    return field
