"""The Lightning module that recovers materials and light: an optimizer each, manual optimization."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor

from neurad.assembly.build import Assembly, FittedMaterials, assemble, pin_emitter_materials
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.relight import paths, sentence_of_light
from neurad.checkpoints.state import changed_light, fitted_lamps, fitting, scene_state
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.evidence.error_bars import ErrorBars
from neurad.fields.development import FittedDevelopment
from neurad.fields.radiance import RadianceField
from neurad.integrators.estimator import Estimator
from neurad.integrators.focus import PixelImportance
from neurad.integrators.world import World
from neurad.metrics.effort import EvaluationResolution
from neurad.optim.polyak_average import PolyakAverage
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.runtime.clock import excluded, processor_seconds, training_seconds
from neurad.scene.description import Scene
from neurad.scene.shining import Shining, kept
from neurad.scene.textures import TrueMaterials
from neurad.training.evaluate import Evaluation
from neurad.training.gradient_sync import GradientSync, ddp_ignored
from neurad.training.guard import Guard, keep_in_run_folder
from neurad.training.lit_scene import light_scene
from neurad.training.optimizers import make_optimizers
from neurad.training.schedule import Counters, fraction_done
from neurad.training.scoring import Scoring
from neurad.training.stages import LevelFilter
from neurad.training.step import TrainingStep
from neurad.training.training_views import TrainingViews, prepare_views


class InverseRenderer(L.LightningModule):
    """Recovers albedo and roughness, the environment's light, or both, from photographs of known geometry.

    The parts depend on the scene, so they are built in :meth:`configure_model`, from the data module's scene. What an
    iteration does stands in :class:`neurad.training.step.TrainingStep`.

    Args:
        settings: all under ``model``.
    """

    world: World
    materials: FittedMaterials | TrueMaterials
    average: PolyakAverage | None
    radiance: RadianceField | None
    focus: PixelImportance | None
    development: FittedDevelopment | None
    step: TrainingStep
    """Set when a fit starts."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.settings = settings
        self.counters = Counters()
        self.seconds_before = 0.0
        self.processor_before = 0.0, 0.0
        self.rays_before = 0
        self.processes = 1
        self._guard = Guard(self, self._keep)
        self.scoring = Scoring(self, self._guard)
        self.training_views: TrainingViews | None = None
        self.other_light: list[str] = []
        """What differs between the scene's light and that of the fit; nothing may in a fit that goes on."""
        self._shining: list[Shining] | None = None
        """Meshes that were found to shine; None where that is known."""
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

    @property
    def photographs(self) -> PhotoSource:
        """The photographs of the data module in charge."""
        source: PhotoSource = self.trainer.datamodule  # type: ignore[attr-defined]
        return source

    def configure_model(self) -> None:
        """Build world, materials and, for a method that reads it, the radiance field from the scene, once.

        Raises:
            InputError: the trainer's precision is one that light transport does not work in, or a lamp falls into too
                many parts.
        """
        if hasattr(self, "materials"):
            return
        if self.trainer.precision != "32-true":
            raise InputError(
                f"--trainer.precision {self.trainer.precision}: light needs float32; for networks there is "
                "model.optimization.matmul"
            )
        # The trainer would make tensors on the GPU; parts are made on the CPU, the same ones everywhere, then moved.
        with torch.device("cpu"):
            lit = light_scene(self.scene, self.photographs, self.settings, self.device, self.begins_from)
            self._shining = lit.found
            self._say(*lit.lines)
            if lit.scene is not self.scene:
                self.trainer.datamodule.relight(lit.scene)  # type: ignore[attr-defined]
            device = self.trainer.strategy.root_device
            made = assemble(self.scene, self.settings, self.photographs.has_alpha, device)
        # Of the world only a guide and an environment that is recovered have a state.
        self.world, self.materials, self.radiance = made.world, made.materials, made.radiance
        self.average, self.region, self.focus, self.development = (
            made.average, made.region, made.focus, made.development,
        )  # fmt: skip
        given = getattr(self.trainer.datamodule, "lamps_true", None)  # type: ignore[attr-defined]
        self.scoring.read_lamps_true(given, found=self._shining is not None)
        if self._exchanges:
            self._ddp_params_and_buffers_to_ignore = ddp_ignored(self)  # DDP's own name for it

    def _say(self, *lines: str) -> None:
        """Print lines, once for all processes."""
        if self.trainer.is_global_zero and lines:
            print(*(f"neurad: {line}" for line in lines), sep="\n", file=sys.stderr)

    @property
    def _exchanges(self) -> bool:
        """Whether DDP averages gradients, of several processes or of one alone."""
        return isinstance(self.trainer.strategy, DDPStrategy)

    @property
    def assembly(self) -> Assembly:
        """The parts of the run."""
        return Assembly(
            self.scene, self.settings, self.world, self.materials, self.radiance, self.average, self.region, self.focus,
            self.development,
        )  # fmt: skip

    @property
    def estimator(self) -> Estimator:
        """The method's estimates with the present materials and radiance field; under another light than that of the
        fit, whose radiance field and guide say nothing about it, paths are traced.
        """
        if self.other_light:
            self.world.guide = None
            return Estimator(self.world, self.materials, None, paths(self.scene))
        return Estimator(self.world, self.materials, self.radiance, self.settings.method)

    def configure_optimizers(self) -> list[SparseRowAdam | PyramidAdam]:
        """One optimizer each for what is not known: albedo, roughness (if there is one to find), the environment, and
        radiance (if the method reads it).
        """
        made = make_optimizers(self.assembly)
        self.optimizer_names = list(made)
        return list(made.values())

    def on_fit_start(self) -> None:
        """Trace the camera rays of the training views, take the unit of radiance, and make the step."""
        self.processes = self.trainer.world_size
        begins = self.iteration == 0
        if self.settings.materials == "fit" and self.scene.replaced:
            self._say(f"to be recovered as principled: {', '.join(self.scene.replaced)}")
        about = self.scene.scores_are_of, self.region.sentence(self.scene)
        self._say(*self.scene.notes, *filter(None, about))
        with self.world.tracer.uncounted(not begins):  # a continued run counted its camera rays when it began
            views = prepare_views(self.assembly, self.photographs, self.device, check_brightness=begins)
        if self._photographs not in (0, views.checksum):
            raise InputError(
                "--ckpt_path: the training photographs are not those that the run began with; put them back, or start "
                "a new run"
            )
        self._photographs = views.checksum
        self.training_views = views
        with excluded(), self.world.tracer.uncounted():
            self.scoring.restart(self.scoring.effort)
            self.scoring.held_out.read()
        self.step = TrainingStep(
            self.assembly,
            views,
            self.photographs,
            self._guard,
            self.counters,
            self.global_rank,
            self.processes,
            GradientSync(self, self._ddp_params_and_buffers_to_ignore) if self._exchanges else None,
            device=self.device,
        )

    def on_train_start(self) -> None:
        """Let the step use the trainer's optimizers."""
        self.step.optimizers = dict(zip(self.optimizer_names, self._optimizers(), strict=True))

    # ---- training

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        """One iteration of :class:`neurad.training.step.TrainingStep`."""
        for optimizer in self._optimizers()[1:]:  # the trainer counts the first one's steps: max_steps are iterations
            optimizer._on_before_step = optimizer._on_after_step = _nothing
        return self.step(batch, fraction_done(self.trainer), self.manual_backward)

    def _optimizers(self) -> list[Any]:
        """The optimizers in the trainer's wrappers."""
        found: Any = self.optimizers()
        return found if isinstance(found, list) else [found]

    def _keep(self, iteration: int, cause: str, batch: PixelBatch | None) -> str:
        return keep_in_run_folder(self._trainer, iteration, cause, batch)

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
    def train_seconds(self) -> float:
        """Seconds since the start of the process, evaluation left out, earlier runs of a continued one included."""
        return self.seconds_before + training_seconds()

    @property
    def processor_share(self) -> float:
        """Fraction of the processor time that the fit's threads asked for which they got, by the seconds in which they
        ran and in which they waited for others; 1 where the system does not tell.
        """
        used, waited = self._processor
        return used / (used + waited) if used > 0.0 else 1.0

    @property
    def _processor(self) -> tuple[float, float]:
        """Seconds in which the fit's threads ran and waited, earlier runs of a continued one included."""
        if self.training_views is None:  # not in a fit
            return self.processor_before
        (used, waited), (before, waited_before) = processor_seconds(), self.processor_before
        return used + before, waited + waited_before

    @property
    def rays(self) -> int:
        """Rays cast so far by training."""
        return self.rays_before + self.processes * self.world.tracer.rays_cast

    # ---- held-out views

    def evaluate(
        self, render_spp: int = 4, glossy: bool = False, steady: bool = False, bars: ErrorBars | None = None
    ) -> Evaluation:
        """Score held-out views, see :meth:`Scoring.evaluate`; in a fit what it would show if it ended now."""
        if hasattr(self, "step"):
            self.levels_found = LevelFilter.update(self.step, fraction_done(self.trainer))
        return self.scoring.evaluate(render_spp, glossy, steady, bars)

    def on_fit_end(self) -> None:
        """Evaluations after a fit look at everything."""
        if not self.scoring.effort.whole:
            self.scoring.restart(EvaluationResolution())

    def validation_step(self, *_: Any) -> None:
        """Nothing a batch: the evaluation callback looks at all held-out views at once, after the loop."""

    test_step = predict_step = validation_step

    # ---- checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what continues a run exactly; plain types only."""
        checkpoint["neurad"] = {
            **scene_state(self.scene),
            "iteration": self.iteration,
            "seconds": self.train_seconds,
            "processor_seconds": self._processor[0],
            "waited_seconds": self._processor[1],
            "rays": self.rays,
            "samples": self.samples,
            "radiance_inputs": self._inputs,
            "photographs": self._photographs,
            "hide_environment": self.world.hide_environment,
            **({} if self._shining is None else {"shining": kept(self._shining)}),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that a checkpoint fits this scene and these sizes, and take over its counters.

        Raises:
            InputError: it belongs to another scene or to fields of other sizes, or it is none of neurad's.
        """
        continues = self._trainer is None or self._trainer.state.fn == "fit"
        state = fitting(checkpoint, self.state_dict(), self.scene, self._inputs, continues=continues)
        self.counters.iteration = state["iteration"]
        self.counters.samples = state["samples"]
        self.rays_before = state["rays"]
        self.seconds_before = state["seconds"]
        self.processor_before = state["processor_seconds"], state["waited_seconds"]
        self._photographs = state["photographs"]
        if not continues:
            self._note_light_change(state)

    def _note_light_change(self, state: dict[str, Any]) -> None:
        """Take note of a light that is not that of the fit, and say so."""
        self.other_light = changed_light(
            state, self.scene, self.assembly.environment is None, self.assembly.lamps is None
        )
        if self.other_light:
            if isinstance(self.materials, FittedMaterials):
                pin_emitter_materials(self.materials, self.scene, self.world.geometry, fitted_lamps(state))
            print(f"neurad: {sentence_of_light(self.other_light)}", file=sys.stderr)

    @property
    def _inputs(self) -> list[str] | None:
        """What the radiance field reads."""
        return None if self.radiance is None else list(self.radiance.inputs)


def _nothing() -> None:
    """Takes the place of a hook that must not count."""
