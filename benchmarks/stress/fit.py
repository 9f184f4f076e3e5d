"""A fit without files and without a trainer: the shipped step and settings on photographs held in memory, of built-in
scenes with one thing changed. Only fields, batches and the number of steps are smaller.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from benchmarks.photos import PhotosInMemory
from neurad.assembly.build import build_world
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.model_settings import ModelSettings
from neurad.core.records import PixelBatch, Surface, SurfaceInteraction
from neurad.core.reflection import PrincipledModel, ReflectionModel
from neurad.core.rng import Stream
from neurad.core.scene_records import Constant, Material
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import GridConfig
from neurad.integrators.bounce import bounce
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World
from neurad.optim.polyak_average import averaged
from neurad.runs.model_settings import batch_pixels, model_settings
from neurad.scene.builtin import build_cube
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.session import TrainingRun

SHIPPED = "scene.yaml"
"""Config whose settings the rows train with."""


@cache
def small_settings() -> ModelSettings:
    """The shipped settings with fields that fit small scenes and seconds of training."""
    shipped = model_settings(SHIPPED)
    grid = GridConfig(levels=4, coarsest=4, finest=32, log2_size=14)
    return replace(
        shipped,
        albedo=replace(shipped.albedo, grid=grid, width=32),
        roughness=replace(shipped.roughness, grid=grid, width=32),
        radiance=replace(shipped.radiance, grid=replace(grid, levels=6), width=32, hidden_layers=2),
    )


@dataclass(frozen=True)
class Plan:
    """How a fit is run."""

    steps: int = 300
    pixels: int = 64
    """Pixels of a batch: a quarter of the shipped number."""
    settings: ModelSettings = field(default_factory=small_settings)
    emitters_train: bool = False
    """Whether pixels that show an emitter train too: where everything emits, as in a furnace, nothing else could."""

    def with_seed(self, seed: int) -> Plan:
        """The plan with other random numbers."""
        return replace(self, settings=replace(self.settings, seed=seed))


def plan_of(config: str) -> Plan:
    """All settings of a shipped config, the sizes of fields and batch included.

    Args:
        config: path or shipped name, as behind ``--config``.
    """
    return Plan(pixels=batch_pixels(config), settings=model_settings(config))


def resized(scene: Scene, size: int, train: int | None = None) -> Scene:
    """The scene with square views of ``size`` pixels, the first ``train`` training views of them."""
    parts = [
        [replace(v, image=None, camera=replace(v.camera, width=size, height=size)) for v in views]
        for views in (scene.train[:train], scene.test)
    ]
    return replace(scene, train=parts[0], test=parts[1])


def with_material(scene: Scene, model: ReflectionModel, albedo: float, roughness: float = 1.0) -> Scene:
    """The scene with another material in the place of its first."""
    value = Constant(np.full(3, albedo, np.float32))
    made = Material("extreme", model, value, Constant(np.full(1, roughness, np.float32)))
    return replace(scene, materials=[made, *scene.materials[1:]])


def glossy(scene: Scene) -> Scene:
    """The scene with the parts that ``patterns`` has: principled BSDF and a roughness field."""
    rough = Constant(np.ones(1, np.float32))
    materials = [
        replace(m, model=PrincipledModel(), roughness=rough) if m.model.is_diffuse else m for m in scene.materials
    ]
    return replace(scene, materials=materials)


def small_cube(size: int = 16, albedo: float = 0.5) -> Scene:
    """The ceiling-lit cube with small views and paths of at most eight vertices."""
    return replace(resized(build_cube(albedo), size), max_depth=8)


def photographs(scene: Scene, spp: int, seed: int = 7) -> Tensor:
    """Path-traced training photographs [views, pixels, 3]."""
    world = build_world(scene)
    path = path_tracer(world, TrueMaterials(scene, world.geometry), scene.max_depth, scene.rr_depth)
    images = [render(view.camera, path, spp, seed + i) for i, view in enumerate(scene.train)]
    return torch.stack([image.view(-1, 3) for image in images])


class Fit:
    """A training run on one scene, and how far its albedo is off.

    Args:
        scene: its views say where the photographs were taken.
        images: photographs [views, pixels, 3].
        plan: how to train.
    """

    materials: FittedMaterials
    radiance: RadianceField

    def __init__(self, scene: Scene, images: Tensor, plan: Plan = Plan()) -> None:
        self.scene, self.plan = scene, plan
        self.photos = PhotosInMemory(images, scene.train[0].camera.width, plan.pixels, plan.settings.seed)
        self.training = TrainingRun.of_scene(scene, self.photos, plan.settings, emitters_train=plan.emitters_train)
        assembly = self.training.assembly
        assert isinstance(assembly.materials, FittedMaterials)
        assert assembly.radiance is not None
        self.world: World = assembly.world
        self.materials, self.radiance = assembly.materials, assembly.radiance
        self.advance = self.training.advance

    def run(self) -> Fit:
        """All iterations of the plan.

        Raises:
            NotFinite: a loss, gradient or weight is NaN or infinite.
        """
        for i in range(self.plan.steps):
            self.advance(i / self.plan.steps)
        return self

    @torch.no_grad()
    def seen(self, count: int = 4096) -> SurfaceInteraction:
        """Surface points that the training views see, emitters left out unless they count."""
        stream = Stream(99)
        views, pixels = self.photos.photographs.shape[:2]
        index = stream.integers(views * pixels, count)
        batch = PixelBatch(index // pixels, index % pixels, torch.zeros(count, 3), torch.ones(count), 0)
        si = self.training.views.primary(batch, 1, stream).si
        keep = si.valid
        if not self.plan.emitters_train:
            keep = keep & (self.world.geometry.emission[si.prim.clamp_min(0)].amax(-1) <= 0)
        return si[keep]

    @torch.no_grad()
    def surface(self, si: SurfaceInteraction) -> Surface:
        """Materials at the lanes of ``si``, averaged over the last steps as in all results."""
        with averaged(self.training.assembly.average):
            surface: Surface = self.materials(si)
        return surface

    @torch.no_grad()
    def albedo_error(self, lit: bool = False) -> tuple[float, float]:
        """Root mean square error of the albedo over what the views see, and the mean albedo found there.

        With ``lit`` only where at least half as much direct light falls as on average: photographs of
        unlit surfaces do not determine their albedo.
        """
        si = self.seen()
        if lit:
            white = Surface(torch.ones_like(si.p), torch.ones_like(si.p[:, :1]))
            stream = Stream(98)
            light = sum(bounce(self.world, si, white, stream.uniform(len(si), DIMENSIONS)).direct for _ in range(8))
            assert isinstance(light, Tensor)
            si = si[light.mean(-1) > 0.5 * light.mean()]
        found = self.surface(si).albedo
        truth = TrueMaterials(self.scene, self.world.geometry).albedo(si)
        return float((found - truth).square().mean().sqrt()), float(found.mean())
