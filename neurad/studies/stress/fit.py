"""A fit without files and without a trainer: the project's own step on photographs held in memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurad.assembly.build import build_materials, build_radiance, build_world, make_guide
from neurad.assembly.settings import Objective, Sampling
from neurad.core.records import PixelBatch, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.bounce import bounce
from neurad.integrators.estimator import Estimator
from neurad.integrators.film import render
from neurad.integrators.path import PathTracer
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.vertex import DIMENSIONS
from neurad.losses.firefly import typical_square
from neurad.losses.relative import total
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.guide_update import guide_samples, update_guide
from neurad.training.objective import ObjectiveStep, StepTerms

MATERIAL = FieldConfig(GridConfig(levels=4, coarsest=4, finest=32, log2_size=14), width=32)
ROUGHNESS = RoughnessConfig(GridConfig(levels=4, coarsest=4, finest=32, log2_size=14), width=32)
RADIANCE = RadianceConfig(grid=GridConfig(levels=6, coarsest=4, finest=32, log2_size=14), width=32, hidden_layers=2)


@dataclass(frozen=True)
class Fields:
    """Sizes of the fields."""

    albedo: FieldConfig = MATERIAL
    roughness: RoughnessConfig = ROUGHNESS
    radiance: RadianceConfig = RADIANCE


@dataclass(frozen=True)
class Plan:
    """How a fit is run."""

    steps: int = 300
    pixels: int = 256
    rate: float = 1e-2
    sampling: Sampling = Sampling(spp=2, samples_per_vertex=2, cached_spp=4)
    objective: Objective = Objective()
    seed: int = 0
    fields: Fields = Fields()
    emitters_count: bool = False
    """Whether pixels that show an emitter train too: where everything emits, as in a furnace, nothing else could."""


def resized(scene: Scene, size: int, train: int | None = None) -> Scene:
    """The scene with square views of ``size`` pixels, the first ``train`` training views of them."""
    parts = [
        [replace(v, image=None, camera=replace(v.camera, width=size, height=size)) for v in views]
        for views in (scene.train[:train], scene.test)
    ]
    return replace(scene, train=parts[0], test=parts[1])


def photographs(scene: Scene, spp: int, seed: int = 7) -> Tensor:
    """Path-traced training photographs [views, pixels, 3]."""
    world = build_world(scene)
    path = PathTracer(world, TrueMaterials(scene, world.geometry), scene.max_depth, scene.rr_depth)
    images = [render(view.camera, path, spp, seed + i) for i, view in enumerate(scene.train)]
    return torch.stack([image.view(-1, 3) for image in images])


class Fit:
    """Fields, optimizers and the step for one scene.

    Args:
        scene: its views say where the photographs were taken.
        images: photographs [views, pixels, 3].
        plan: how to train.
    """

    def __init__(self, scene: Scene, images: Tensor, plan: Plan = Plan()) -> None:
        torch.manual_seed(plan.seed)
        self.scene, self.images, self.plan = scene, images, plan
        self.materials = build_materials(scene, plan.fields.albedo, plan.fields.roughness)
        self.radiance = build_radiance(scene, plan.fields.radiance)
        self.world = build_world(scene, specular_fraction=plan.sampling.specular_fraction)
        estimator = Estimator(self.world, self.materials, self.radiance)
        self.world.guide = make_guide(scene, plan.sampling.guide, estimator.method)
        cameras = [view.camera for view in scene.train]
        self.primary = PrimaryHits(self.world, cameras, plan.sampling.cached_spp, plan.seed, torch.device("cpu"))
        emitter_mask = self.primary.sees_emitter()
        if plan.emitters_count:
            emitter_mask = torch.zeros_like(emitter_mask)
        firefly_clamp = plan.objective.firefly_clamp
        square = (
            typical_square(images[~emitter_mask], firefly_clamp)
            if firefly_clamp > 0
            else float(images[~emitter_mask].double().square().mean())
        )
        self.radiance.set_scale(math.sqrt(square))
        self.step = ObjectiveStep(
            estimator=estimator,
            primary=self.primary,
            sampling=plan.sampling,
            settings=plan.objective,
            epsilon=plan.objective.epsilon * square,
            emitter_mask=emitter_mask,
        )
        parts = (self.materials, self.radiance)
        self.optimizer = SparseRowAdam([p for part in parts for p in part.parameters()], lr=plan.rate)
        self.iteration = 0

    def batch(self, iteration: int) -> PixelBatch:
        """Random pixels of one iteration."""
        stream = Stream(self.plan.seed, iteration, 5)
        views, pixels = self.images.shape[:2]
        index = stream.integers(views * pixels, self.plan.pixels)
        view, pixel = index // pixels, index % pixels
        return PixelBatch(view, pixel, self.images.view(-1, 3)[index], torch.ones(len(index)), iteration)

    def terms(self, iteration: int) -> StepTerms:
        """Losses of one iteration with the present weights."""
        return self.step(self.batch(iteration), Stream(self.plan.seed, iteration, 1))

    def advance(self, share: float) -> float:
        """One iteration; ``share`` of the run is over. Returns the loss."""
        self.optimizer.param_groups[0]["lr"] = self.plan.rate * (
            0.02 + 0.49 * (1.0 + math.cos(math.pi * min(share, 1.0)))
        )
        terms = self.terms(self.iteration)
        loss = total({**terms.materials, **terms.field})
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        update_guide(self.world.guide, guide_samples(self.world.guide, terms.arrived), self.iteration)
        self.iteration += 1
        return float(loss.detach())

    def run(self) -> Fit:
        """All iterations of the plan.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        for i in range(self.plan.steps):
            loss = self.advance(i / self.plan.steps)
            if not math.isfinite(loss):
                raise FloatingPointError(f"iteration {i}: the loss is {loss}")
        return self

    @torch.no_grad()
    def seen(self, count: int = 4096) -> SurfaceInteraction:
        """Surface points that the training views see, emitters left out unless they count."""
        stream = Stream(99)
        views, pixels = self.images.shape[:2]
        index = stream.integers(views * pixels, count)
        batch = PixelBatch(index // pixels, index % pixels, self.images.view(-1, 3)[index], torch.ones(count), 0)
        si = self.primary(batch, 1, stream).si
        keep = si.valid
        if not self.plan.emitters_count:
            keep = keep & (self.world.geometry.emission[si.prim.clamp_min(0)].amax(-1) <= 0)
        return si[keep]

    @torch.no_grad()
    def albedo_error(self, lit: bool = False) -> tuple[float, float]:
        """Root mean square error of the albedo over what the views see, and the mean albedo found there.

        With ``lit`` only where at least half as much direct light falls as on average: what is dim and dark has no
        known albedo.
        """
        si = self.seen()
        if lit:
            white = Surface(torch.ones_like(si.p), torch.ones_like(si.p[:, :1]))
            stream = Stream(98)
            light = sum(bounce(self.world, si, white, stream.uniform(len(si), DIMENSIONS)).direct for _ in range(8))
            assert isinstance(light, Tensor)
            si = si[light.mean(-1) > 0.5 * light.mean()]
        found = self.materials.albedo(si)
        truth = TrueMaterials(self.scene, self.world.geometry).albedo(si)
        return float((found - truth).square().mean().sqrt()), float(found.mean())
