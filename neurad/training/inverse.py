"""The Lightning module that recovers materials and light: an optimizer each, manual optimization, routed gradients."""

from __future__ import annotations

import math
from functools import cache, partial
from typing import Any, Literal

import lightning as L
import torch
from torch import Tensor

from neurad.assembly.build import FittedMaterials, build_materials, build_radiance, build_world
from neurad.assembly.lighting import fitted_environment, unknown_environment
from neurad.assembly.resolution import finest_cells, resolve_finest
from neurad.assembly.settings import Lighting, Objective, Optimization, Sampling
from neurad.core.errors import InputError
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.emitters.fitted import FittedEnvironment
from neurad.fields.mlp import MLP, products
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import FieldConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.estimator import Estimator
from neurad.integrators.method import Method
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.world import World
from neurad.losses.relative import blurred, total
from neurad.metrics.held_out import HeldOut
from neurad.optim.polyak_average import PolyakAverage, averaged
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.runtime.clock import excluded, training_seconds
from neurad.runtime.threads import of_step
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.checkpoint import fitting
from neurad.training.evaluate import Evaluation, UnknownLight, evaluate, unknown_light
from neurad.training.exposure import brightness, mean_square_radiance, random_pixels, warn_if_far
from neurad.training.gradient_sync import GradientSync, ddp_ignored
from neurad.training.guard import Guard, clip
from neurad.training.guide_update import guide_samples, make_guide, update_guide
from neurad.training.objective import ObjectiveStep, StepTerms
from neurad.training.optimizers import make_optimizers
from neurad.training.schedule import fraction_done, rate_factor


