"""Scores and pictures on held-out views: when they are taken, and where they go."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.loggers import TensorBoardLogger

from neurad.callbacks import pictures
from neurad.callbacks.run_folder import run_folder
from neurad.callbacks.table import MetricsTable, curve_table, score_table
from neurad.callbacks.training_views import ViewTable
from neurad.core.errors import InputError
from neurad.core.ranges import Count, CountOrZero, NonNegative, checked
from neurad.metrics.bars_file import NAME, read_bars, write_bars
from neurad.metrics.effort import affordable
from neurad.metrics.limits import sentence_of_limits
from neurad.runtime import clock
from neurad.runtime.files import write_text
from neurad.training.schedule import fraction_done, time_limit

if TYPE_CHECKING:
    from neurad.metrics.error_bars import ErrorBars
    from neurad.training.evaluate import Evaluation
    from neurad.training.inverse import InverseRenderer

MARKS = 20
"""Evaluations in a run, if the allowed fraction of time is enough for them."""


class Evaluate(pl.Callback):
    """Evaluates on the held-out views: during a fit, at its end, and for ``validate``, ``test`` and ``predict``.

    A run that only ``max_steps`` limits evaluates every ``max_steps // 20`` iterations, so that it is repeatable. One
    limited by time evaluates at every twentieth of its length, as long as that keeps to ``fraction``. Large held-out
    views are then scored at fewer positions in a pixel and in fewer pixels, see :mod:`neurad.metrics.effort`.

    Args:
        fraction: largest fraction of the training time that evaluations during the fit may take.
        every_n_steps: evaluate at multiples of this many iterations instead, whatever it costs.
        spp: samples per pixel of the renderings scored during ``fit`` and ``validate``.
        test_spp: samples per pixel of the renderings that ``test`` and ``predict`` write.
        pictures: held-out views that TensorBoard shows.
        log_every_n_steps: iterations between two points of the loss curves.
    """

    def __init__(
        self,
        fraction: NonNegative = 0.1,
        every_n_steps: Count | None = None,
        spp: Count = 4,
        test_spp: Count = 64,
        pictures: CountOrZero = 4,
        log_every_n_steps: Count = 50,
    ) -> None:
        super().__init__()
        self.fraction = fraction
        self.every_n_steps = every_n_steps
        self.spp = spp
        self.test_spp = test_spp
        self.pictures = pictures
        self.log_every_n_steps = log_every_n_steps
        checked(self)
        self.last_scores: dict[str, float] = {}
        self._spent = 0.0
        self._last = 0.0
        self._mark = 0
        self._evaluated = -1
        self._views: ViewTable | None = None

    def state_dict(self) -> dict[str, Any]:
        """Seconds and marks so far: a continued run keeps to its fraction of time."""
        return {"spent": self._spent, "last": self._last, "mark": self._mark, "evaluated": self._evaluated}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the state of the interrupted run."""
        self._spent, self._last = float(state_dict["spent"]), float(state_dict["last"])
        self._mark, self._evaluated = int(state_dict["mark"]), int(state_dict["evaluated"])

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Decide how much of large held-out views evaluations look at: all ones of a run at the same pixels."""
        module = cast("InverseRenderer", pl_module)
        views = module.scene.scored
        if self.every_n_steps is not None or not views:
            return
        module.effort = affordable(views, self.spp, self.fraction, time_limit(trainer))
        if not module.effort.whole and trainer.is_global_zero:
            grid, stride = module.effort.grid, module.effort.stride
            size = sum(view.camera.width * view.camera.height for view in views) / 1e6
            pixels = f"one row and column in {stride}" if stride > 1 else "all"
            print(
                f"neurad: the held-out views have {size:.3g} million pixels: evaluations during the fit score "
                f"{pixels}, at {grid**2} positions a pixel (a larger --evaluation.fraction allows more); "
                "`neurad test` scores all",
                file=sys.stderr,
            )

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Log losses, and evaluate if it is time."""
        module = cast("InverseRenderer", pl_module)
        if module.iteration % self.log_every_n_steps == 0:
            self._log_losses(trainer, module)
        if trainer.strategy.broadcast(self._due(trainer, module)):
            self._evaluate_fit(trainer, module)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The scores that belong to the last checkpoint."""
        module = cast("InverseRenderer", pl_module)
        sentence = module.update_levels() if module.iteration > 0 else None
        if sentence and trainer.is_global_zero:
            print(f"neurad: {sentence}", file=sys.stderr)
        if self._evaluated != module.iteration:
            self._evaluate_fit(trainer, module)
        with clock.excluded():
            if trainer.is_global_zero and run_folder(trainer) is not None:
                self._show_bars(trainer, module)
            trainer.strategy.barrier("error bars")

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print the closing table."""
        folder, module = run_folder(trainer), cast("InverseRenderer", pl_module)
        rows = MetricsTable(folder / "metrics.csv").rows() if folder else []
        scores = rows[-1] if rows else self.last_scores
        if trainer.is_global_zero and scores:
            table = _table(module, scores, self.spp, steady=True)
            print("\n" + "\n\n".join(t for t in (table, curve_table(rows)) if t))
            if said := sentence_of_limits(scores):
                print(f"\nneurad: {said}")
            if folder:
                print(f"\nneurad: run folder {folder}")

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """``neurad validate``: print the scores."""
        if trainer.is_global_zero:
            module = cast("InverseRenderer", pl_module)
            print(_table(module, module.evaluate(self.spp, steady=True).scores, self.spp, steady=True))

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """``neurad test``: write every held-out view and the scores."""
        if not trainer.is_global_zero:
            return
        module = cast("InverseRenderer", pl_module)
        folder = run_folder(trainer)
        evaluation = module.evaluate(self.test_spp, glossy=True, bars=error_bars_of(module, folder))
        print(_table(module, evaluation.scores, self.test_spp))
        if folder is not None:
            pictures.write_views(folder / "images", evaluation.maps, evaluation.environment)
            about = {"iteration": module.iteration, "seconds": round(module.seconds_before, 2), "rays": module.rays}
            about["samples"] = module.samples
            scores = {key: _json_number(value) for key, value in evaluation.scores.items()}
            text = json.dumps({**about, "render_spp": self.test_spp, **scores}, indent=2)
            write_text(folder / "metrics.json", text + "\n")
            print(f"\nneurad: images and metrics.json are in {folder}")

    def on_predict_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """``neurad predict``: write every held-out view, without scores."""
        if not trainer.is_global_zero:
            return
        evaluation = cast("InverseRenderer", pl_module).evaluate(self.test_spp)
        folder = run_folder(trainer)
        if folder is not None:
            pictures.write_views(folder / "images", evaluation.maps, evaluation.environment)
            print(f"neurad: images are in {folder / 'images'}")

    def _due(self, trainer: pl.Trainer, module: InverseRenderer) -> bool:
        every = self.every_n_steps
        if every is None and trainer.max_steps > 0 and fraction_done(trainer).by_time is None:
            every = max(trainer.max_steps // MARKS, 1)
        if every is not None:
            return bool(module.iteration % every == 0)
        mark = int(fraction_done(trainer).largest * MARKS)
        if mark <= self._mark or self.fraction <= 0:
            return False
        self._mark = mark
        return bool(self._spent + self._last <= self.fraction * module.train_seconds)

    def _evaluate_fit(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        begin = time.monotonic()
        with clock.excluded():
            self._evaluated = module.iteration
            if trainer.is_global_zero:
                evaluation = module.evaluate(self.spp, steady=True)
                self.last_scores = dict(evaluation.scores)
                self._record(trainer, module, evaluation.scores, evaluation.maps)
                self._preview(trainer, module, evaluation)
                self._check_views(trainer, module)
            trainer.strategy.barrier("evaluation")
        taken = time.monotonic() - begin
        self._spent += taken
        self._last = taken  # the first one also fills caches, so it is no forecast

    def _record(
        self, trainer: pl.Trainer, module: InverseRenderer, scores: Mapping[str, float], maps: list[dict[str, Any]]
    ) -> None:
        """A row of metrics.csv, and the page in TensorBoard."""
        folder = run_folder(trainer)
        if folder is None:
            return
        spent = {"seconds": module.train_seconds, "rays": module.rays, "samples": module.samples}
        row = {"iteration": module.iteration, **spent, **scores}
        MetricsTable(folder / "metrics.csv").append(row)
        if not isinstance(trainer.logger, TensorBoardLogger):
            return
        writer = trainer.logger.experiment
        for name, value in scores.items():
            writer.add_scalar(f"{_group(name)}/{name}", value, module.iteration)
            writer.add_scalar(f"{_group(name)}_by_seconds/{name}", value, int(module.train_seconds))
        exposure = pictures.exposure(maps)
        for index, view in enumerate(maps[: self.pictures]):
            for name, picture in pictures.pages(view, exposure).items():
                label = f"{name}/{pictures.view_name(view, index)}"
                writer.add_image(label, picture, module.iteration, dataformats="HWC")
        writer.flush()

    def _preview(self, trainer: pl.Trainer, module: InverseRenderer, evaluation: Evaluation) -> None:
        """The environment map that is recovered, above the true one, in TensorBoard."""
        if evaluation.environment and isinstance(trainer.logger, TensorBoardLogger):
            picture = pictures.environment(evaluation.environment, pictures.exposure(evaluation.maps))
            trainer.logger.experiment.add_image("environment", picture, module.iteration, dataformats="HWC")

    def _show_bars(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        """The error bars of the final materials, into the run folder and TensorBoard."""
        bars = error_bars_of(module, run_folder(trainer))
        if bars is None or not isinstance(trainer.logger, TensorBoardLogger):
            return
        for index, view in enumerate(module.bar_maps(bars)[: self.pictures]):
            for name, picture in pictures.pages(view, 1.0).items():
                label = f"{name}/{pictures.view_name(view, index)}"
                trainer.logger.experiment.add_image(label, picture, module.iteration, dataformats="HWC")
        trainer.logger.experiment.flush()

    def _check_views(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        """How well the training views agree with each other, into ``views.csv``."""
        views, residuals = module.training_views, module.view_residuals()
        if views is None or views.surface is None or residuals is None:
            return
        self._views = self._views or ViewTable([view.name for view in module.scene.train], views.surface)
        self._views.update(run_folder(trainer), module.iteration, residuals)

    def _log_losses(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        if isinstance(trainer.logger, TensorBoardLogger) and trainer.is_global_zero:
            for name, value in module.last_losses.items():
                trainer.logger.experiment.add_scalar(f"train/{name}", float(value), module.iteration)


def error_bars_of(module: InverseRenderer, folder: Path | None) -> ErrorBars | None:
    """Error bars of the module's materials: those in the run folder, or else measured and written there. None where
    there are none, or where the training photographs are not there any more, which is said.
    """
    path = None if folder is None else folder / NAME
    if path is not None and path.exists():
        try:
            found = read_bars(path)
        except InputError:
            found = None  # damaged: written anew
        if found is not None and found.iteration == module.iteration:
            return found
    try:
        bars = module.error_bars()
    except InputError as error:
        print(f"neurad: no error bars: {error}", file=sys.stderr)
        return None
    if bars is not None and path is not None:
        write_bars(bars, path)
    return bars


def _table(module: InverseRenderer, scores: Mapping[str, float], spp: int, steady: bool = False) -> str:
    """The closing table and, where its scores are not of held-out views, what they are of."""
    said = module.scene.scores_are_of
    if said is None:
        return score_table(scores, spp, steady=steady)
    return f"{score_table(scores, spp, steady=steady, views='Training photographs')}\n\nneurad: {said}"


def _group(name: str) -> str:
    """TensorBoard's group of a score: the curves to follow first, not lost among the flat lines of the constant."""
    kinds = ("constant", "lookup", "seen")
    return "_".join(["held_out", *(kind for kind in kinds if kind in name.split("_"))])


def _json_number(value: float) -> float | None:
    """JSON has no infinity and no NaN."""
    return float(value) if np.isfinite(value) else None
