"""The Lightning module that recovers materials and light: an optimizer each, manual optimization."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor

from neurad.assembly.build import Assembly, FittedMaterials, assemble, know_lamps
from neurad.assembly.common_causes import common_causes
from neurad.assembly.lighting import lit_scene
from neurad.assembly.relight import paths, sentence_of_light
from neurad.assembly.settings import Lighting, ModelSettings, Objective, Optimization, Sampling
from neurad.assembly.training_views import TrainingViews, prepare_views
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.ranges import Seed
from neurad.core.records import FloatArray, PixelBatch
from neurad.emitters.fitted import FittedEnvironment
from neurad.fields.development import FittedDevelopment
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import FieldConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.estimator import Estimator
from neurad.integrators.focus import Focus
from neurad.integrators.method import Method
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.world import World
from neurad.metrics.bar_maps import predict_bars
from neurad.metrics.effort import Effort
from neurad.metrics.error_bars import ErrorBars
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import albedo_factors
from neurad.metrics.lamp_scores import EXTRA, MISSED, lamp_scores, read_lamps_true
from neurad.metrics.lamp_scores import Array as FloatArray64
from neurad.metrics.view_residuals import view_residuals
from neurad.optim.polyak_average import PolyakAverage, averaged
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.runtime.clock import excluded, training_seconds
from neurad.scene.description import Scene
from neurad.scene.shining import Shining, kept
from neurad.scene.textures import TrueMaterials
from neurad.training.checkpoint import changed_light, fitted_lamps, fitting, scene_state
from neurad.training.closing_step import EVERY as CLOSING_EVERY
from neurad.training.closing_step import is_due as is_closing
from neurad.training.closing_step import make_closing_step, progress_before
from neurad.training.error_bars import error_bars
from neurad.training.evaluate import Evaluation, UnknownLight, evaluate, unknown_light
from neurad.training.gradient_sync import GradientSync, ddp_ignored
from neurad.training.guard import Guard, keep_in_run_folder
from neurad.training.objective import make_objective
from neurad.training.optimizers import make_optimizers
from neurad.training.schedule import Progress, fraction_done
from neurad.training.shining_meshes import shining_meshes
from neurad.training.step import Counters, TrainingStep
from neurad.training.validation import SETTLED, is_due, said, shrink_levels, update_levels


class InverseRenderer(L.LightningModule):
    """Recovers albedo and roughness, the environment's light, or both, from photographs of known geometry.

    The parts depend on the scene, so they are built in :meth:`configure_model`, from the data module's scene. What an
    iteration does stands in :class:`neurad.training.step.TrainingStep`.

    Args:
        albedo: size of the albedo field.
        roughness: size of the roughness field.
        radiance: size and inputs of the radiance field; a method without one leaves it out.
        sampling: numbers of samples.
        objective: terms of the loss.
        optimization: learning rates and schedule.
        tracer: what casts rays: ``embree``, ``open3d`` or ``warp``.
        seed: of every random decision of the training.
        method: how reflected light and its derivative are estimated; None is the paper's, one bounce and then the
            radiance field.
        lighting: what is known of the light.
        materials: ``fit`` recovers albedo and roughness, ``known`` takes the scene's own and trains no material.
    """

    world: World
    materials: FittedMaterials | TrueMaterials
    average: PolyakAverage | None
    radiance: RadianceField | None
    focus: Focus | None
    development: FittedDevelopment | None
    step: TrainingStep
    """Set when a fit starts."""

    def __init__(
        self,
        albedo: FieldConfig,
        roughness: RoughnessConfig,
        radiance: RadianceConfig,
        sampling: Sampling = Sampling(),
        objective: Objective = Objective(),
        optimization: Optimization = Optimization(),
        tracer: str = "embree",
        seed: Seed = 0,
        method: Method | None = None,
        lighting: Lighting = Lighting(),
        materials: Literal["fit", "known"] = "fit",
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        method = Radiometric() if method is None else method
        self.settings = ModelSettings(
            albedo, roughness, radiance, sampling, objective, optimization, lighting, method, materials, tracer, seed
        )
        self.counters = Counters()
        self.seconds_before = 0.0
        self.rays_before = 0
        self.processes = 1
        self._guard = Guard(self, self._keep)
        self._held_out: HeldOut | None = None
        self.effort = Effort()
        """Of evaluations: what of the held-out views they look at. Set before a fit starts."""
        self._light: UnknownLight | None = None
        self.training_views: TrainingViews | None = None
        self.other_light: list[str] = []
        """What differs between the scene's light and that of the fit; nothing may in a fit that goes on."""
        self._lamps_true: tuple[FloatArray64, int] | None = None
        self._shining: list[Shining] | None = None
        """Meshes that were found to shine; None where that is known."""
        self.begins_from: Path | None = None
        """The checkpoint that will be loaded; None in a fit from scratch."""
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
            if self.settings.lighting.emitters == "find":
                self._find_lamps()
            if (lit := lit_scene(self.scene, self.settings.lighting, self._shining)) is not self.scene:
                self.trainer.datamodule.relight(lit)  # type: ignore[attr-defined]
            device = self.trainer.strategy.root_device
            made = assemble(self.scene, self.settings, self.photographs.has_alpha, device)
        # Of the world only a guide and an environment that is recovered have a state.
        self.world, self.materials, self.average, self.radiance = (
            made.world,
            made.materials,
            made.average,
            made.radiance,
        )
        self.region, self.focus, self.development = made.region, made.focus, made.development
        self._lamps_true = self._read_lamps_true()
        if self._exchanges:
            self._ddp_params_and_buffers_to_ignore = ddp_ignored(self)  # DDP's own name for it

    def _find_lamps(self) -> None:
        """Find those meshes of the scene that photographs show to shine; in a run that goes on, those that it began
        with.
        """
        found = shining_meshes(self.scene, self.photographs, self.settings, self.device, self.begins_from)
        self._shining = found.lamps
        if self.trainer.is_global_zero and found.lines:
            print(*(f"neurad: {line}" for line in found.lines), sep="\n", file=sys.stderr)

    def _read_lamps_true(self) -> tuple[FloatArray64, int] | None:
        """What recovered lamps are scored against [m, 3], and how many others shine; None where nothing is given."""
        path = getattr(self.trainer.datamodule, "lamps_true", None)  # type: ignore[attr-defined]
        if path is None or (self.assembly.lamps is None and self._shining is None):
            return None
        wholes = {mesh.name: mesh.part_of for mesh in self.scene.meshes if mesh.part_of is not None}
        return read_lamps_true(path, self._lamp_names(), self._shining is not None, wholes)

    def _lamp_names(self) -> list[str]:
        """Of the lamps that are recovered."""
        lamps = self.assembly.lamps
        return [] if lamps is None else [self.scene.meshes[index].name for index in lamps.mesh.tolist()]

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

    @property
    def environment(self) -> FittedEnvironment | None:
        """The environment that is recovered; None where it is known."""
        return self.assembly.environment

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
        if self.settings.materials == "fit" and self.scene.replaced and self.trainer.is_global_zero:
            print(f"neurad: to be recovered as principled: {', '.join(self.scene.replaced)}", file=sys.stderr)
        notes = (*self.scene.notes, *filter(None, [self.scene.scores_are_of]))
        if self.trainer.is_global_zero and notes:
            print(*(f"neurad: {note}" for note in notes), sep="\n", file=sys.stderr)
        if self.trainer.is_global_zero and (left_out := self.region.sentence(self.scene)):
            print(f"neurad: {left_out}", file=sys.stderr)
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
            self._held_out = self._make_held_out().read()
        self.step = TrainingStep(
            self.assembly,
            make_objective(self.assembly, views),
            self._guard,
            self.counters,
            self.global_rank,
            self.processes,
            GradientSync(self, self._ddp_params_and_buffers_to_ignore) if self._exchanges else None,
            device=self.device,
            photographs=self.photographs,
            lamp_photographs=views.lamps,
        )

    def on_train_start(self) -> None:
        """Let the step use the trainer's optimizers."""
        self.step.optimizers = dict(zip(self.optimizer_names, self._optimizers(), strict=True))

    # ---- training

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        """One iteration of :class:`neurad.training.step.TrainingStep`."""
        for optimizer in self._optimizers()[1:]:  # the trainer counts the first one's steps: max_steps are iterations
            optimizer._on_before_step = optimizer._on_after_step = _nothing
        done, correction = fraction_done(self.trainer), self.assembly.correction
        progress = self._progress(done)
        loss = self.step(batch, progress, self.manual_backward)
        now = correction is not None and (self.processes == 1 or self.iteration % CLOSING_EVERY == 0)
        if now and self.trainer.strategy.broadcast(is_closing(correction, progress)):
            self.update_levels()  # noise that an albedo has copied hides what pixels say of the roughness
            self._make_closing_step(done.seconds_by_time)
        if progress < 1.0 and is_due(self.iteration):  # from then on rates are too low to bring signal back
            assert self.training_views is not None
            shrink_levels(self.assembly, self.training_views, self.photographs, self.iteration)
        return loss

    def update_levels(self) -> str | None:
        """Fit the factors of the levels to the training pixels that are never drawn, where there are some; returns a
        sentence on what was found.
        """
        if self.training_views is None:
            return None
        settled = self._progress(fraction_done(self.trainer)) >= SETTLED
        return said(update_levels(self.assembly, self.training_views, self.photographs, self.iteration, settled))

    def _progress(self, done: Progress) -> float:
        """What learning rates go by: 1 or more at the end of the fit, or from its closing step on."""
        if self.assembly.correction is None:
            return done.largest
        return progress_before(done, self.assembly.settings.roughness)

    def _make_closing_step(self, seconds: float | None) -> None:
        """Correct the roughness from all training pixels, see :mod:`neurad.training.closing_step`. The first process
        does it for all, within the ``seconds`` that are left.
        """
        correction = self.assembly.correction
        assert self.training_views is not None
        assert correction is not None
        if self.trainer.is_global_zero:
            found = make_closing_step(
                self.assembly, self.training_views, self.photographs, self.counters, self.processes, seconds
            )
            if found is not None:
                print(f"neurad: {found.sentence()}", file=sys.stderr)
        state = {name: value.cpu() for name, value in correction.state_dict().items()}
        state = self.trainer.strategy.broadcast(state)
        correction.load_state_dict(state)

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
    def rays(self) -> int:
        """Rays cast so far by training."""
        return self.rays_before + self.processes * self.world.tracer.rays_cast

    # ---- held-out views

    def evaluate(
        self, render_spp: int = 4, glossy: bool = False, steady: bool = False, bars: ErrorBars | None = None
    ) -> Evaluation:
        """Score the present materials and radiance field on held-out views; its rays and seconds do not count.

        The arguments are those of :func:`neurad.training.evaluate.evaluate`.
        """
        if self._held_out is None:
            self._held_out = self._make_held_out()
        self._held_out.respond = None if self.development is None else self.development.respond
        with averaged(self.average), self.world.tracer.uncounted():
            if self._light is None and self.environment is not None:
                self._light = unknown_light(self.scene, self.environment, self._held_out)
            result = evaluate(self._held_out, self.estimator, render_spp, glossy, self._light, self.scene, steady, bars)
            result.scores.update(self._lamp_scores(result))
        self._guard.images(self.iteration, result.maps, [view.name for view in self._held_out.views])
        return result

    def _lamp_scores(self, found: Evaluation) -> dict[str, float]:
        """Errors of lamps that are recovered, where the truth is given."""
        lamps = self.assembly.lamps
        if self._lamps_true is None or self._held_out is None:
            return {}
        truth, missed = self._lamps_true
        if lamps is None:  # none was found
            return {MISSED: float(missed), EXTRA: 0.0}
        factors = albedo_factors(self._held_out, found.maps) if lamps.values.requires_grad else {}
        scores = lamp_scores(lamps.found(), truth, self._lamp_names(), factors)
        if self._shining is not None:
            scores |= {MISSED: float(missed), EXTRA: float((~truth.any(-1)).sum())}
        return scores

    def error_bars(self) -> ErrorBars | None:
        """Error bars of the present materials, see :func:`neurad.training.error_bars.error_bars`.

        Raises:
            InputError: outside of a fit the training photographs are read for it, and one is missing or wrong; or they
                are of another light.
        """
        if self.other_light:
            raise InputError("they are those of the light of the fit, which is another one here")
        views = self.training_views
        # The trainer tests in inference mode, in which nothing can be differentiated.
        with torch.inference_mode(False), torch.no_grad(), averaged(self.average):
            if views is None:
                with self.world.tracer.uncounted():
                    views = prepare_views(self.assembly, self.photographs, self.device, check_brightness=False)
            return error_bars(self.assembly, views, self.photographs, self.counters)

    def bar_maps(self, bars: ErrorBars) -> list[dict[str, FloatArray]]:
        """``albedo_std`` and ``roughness_std`` of the held-out views, see :func:`predict_bars`."""
        if self._held_out is None:
            self._held_out = self._make_held_out()
        assert isinstance(self.materials, FittedMaterials)
        with averaged(self.average), self.world.tracer.uncounted():
            return predict_bars(self._held_out, bars, self.materials)

    def _make_held_out(self) -> HeldOut:
        """The held-out views, as much of them as evaluations look at."""
        grid, stride = self.effort.grid, self.effort.stride
        return HeldOut(self.scene, self.world.geometry, self.world.tracer, grid, stride)

    def on_fit_end(self) -> None:
        """Evaluations after a fit look at everything."""
        if not self.effort.whole:
            self.effort, self._held_out, self._light = Effort(), None, None

    def validation_step(self, *_: Any) -> None:
        """Nothing a batch: the evaluation callback looks at all held-out views at once, after the loop."""

    test_step = predict_step = validation_step

    def view_residuals(self) -> FloatArray | None:
        """How far each training photograph is from what is recovered [views], see :func:`view_residuals`; its rays and
        seconds do not count. None outside of a fit.
        """
        views = self.training_views
        if views is None or views.sample is None:
            return None
        with averaged(self.average):
            sample = views.sample if self.development is None else self.development(views.sample)
            return view_residuals(self.estimator, views.primary, sample, self.settings.seed)

    def common_causes(self) -> list[str]:
        """What is wrong with all training photographs, see :mod:`neurad.assembly.common_causes`; its rays do not count.
        Nothing outside of a fit.
        """
        views = self.training_views
        if views is None:
            return []
        if views.causes is not None:
            return views.causes
        cameras = [view.camera for view in self.scene.train]
        given = self.world, cameras, self.photographs, self.settings.seed, self.development
        return common_causes(*given, scale_known=views.scale_known)

    # ---- checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what continues a run exactly; plain types only."""
        checkpoint["neurad"] = {
            **scene_state(self.scene),
            "iteration": self.iteration,
            "seconds": self.train_seconds,
            "rays": self.rays,
            "samples": self.samples,
            "radiance_inputs": self._inputs,
            "photographs": self._photographs,
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
        self.counters.samples = state.get("samples", 0)
        self.rays_before = state["rays"]
        self.seconds_before = state["seconds"]
        self._photographs = state.get("photographs", 0)
        if not continues:
            self._see_light(state)

    def _see_light(self, state: dict[str, Any]) -> None:
        """Take note of a light that is not that of the fit, and say so."""
        self.other_light = changed_light(state, self.scene, self.environment is None, self.assembly.lamps is None)
        if self.other_light:
            if isinstance(self.materials, FittedMaterials):
                know_lamps(self.materials, self.scene, self.world.geometry, fitted_lamps(state))
            print(f"neurad: {sentence_of_light(self.other_light)}", file=sys.stderr)

    @property
    def _inputs(self) -> list[str] | None:
        """What the radiance field reads."""
        return None if self.radiance is None else list(self.radiance.inputs)


def _nothing() -> None:
    """Takes the place of a hook that must not count."""