class InverseRenderer(L.LightningModule):
    """Recovers albedo and roughness, the environment's light, or both, from photographs of known geometry.

    The parts depend on the scene, so they are built in :meth:`configure_model`, from the data module's scene.

    Args:
        albedo: size of the albedo field.
        roughness: size of the roughness field.
        radiance: size and inputs of the radiance field; a method without one leaves it out.
        sampling: random decisions a pixel.
        objective: terms of the loss.
        optimization: learning rates and schedule.
        tracer: 'embree', 'open3d' or 'warp'.
        seed: of every random decision of the training.
        method: how reflected light and its derivative are estimated; None is the paper's, one bounce and then the
            radiance field.
        lighting: what is known of the light.
        materials: ``fit`` recovers albedo and roughness, ``known`` takes the scene's own and trains no material.
    """

    materials: FittedMaterials | TrueMaterials
    average: PolyakAverage | None
    world: World
    radiance: RadianceField | None

    def __init__(
        self,
        albedo: FieldConfig,
        roughness: RoughnessConfig,
        radiance: RadianceConfig,
        sampling: Sampling = Sampling(),
        objective: Objective = Objective(),
        optimization: Optimization = Optimization(),
        tracer: str = "embree",
        seed: int = 0,
        method: Method | None = None,
        lighting: Lighting = Lighting(),
        materials: Literal["fit", "known"] = "fit",
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.field_configs = (albedo, roughness, radiance)
        self.sampling = sampling
        self.settings = objective
        self.optimization = optimization
        self.tracer = tracer
        self.seed = seed
        self.method = Radiometric() if method is None else method
        self.lighting = lighting
        self.knows_materials = materials == "known"
        if self.knows_materials and lighting.environment == "known" and not self.method.needs_field:
            raise InputError("model.materials: with known materials, known light and no radiance field nothing is left")
        self.iteration = 0
        self.seconds_before = 0.0
        self.rays_before = 0
        self.processes = 1
        self.samples = 0
        """Path samples drawn so far by training: pixels x positions x secondary."""
        self.last_losses: dict[str, Tensor] = {}
        self.average = None
        self._step: ObjectiveStep | None = None
        self._networks = True
        self._guard = Guard(self)
        self._others: GradientSync | None = None
        self._held_out: HeldOut | None = None
        self._light: UnknownLight | None = None
        lhs = objective.lhs > 0 and self.method.needs_field
        if (objective.estimator != "two_pass" or lhs) and sampling.spp < 2:
            raise InputError("model.sampling.spp: leave_one_out and lhs need at least 2 positions a pixel")
        if sampling.cached_spp < 0 or sampling.spp > sampling.cached_spp > 0:
            raise InputError("model.sampling.cached_spp: it must be at least model.sampling.spp, or 0")

    # ---- set-up

    @property
    def scene(self) -> Scene:
        """The scene of the data module in charge."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    def configure_model(self) -> None:
        """Build world, materials and, for a method that reads it, the radiance field from the scene, once.

        Raises:
            InputError: the trainer's precision is one that light transport does not work in.
        """
        if hasattr(self, "materials"):
            return
        if self.trainer.precision != "32-true":
            raise InputError(
                f"--trainer.precision {self.trainer.precision}: light needs float32; for networks there is "
                "model.optimization.matmul"
            )
        torch.manual_seed(self.seed)
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        # Of the world only a guide and an environment that is recovered have a state.
        self.world = build_world(
            self.scene, self.tracer, data.has_alpha, unknown_environment(self.scene, self.lighting),
            self.sampling.specular_fraction,
        )  # fmt: skip
        self.world.guide = make_guide(self.scene, self.sampling.guide, self.method)
        albedo, roughness, radiance = self.field_configs
        tracer = self.world.tracer.tracer  # its rays are no part of the training and not counted
        cells = cache(partial(finest_cells, tracer, self.scene, self.device))
        if self.knows_materials:
            self.materials = TrueMaterials(self.scene, self.world.geometry)
        else:
            self.materials = build_materials(
                self.scene, resolve_finest(albedo, cells), resolve_finest(roughness, cells), self.world.geometry
            )
            if self.optimization.average > 0:
                self.average = PolyakAverage(self.materials, self.optimization.average)
        self.radiance = build_radiance(self.scene, resolve_finest(radiance, cells)) if self.method.needs_field else None
        if self.trainer.world_size > 1:
            self._ddp_params_and_buffers_to_ignore = ddp_ignored(self)  # DDP's own name for it

    def configure_optimizers(self) -> list[SparseRowAdam | PyramidAdam]:
        """One optimizer each for what is not known: albedo, roughness (if there is one to find), the environment, and
        radiance (if the method reads it).
        """
        made = make_optimizers(
            self.materials, self.environment, self.radiance, self.optimization, self.lighting.detail_decay
        )
        self.optimizer_names = list(made)
        return list(made.values())

    def on_fit_start(self) -> None:
        """Trace the camera rays of the training views, and take the units of light from the photographs."""
        self.processes = self.trainer.world_size
        self._networks = any(isinstance(part, MLP) for part in self.modules())
        self._others = GradientSync(self, self._ddp_params_and_buffers_to_ignore) if self.processes > 1 else None
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        self.sampling.split_over(getattr(data, "pixel_multiplier", 1))  # refuses what cannot be
        cameras = [view.camera for view in self.scene.train]
        with self.world.tracer.uncounted(self.iteration > 0):  # a continued run counted them when it began
            primary = PrimaryHits(self.world, cameras, self.sampling.cached_spp, self.seed, self.device)
            emitter_mask = primary.sees_emitter()
        if bool(emitter_mask.all()):
            raise InputError(f"scene {self.scene.name}: every pixel of every training view shows an emitter")
        mean_square, sample = mean_square_radiance(data, emitter_mask, self.settings.firefly_clamp)
        if self.environment is not None:
            self.environment.set_unit(math.sqrt(mean_square))
        elif self.iteration == 0:
            shown = random_pixels(data.photographs, emitter_mask, self.seed) if sample is None else sample
            warn_if_far(brightness(primary, shown, self.seed))
        if self.radiance is not None:
            self.radiance.set_scale(math.sqrt(mean_square))
        with excluded(), self.world.tracer.uncounted():
            self._held_out = HeldOut(self.scene, self.world.geometry, self.world.tracer).read()
        self._step = ObjectiveStep(
            estimator=self.estimator,
            primary=primary,
            sampling=self.sampling,
            settings=self.settings,
            epsilon=self.settings.epsilon * mean_square,
            emitter_mask=emitter_mask,
            blurred=self._blurred(data, cameras[0].width),
        )

    def _blurred(self, data: Any, width: int) -> Tensor | None:
        """What residuals are relative to where there is no field to predict it; None where it is not asked for."""
        kind = self.settings.normaliser
        if kind == "blurred" or (kind == "prediction" and not self.method.needs_field):
            if getattr(data, "streams", False):  # batches bring it
                data.wants_blurred = True
                return None
            return blurred(data.photographs, data.alpha, width).to(self.device)
        return None

    @property
    def estimator(self) -> Estimator:
        """The method's estimates with the present materials and radiance field."""
        return Estimator(self.world, self.materials, self.radiance, self.method)

    @property
    def environment(self) -> FittedEnvironment | None:
        """The environment that is recovered; None where it is known."""
        return fitted_environment(self.world)

    # ---- training

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        """One iteration: one backward pass whose gradients never meet, a step of each optimizer."""
        with of_step(self._lanes(batch), self._networks):
            return self._iterate(batch)

    def _lanes(self, batch: PixelBatch) -> int:
        """Path samples that a batch asks for: pixels x positions x secondary."""
        return len(batch.view) * (self.sampling.spp // batch.pixel_multiplier) * self.sampling.samples_per_vertex

    def _iterate(self, batch: PixelBatch) -> Tensor:
        found: Any = self.optimizers()
        optimizers = found if isinstance(found, list) else [found]
        factor = rate_factor(self.optimization, self.iteration, fraction_done(self.trainer).largest)
        for index, optimizer in enumerate(optimizers):
            optimizer.zero_grad()
            if index > 0:  # the trainer counts steps of the first optimizer only, so max_steps means iterations
                optimizer._on_before_step = _nothing
                optimizer._on_after_step = _nothing
        if self.environment is not None and self.iteration % self.lighting.refresh == 0:
            self.environment.refresh()
        with products(self.optimization.matmul):
            terms = self._terms(batch)
            loss = total(terms.all)
            self.manual_backward(loss)
        seen = guide_samples(self.world.guide, terms.arrived)
        if self._others is not None:
            factor, seen = self._others.share(factor, seen)
        self._guard.check(batch, terms.all, lambda: self._terms(batch))
        if self.optimization.clip > 0:
            clip([optimizer.param_groups for optimizer in optimizers], self.optimization.clip)
        for name, optimizer in zip(self.optimizer_names, optimizers, strict=True):
            rate = factor * getattr(self.optimization, name)
            if name == "roughness":  # fewer positions a pixel leave its derivative, a product of two, that much noisier
                rate /= batch.pixel_multiplier**2
            for group in optimizer.param_groups:
                group["lr"] = rate
        for optimizer in optimizers[::-1]:  # the counted one last: its hook may end the epoch's bookkeeping
            optimizer.step()
        update_guide(self.world.guide, seen, self.iteration)
        self.iteration += 1
        if self.average is not None:
            self.average.update(self.iteration)
        passes = self.processes * (2 if self.settings.estimator == "two_pass" else 1)
        self.samples += passes * self._lanes(batch)
        self.last_losses = {name: loss.value for name, (_, loss) in terms.all.items()}
        return loss.detach()

    def _terms(self, batch: PixelBatch) -> StepTerms:
        """The terms of this iteration; the same ones whenever asked before the weights move."""
        assert self._step is not None
        return self._step(batch, Stream(self.seed, self.iteration, self.global_rank, 1, device=self.device))

    @property
    def train_seconds(self) -> float:
        """Seconds since the start of the process, evaluation left out, earlier runs of a continued one included."""
        return self.seconds_before + training_seconds()

    @property
    def rays(self) -> int:
        """Rays cast so far by training."""
        return self.rays_before + self.processes * self.world.tracer.rays_cast

    # ---- held-out views

    def evaluate(self, render_spp: int = 4, glossy: bool = False) -> Evaluation:
        """Score the present materials and radiance field on held-out views; its rays and seconds do not count."""
        if self._held_out is None:
            self._held_out = HeldOut(self.scene, self.world.geometry, self.world.tracer)
        with averaged(self.average), self.world.tracer.uncounted():
            if self._light is None and self.environment is not None:
                self._light = unknown_light(self.scene, self.environment, self._held_out)
            result = evaluate(self._held_out, self.estimator, render_spp, glossy, self._light, self.scene)
        self._guard.images(result.maps, [view.name for view in self._held_out.views])
        return result

    def validation_step(self, *_: Any) -> None:
        """Nothing a batch: the evaluation callback looks at all held-out views at once, after the loop."""

    test_step = predict_step = validation_step

    # ---- checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what continues a run exactly; plain types only."""
        checkpoint["neurad"] = {
            "scene": self.scene.name,
            "fingerprint": self.scene.fingerprint,
            "iteration": self.iteration,
            "seconds": self.train_seconds,
            "rays": self.rays,
            "samples": self.samples,
            "radiance_inputs": self._inputs,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that a checkpoint fits this scene and these sizes, and take over its counters.

        Raises:
            InputError: it belongs to another scene or to fields of other sizes, or it is none of neurad's.
        """
        state = fitting(checkpoint, self.state_dict(), self.scene, self._inputs)
        self.iteration = state["iteration"]
        self.rays_before = state["rays"]
        self.samples = state.get("samples", 0)
        self.seconds_before = state["seconds"]

    @property
    def _inputs(self) -> list[str] | None:
        """What the radiance field reads."""
        return None if self.radiance is None else list(self.radiance.inputs)


def _nothing() -> None:
    """Takes the place of a hook that must not count."""
