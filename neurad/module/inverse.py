"""The Lightning module that recovers materials: three optimizers, manual optimization, routed gradients."""

from __future__ import annotations

import math
from typing import Any

import lightning as L
import torch
from torch import Tensor

from neurad.core.clock import training_seconds
from neurad.core.errors import InputError
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.fields.adam import FieldAdam
from neurad.fields.settings import FieldConfig, RadianceConfig
from neurad.integrators.world import World
from neurad.losses.relative import total
from neurad.metrics.held_out import HeldOut
from neurad.module.assemble import FittedMaterials, build_materials, build_radiance, build_world
from neurad.module.config import Objective, Optimization, Sampling
from neurad.module.estimate import Estimator
from neurad.module.evaluate import Evaluation, evaluate
from neurad.module.objective import ObjectiveStep
from neurad.module.primary import PrimaryHits
from neurad.module.schedule import fraction_done, rate_factor
from neurad.scene.description import Scene

OPTIMIZERS = ("albedo", "roughness", "radiance")


class InverseRenderer(L.LightningModule):
    """Recovers albedo and roughness from photographs under known geometry and light (AD-Ours, k = 1).

    The parts depend on the scene, so they are built in :meth:`configure_model`, from the data module's scene.

    Args:
        albedo: size of the albedo field.
        roughness: size of the roughness field.
        radiance: size and inputs of the radiance field.
        sampling: random decisions a pixel.
        objective: terms of the loss.
        optimization: learning rates and schedule.
        tracer: 'embree' or 'open3d'.
        seed: of every random decision of the training.
    """

    materials: FittedMaterials
    world: World

    def __init__(
        self,
        albedo: FieldConfig,
        roughness: FieldConfig,
        radiance: RadianceConfig,
        sampling: Sampling = Sampling(),
        objective: Objective = Objective(),
        optimization: Optimization = Optimization(),
        tracer: str = "embree",
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.field_configs = (albedo, roughness, radiance)
        self.sampling = sampling
        self.settings = objective
        self.optimization = optimization
        self.tracer = tracer
        self.seed = seed
        self.iteration = 0
        self.seconds_before = 0.0
        self.rays_before = 0
        self.last_losses: dict[str, Tensor] = {}
        self._step: ObjectiveStep | None = None
        self._held_out: HeldOut | None = None
        if (objective.estimator != "two_pass" or objective.lhs > 0) and sampling.positions < 2:
            raise InputError("model.sampling.positions: leave_one_out and lhs need at least 2 positions a pixel")
        if sampling.positions > sampling.cached:
            raise InputError("model.sampling.cached: it must be at least model.sampling.positions")

    # ---- set-up

    @property
    def scene(self) -> Scene:
        """The scene of the data module in charge."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    def configure_model(self) -> None:
        """Build world, materials and radiance field from the scene, once."""
        if hasattr(self, "materials"):
            return
        torch.manual_seed(self.seed)
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        world = build_world(self.scene, self.tracer, hide_environment=data.has_alpha)
        # The world is no part of the checkpoint: it has no parameters and its buffers are not persistent.
        self.world = world
        albedo, roughness, radiance = self.field_configs
        self.materials = build_materials(self.scene, albedo, roughness)
        self.radiance = build_radiance(self.scene, radiance)

    def configure_optimizers(self) -> list[FieldAdam]:
        """One optimizer each for albedo, roughness (if there is one to find) and radiance."""
        parts = {"albedo": self.materials.albedo, "roughness": self.materials.roughness, "radiance": self.radiance}
        self.optimizer_names = [name for name in OPTIMIZERS if parts[name] is not None]
        return [
            FieldAdam(parts[name].parameters(), lr=getattr(self.optimization, name))  # type: ignore[union-attr]
            for name in self.optimizer_names
        ]

    def on_fit_start(self) -> None:
        """Trace the camera rays of the training views, and take the units of light from the photographs."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        cameras = [view.camera for view in self.scene.train]
        primary = PrimaryHits(self.world, cameras, self.sampling.cached, self.seed, self.device)
        mixed = primary.sees_emitter()
        if self.iteration > 0:  # the camera rays of a continued run were counted when it began
            self.world.rays_cast = 0
        mean_square = data.mean_square(~mixed.cpu())
        if mean_square <= 0:
            raise InputError(f"scene {self.scene.name}: every training photograph is black")
        self.radiance.set_scale(math.sqrt(mean_square))
        self._held_out = HeldOut(self.scene, self.world.geometry, self.world.tracer).read()
        self._step = ObjectiveStep(
            estimator=self.estimator,
            primary=primary,
            sampling=self.sampling,
            settings=self.settings,
            epsilon=self.settings.epsilon * mean_square,
            mixed=mixed,
        )

    @property
    def estimator(self) -> Estimator:
        """Estimates of one bounce with the present materials and radiance field."""
        return Estimator(self.world, self.materials, self.radiance)

    # ---- training

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        """One iteration: one backward pass whose gradients never meet, three optimizer steps."""
        assert self._step is not None
        optimizers = self.optimizers()
        assert isinstance(optimizers, list)
        factor = rate_factor(self.optimization, self.iteration, fraction_done(self.trainer).largest)
        for index, (name, optimizer) in enumerate(zip(self.optimizer_names, optimizers, strict=True)):
            for group in optimizer.param_groups:
                group["lr"] = factor * getattr(self.optimization, name)
            optimizer.zero_grad()
            if index > 0:  # the trainer counts steps of the first optimizer only, so max_steps means iterations
                optimizer._on_before_step = _nothing
                optimizer._on_after_step = _nothing
        stream = Stream(self.seed, self.iteration, self.global_rank, 1, device=self.device)
        terms = self._step(batch, stream)
        loss = total(terms.materials | terms.field)
        self.manual_backward(loss)
        for optimizer in optimizers[::-1]:  # the counted one last: its hook may end the epoch's bookkeeping
            optimizer.step()
        self.iteration += 1
        self.last_losses = {name: loss.value for name, (_, loss) in (terms.materials | terms.field).items()}
        return loss.detach()

    @property
    def train_seconds(self) -> float:
        """Seconds since the start of the process, evaluation left out, earlier runs of a continued one included."""
        return self.seconds_before + training_seconds()

    @property
    def rays(self) -> int:
        """Rays cast so far by training."""
        return self.rays_before + self.world.rays_cast

    # ---- held-out views

    def evaluate(self, render_spp: int = 4, glossy: bool = False) -> Evaluation:
        """Score the present materials and radiance field on held-out views; its rays and seconds do not count."""
        if self._held_out is None:
            self._held_out = HeldOut(self.scene, self.world.geometry, self.world.tracer)
        cast = self.world.rays_cast
        result = evaluate(self._held_out, self.estimator, render_spp, glossy)
        self.world.rays_cast = cast
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
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that a checkpoint fits this scene and these sizes, and take over its counters.

        Raises:
            InputError: it belongs to another scene or to fields of other sizes, or it is none of neurad's.
        """
        state = checkpoint.get("neurad")
        if state is None:
            raise InputError("--ckpt_path: the file is no checkpoint of neurad")
        if state["fingerprint"] != self.scene.fingerprint:
            raise InputError(
                f"--ckpt_path: the checkpoint is of scene {state['scene']}, not of {self.scene.name} as given"
            )
        own = self.state_dict()
        for name, value in checkpoint["state_dict"].items():
            if name not in own or own[name].shape != value.shape:
                raise InputError(f"--ckpt_path: the checkpoint has other field sizes than the config ({name} differs)")
        if missing := own.keys() - checkpoint["state_dict"].keys():
            raise InputError(
                f"--ckpt_path: the checkpoint has other fields than the config ({min(missing)} is missing)"
            )
        self.iteration = state["iteration"]
        self.rays_before = state["rays"]
        self.seconds_before = state["seconds"]


def _nothing() -> None:
    """Takes the place of a hook that must not count."""
