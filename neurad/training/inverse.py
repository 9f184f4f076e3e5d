"""The Lightning module that recovers materials and light: an optimizer each, manual optimization."""

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor

from neurad.assembly.build import Assembly, assemble
from neurad.assembly.left_out import without_surfaces
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.relight import in_other_light, sentence_of_light
from neurad.checkpoints.state import changed_light, check_photographs, fitted_lamps, fitting, scene_state
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.evidence.error_bars import ErrorBars
from neurad.metrics.effort import EvaluationResolution
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.runtime.clock import excluded
from neurad.scene.description import Scene
from neurad.scene.shining import Shining, shining_state
from neurad.tracing.select import tracer_for
from neurad.training.evaluate import Evaluation
from neurad.training.gradient_sync import GradientSync, ddp_ignored
from neurad.training.guard import Guard, keep_in_run_folder
from neurad.training.optimizers import make_optimizers
from neurad.training.prepared_scene import Poses, prepare_scene
from neurad.training.schedule import Counters, Spent, fraction_done
from neurad.training.scoring import Scoring
from neurad.training.stages import show_levels
from neurad.training.step import TrainingStep
from neurad.training.training_views import TrainingViews, prepare_views


class InverseRenderer(L.LightningModule):
    """Recovers albedo and roughness, the environment's light, or both, from photographs of known geometry.

    The parts depend on the scene, so they are built in :meth:`configure_model`, from the data module's scene. What an
    iteration does stands in :class:`neurad.training.step.TrainingStep`.
    """

    assembly: Assembly
    """The parts of the run, set when the model is configured."""
    step: TrainingStep
    """Set when a fit starts."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.settings = settings
        self.counters = Counters()
        self.spent = Spent()
        self.processes = 1
        self._guard = Guard(self, lambda *bad: keep_in_run_folder(self._trainer, *bad))
        self.scoring = Scoring(self, self._guard)
        self.training_views: TrainingViews | None = None
        self.other_light: list[str] = []
        """What differs between the scene's light and that of the fit; nothing may in a fit that goes on."""
        self._fitted_lamps: frozenset[int] = frozenset()
        """Meshes that shone in the fit of the checkpoint."""
        self._shining: list[Shining] | None = None
        """Meshes that were found to shine; None where that is known."""
        self._poses: Poses | None = None
        """Refined poses of the training views; None where they are those of the scene's file."""
        self._said_of_poses: list[str] = []
        """What a fit says of them where it begins."""
        self.begins_from: Path | None = None
        """The checkpoint that will be loaded; None in a fit from scratch."""
        self.levels_found: str | None = None
        """What the last evaluation of a fit found of noise in the levels of the fields, in words."""
        self._photographs = 0
        """Checksum of the photographs; 0 before they are read, and where they cannot change."""

    # ---- set-up

    @property
    def scene(self) -> Scene:
        """The scene of the data module in charge."""
        scene: Scene = self.trainer.datamodule.scene  # type: ignore[attr-defined]
        return scene

    def _relight(self, scene: Scene) -> None:
        """Let the data module in charge have another scene of the same views and triangles."""
        if scene is not self.scene:
            self.trainer.datamodule.relight(scene)  # type: ignore[attr-defined]

    @property
    def photographs(self) -> PhotoSource:
        """The photographs of the data module in charge."""
        source: PhotoSource = self.trainer.datamodule  # type: ignore[attr-defined]
        return source

    def configure_model(self) -> None:
        """Build world, materials and, for a method that reads it, the radiance field from the scene, once.

        Raises:
            InputError: a lamp falls into too many parts.
        """
        if hasattr(self, "assembly"):
            return
        device = self.trainer.strategy.root_device
        self.settings = replace(self.settings, tracer=tracer_for(self.settings.tracer, device))
        # The trainer would make tensors on the GPU; parts are made on the CPU, the same ones everywhere, then moved.
        with torch.device("cpu"):
            self._relight(without_surfaces(self.scene))
            found = prepare_scene(self.scene, self.photographs, self.settings, self.device, self.begins_from)
            _say(self.trainer, *found.said_of_lamps)
            self._shining, self._poses, self._said_of_poses = found.shining, found.poses, found.said_of_poses
            self._relight(found.scene)
            fits = self.trainer.state.fn == "fit"
            self.assembly = assemble(self.scene, self.settings, self.photographs.has_alpha, device, fits=fits)
        if self.scene.hints.one_material and self.assembly.hierarchy is None and self.assembly.metalness is None:
            _say(self.trainer, _NO_GROUPS)
        for name, part in self.assembly.modules():  # under these names a checkpoint has their states
            self.add_module(name, part)
        lamps_true = getattr(self.trainer.datamodule, "lamps_true", None)  # type: ignore[attr-defined]
        self.scoring.read_lamps_true(lamps_true, found=self._shining is not None)
        if self._exchanges:
            self._ddp_params_and_buffers_to_ignore = ddp_ignored(self)  # DDP's own name for it

    @property
    def _exchanges(self) -> bool:
        """Whether DDP averages gradients, of several processes or of one alone."""
        return isinstance(self.trainer.strategy, DDPStrategy)

    def configure_optimizers(self) -> list[SparseRowAdam | PyramidAdam]:
        """One optimizer each for what is not known: albedo, roughness (if there is one to find), the environment, and
        radiance (if the method reads it).
        """
        made = make_optimizers(self.assembly)
        self.optimizer_names = list(made)
        return list(made.values())

    def setup(self, stage: str) -> None:
        """A fit's own seconds count."""
        self.spent.counts |= stage == "fit"

    def on_fit_start(self) -> None:
        """Trace the camera rays of the training views, take the unit of radiance, and make the step."""
        self.processes = self.trainer.world_size
        begins, tracer = self.iteration == 0, self.assembly.world.tracer
        _say(self.trainer, *self.assembly.notes())
        with tracer.uncounted(not begins):  # a continued run counted its camera rays when it began
            views = prepare_views(self.assembly, self.photographs, check_brightness=begins)
        check_photographs(self._photographs, views.checksum)
        self._photographs = views.checksum
        self.training_views = views
        with excluded(), tracer.uncounted():
            self.scoring.restart(self.scoring.effort)
            self.scoring.held_out.read()
            self.scoring.find_paint(False)
        _say(self.trainer, *self._said_of_poses)
        self.step = TrainingStep(
            self.assembly,
            views,
            self.photographs,
            self._guard,
            self.counters,
            self.global_rank,
            self.processes,
            GradientSync(self, self._ddp_params_and_buffers_to_ignore) if self._exchanges else None,
        )

    def on_train_start(self) -> None:
        """Let the step use the optimizers, which the trainer has loaded."""
        inner = (optimizer.optimizer for optimizer in self._optimizers())
        self.step.optimizers = dict(zip(self.optimizer_names, inner, strict=True))

    # ---- training

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        """One iteration of :class:`neurad.training.step.TrainingStep`."""
        loss = self.step(batch, fraction_done(self.trainer), self.manual_backward)
        for optimizer in self._optimizers()[:1]:  # the trainer counts its steps: max_steps are iterations
            optimizer._on_before_step()
            optimizer._on_after_step()
        return loss

    def _optimizers(self) -> list[Any]:
        found: Any = self.optimizers()
        return found if isinstance(found, list) else [found]

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.counters.iteration

    @property
    def samples(self) -> int:
        """Path samples drawn so far by training."""
        return self.counters.samples

    @property
    def last_losses(self) -> dict[str, Tensor]:
        """Values of the last step's losses by name; none before the first."""
        return self.step.losses if hasattr(self, "step") else {}

    @property
    def rays(self) -> int:
        """Rays cast so far by training."""
        return self.spent.rays_before + self.processes * self.assembly.world.tracer.rays_cast

    # ---- held-out views

    def evaluate(
        self, render_spp: int = 4, glossy: bool = False, steady: bool = False, bars: ErrorBars | None = None
    ) -> Evaluation:
        """Score held-out views, see :meth:`Scoring.evaluate`; in a fit what it would show if it ended now."""
        if hasattr(self, "step"):
            progress = fraction_done(self.trainer)
            self.levels_found = show_levels(self.step, progress)
            self.scoring.find_paint(progress.largest >= 1.0)
        return self.scoring.evaluate(render_spp, glossy, steady, bars)

    def on_test_start(self) -> None:
        """Trace paths under another light than that of the fit: its radiance field and guide say nothing about it."""
        if self.other_light:
            self.assembly = in_other_light(self.assembly, self._fitted_lamps)

    on_validation_start = on_predict_start = on_test_start

    def on_fit_end(self) -> None:
        """Evaluations after a fit look at everything."""
        if not self.scoring.effort.whole:
            self.scoring.restart(EvaluationResolution())

    def validation_step(self, *_: Any) -> None:
        """Nothing a batch: the evaluation callback looks at all held-out views at once, after the loop."""

    test_step = predict_step = validation_step

    # ---- checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what continues a run exactly; plain types only. Nothing that is not finite is kept."""
        if hasattr(self, "step"):
            self.step.check()
        checkpoint["neurad"] = {
            **scene_state(self.scene),
            **asdict(self.counters),
            **self.spent.state(),
            "rays": self.rays,
            "radiance_inputs": self.assembly.radiance_inputs,
            "photographs": self._photographs,
            "hide_environment": self.assembly.world.hide_environment,
            **({} if self._shining is None else {"shining": shining_state(self._shining)}),
            **({} if self._poses is None else {"poses": self._poses}),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that a checkpoint fits this scene and these sizes, and take over its counters.

        Raises:
            InputError: it belongs to another scene or to fields of other sizes, or it is none of neurad's.
        """
        continues = self._trainer is None or self._trainer.state.fn == "fit"
        inputs = self.assembly.radiance_inputs
        state = fitting(checkpoint, self.state_dict(), self.scene, inputs, continues=continues)
        if "poses" in state and self._poses is None:
            raise InputError("--ckpt_path: the run's poses were refined; go on with --data.poses refine")
        self.counters.iteration = state["iteration"]
        self.counters.samples = state["samples"]
        self.spent.continue_from(state)
        self._photographs = state["photographs"]
        if not continues:
            known = self.assembly.environment is None, self.assembly.lamps is None
            self.other_light = changed_light(state, self.scene, *known)
            self._fitted_lamps = fitted_lamps(state)
            if self.other_light:
                _say(self.trainer, sentence_of_light(self.other_light))


_NO_GROUPS = (
    "warning: one_material of the hints changes nothing here, as neither roughness nor metalness of groups of surfaces "
    "is recovered (model.roughness.structure, model.metallic.recover)"
)


def _say(trainer: L.Trainer, *lines: str) -> None:
    if trainer.is_global_zero and lines:
        print(*(f"neurad: {line}" for line in lines), sep="\n", file=sys.stderr)
