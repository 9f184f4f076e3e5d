"""Scores and pictures on held-out views: when they are taken, and where they go."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl

from neurad.assembly.settings import EvaluationSettings
from neurad.callbacks import pictures, report
from neurad.callbacks.board import Board
from neurad.callbacks.checkpoint import LastCheckpoint
from neurad.callbacks.closing import print_closing, report_run, settings_of, title_of
from neurad.callbacks.run_folder import RunLogger, run_folder
from neurad.callbacks.table import MetricsTable, curve_table, lamps_table, score_table, write_lamps
from neurad.callbacks.training_views import ViewTable, write_exposures
from neurad.core.decibels import as_json
from neurad.core.errors import InputError
from neurad.evidence.bars_file import NAME, read_bars, write_bars
from neurad.metrics.effort import affordable
from neurad.metrics.unseen import Unseen
from neurad.runtime import clock
from neurad.runtime.files import write_text
from neurad.runtime.progress import phase, say
from neurad.training.schedule import fraction_done, time_limit

if TYPE_CHECKING:
    from neurad.evidence.error_bars import ErrorBars
    from neurad.training.evaluate import Evaluation
    from neurad.training.inverse import InverseRenderer

MARKS = 20
"""Evaluations in a run, if the allowed fraction of time is enough for them."""
MIN_STEPS = 500
"""Iterations between two evaluations of a run that only its steps limit: a try of a few hundred took nine times as long
as its steps did."""
PICTURES = 4
"""Held-out views that TensorBoard shows."""
LOSSES_EVERY = 50
"""Iterations between two points of the losses in TensorBoard."""


class Evaluate(pl.Callback):
    """Evaluates on the held-out views: during a fit, at its end, and for ``validate``, ``test`` and ``predict``.

    A run that only ``max_steps`` limits evaluates every ``max_steps // 20`` iterations, so that it is repeatable, but
    at least :data:`MIN_STEPS` apart. One limited by time evaluates at every twentieth of its length, as long as that
    keeps to ``fraction``. Large held-out views are then scored at fewer positions in a pixel and in fewer pixels, see
    :mod:`neurad.metrics.effort`.
    """

    def __init__(self, settings: EvaluationSettings) -> None:
        super().__init__()
        self.settings = settings
        self.last_scores: dict[str, float] = {}
        self.last_scored = 0.0
        """When that was, by the monotonic clock."""
        self._spent = 0.0
        self._last = 0.0
        self._first: float | None = None
        self._mark = 0
        self._evaluated = -1
        self._as_end = False
        """Whether that was as a fit's end is evaluated, with plain paint."""
        self._views: ViewTable | None = None
        self._board: Board | None = None
        self._logs = True
        self._last_evaluation: tuple[Evaluation, Unseen] | None = None
        """With as many views as are shown, and what of all held-out views no photograph shows."""
        self._causes: list[str] = []
        """What is wrong with all training photographs, at the end of a fit."""

    def state_dict(self) -> dict[str, Any]:
        """Seconds and marks so far: a continued run keeps to its fraction of time."""
        return {
            "spent": self._spent, "last": self._last, "first": self._first, "mark": self._mark,
            "evaluated": self._evaluated,
        }  # fmt: skip

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the state of the interrupted run."""
        self._spent, self._last = float(state_dict["spent"]), float(state_dict["last"])
        self._first = state_dict["first"]
        self._mark, self._evaluated = int(state_dict["mark"]), int(state_dict["evaluated"])

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Decide how much of large held-out views evaluations look at: all ones of a run at the same pixels."""
        module = cast("InverseRenderer", pl_module)
        views = module.scene.scored
        if self.settings.every_n_steps is not None or not views:
            return
        module.scoring.effort = affordable(views, self.settings.spp, self.settings.fraction, time_limit(trainer))
        if not module.scoring.effort.whole and trainer.is_global_zero:
            grid, stride = module.scoring.effort.grid, module.scoring.effort.stride
            size = sum(view.camera.width * view.camera.height for view in views) / 1e6
            pixels = f"one row and column in {stride}" if stride > 1 else "all"
            say(
                f"the held-out views have {size:.3g} million pixels: evaluations during the fit score "
                f"{pixels}, at {grid**2} positions a pixel (a larger --evaluation.fraction allows more); "
                "`neurad test` scores all"
            )

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Log losses, and evaluate if it is time."""
        module = cast("InverseRenderer", pl_module)
        if module.iteration % LOSSES_EVERY == 0 and (board := self._board_of(trainer, module)):
            board.losses(module.last_losses, module.iteration)
        if trainer.strategy.broadcast(self._due(trainer, module)):
            self._evaluate_fit(trainer, module)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The scores that belong to the last checkpoint."""
        module = cast("InverseRenderer", pl_module)
        if self._evaluated != module.iteration or (_ends(trainer) and not self._as_end):
            self._evaluate_fit(trainer, module)
        if module.levels_found and trainer.is_global_zero:
            say(module.levels_found)
        with clock.excluded():
            if trainer.is_global_zero:
                with phase("photographs"):
                    self._causes = module.scoring.common_causes()
            if trainer.is_global_zero and run_folder(trainer) is not None:
                with phase("error bars"):
                    self._finish(trainer, module)
            trainer.strategy.barrier("error bars")

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print the closing table."""
        folder, module = run_folder(trainer), cast("InverseRenderer", pl_module)
        if self._evaluated != module.iteration:  # nothing was left to train: the run was killed at its very end
            if folder is not None and trainer.is_global_zero:
                MetricsTable(folder / "metrics.csv").cut(module.iteration - 1)
            self._logs = False  # the logger has been closed
            self.on_train_end(trainer, pl_module)
            for callback in trainer.callbacks:  # type: ignore[attr-defined]
                if isinstance(callback, LastCheckpoint):
                    callback.save(trainer)
        rows = MetricsTable(folder / "metrics.csv").rows() if folder else []
        scores = rows[-1] if rows else self.last_scores
        if trainer.is_global_zero and scores:
            table = _table(module, scores, self.settings.spp, steady=True)
            print("\n" + "\n\n".join(t for t in (table, lamps_table(module, scores), curve_table(rows)) if t) + "\n")
            unseen = None if self._last_evaluation is None else self._last_evaluation[1]
            print_closing(trainer, folder, scores, unseen, tested=False, causes=self._causes)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """``neurad validate``: print the scores."""
        if trainer.is_global_zero:
            module = cast("InverseRenderer", pl_module)
            scores = module.evaluate(self.settings.spp, steady=True).scores
            print(_table(module, scores, self.settings.spp, steady=True))

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """``neurad test``: write every held-out view and the scores."""
        if not trainer.is_global_zero:
            return
        module = cast("InverseRenderer", pl_module)
        folder = run_folder(trainer)
        evaluation = module.evaluate(self.settings.test_spp, glossy=True, bars=error_bars_of(module, folder))
        unseen = Unseen.of(evaluation.maps)
        tables = _table(module, evaluation.scores, self.settings.test_spp), lamps_table(module, evaluation.scores)
        print("\n\n".join(t for t in tables if t) + "\n")
        if folder is not None:
            _write_views(folder, evaluation, module)
            report_run(trainer, folder, evaluation, unseen, f"{self.settings.test_spp} samples per pixel", tested=True)
            about = {"iteration": module.iteration, "seconds": round(module.spent.seconds, 2), "rays": module.rays}
            about |= {"samples": module.samples, "render_spp": self.settings.test_spp}
            scores = {key: as_json(value) for key, value in evaluation.scores.items()}
            write_text(folder / "metrics.json", json.dumps(about | scores, indent=2) + "\n")
        print_closing(trainer, folder, evaluation.scores, unseen, tested=True)

    def on_predict_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """``neurad predict``: write every held-out view, without scores."""
        if not trainer.is_global_zero:
            return
        module = cast("InverseRenderer", pl_module)
        evaluation = module.evaluate(self.settings.test_spp)
        folder = run_folder(trainer)
        if folder is not None:
            _write_views(folder, evaluation, module)
            print(f"neurad: images are in {folder / 'images'}")

    def _due(self, trainer: pl.Trainer, module: InverseRenderer) -> bool:
        if _ends(trainer):
            return False  # the end is scored after the last fit of the levels' factors
        every = self.settings.every_n_steps
        if every is None and trainer.max_steps > 0 and fraction_done(trainer).by_time is None:
            every = max(trainer.max_steps // MARKS, MIN_STEPS)
        if every is not None:
            return bool(module.iteration % every == 0)
        mark = self._mark_of(trainer)
        # After the first, which compiles kernels and may end at a mark, the second one waits for as long again.
        if mark < max(self._mark + 1, 2 * self._mark if self._first else 0) or self.settings.fraction <= 0:
            return False
        left = fraction_done(trainer).seconds_by_time
        if left is not None and left < 2.0 * self._last:
            return False  # Lightning's timer counts it: what follows the roughness refinement would not be trained
        self._mark = mark
        return bool(self._spent + self._last <= self.settings.fraction * module.spent.seconds)

    @staticmethod
    def _mark_of(trainer: pl.Trainer) -> int:
        return int(fraction_done(trainer).largest * MARKS)

    def _evaluate_fit(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        """Score what a run that ended here would show."""
        begin = time.monotonic()
        with clock.excluded():
            self._evaluated, self._as_end = module.iteration, _ends(trainer)
            if trainer.is_global_zero:
                evaluation = module.evaluate(self.settings.spp, steady=True)
                self.last_scores, self.last_scored = dict(evaluation.scores), time.monotonic()
                self._record(trainer, module, evaluation)
                write_lamps(module, run_folder(trainer))
                self._check_views(trainer, module)
            trainer.strategy.barrier("evaluation")
        self._count(time.monotonic() - begin)
        self._mark = self._mark_of(trainer)  # Lightning's timer counts evaluations: those marks have passed

    def _count(self, taken: float) -> None:
        """Add the seconds of an evaluation. The first one also compiles kernels, for half a minute where no cache has
        them, so it counts for what the second takes.
        """
        if self._first is None:
            self._first = taken
            return
        self._spent += taken + min(self._first, taken)
        self._first, self._last = 0.0, taken

    def _record(self, trainer: pl.Trainer, module: InverseRenderer, evaluation: Evaluation) -> None:
        folder = run_folder(trainer)
        if folder is None:
            return
        seconds = {"seconds": module.spent.seconds, "processor_seconds": round(module.spent.processor_seconds, 2)}
        spent = {**seconds, "rays": module.rays, "samples": module.samples}
        table = MetricsTable(folder / "metrics.csv")
        table.cut(module.iteration - 1)  # the end may have been scored before it was known to be the end
        table.append({"iteration": module.iteration, **spent, **evaluation.scores})
        maps = evaluation.maps
        kept = replace(evaluation, maps=maps[: report.VIEWS])
        self._last_evaluation = kept, Unseen.of(maps).summary()
        if board := self._board_of(trainer, module):
            board.scores(evaluation.scores, table.rows())
            board.lamps(module, module.iteration)
            board.sheets(maps[:PICTURES], evaluation.exposure, module.iteration)
            if evaluation.environment:
                board.picture("environment", pictures.environment(evaluation.environment), module.iteration)

    def _finish(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        """Measure the error bars of the final materials, into the run folder; show them with the last evaluation in
        TensorBoard, and write the report.
        """
        folder = run_folder(trainer)
        bars = error_bars_of(module, folder)
        if self._last_evaluation is None or folder is None:
            return
        evaluation, unseen = self._last_evaluation
        if bars is not None:
            for view, found in zip(evaluation.maps, module.scoring.bar_maps(bars), strict=False):
                view |= found
            if board := self._board_of(trainer, module):
                board.sheets(evaluation.maps[:PICTURES], evaluation.exposure, module.iteration)
        control = ", with the radiance field as control variate" if "psnr_lhs" in evaluation.scores else ""
        about = f"{self.settings.spp} samples per pixel{control}; neurad test takes {self.settings.test_spp}"
        report_run(trainer, folder, evaluation, unseen, about, tested=False, causes=self._causes)

    def _board_of(self, trainer: pl.Trainer, module: InverseRenderer) -> Board | None:
        if not self._logs:
            return None
        events = trainer.logger.events if isinstance(trainer.logger, RunLogger) and trainer.is_global_zero else None
        if self._board is None and events is not None:
            self._board = Board(events, module, settings_of(trainer))
        return self._board

    def _check_views(self, trainer: pl.Trainer, module: InverseRenderer) -> None:
        """How well the training views agree with each other, into ``views.csv``."""
        views, residuals = module.training_views, module.scoring.view_residuals()
        if views is None or views.surface is None or residuals is None:
            return
        self._views = self._views or ViewTable([view.name for view in module.scene.train], views.surface)
        self._views.update(run_folder(trainer), module.iteration, residuals)
        if module.assembly.development is not None:
            write_exposures(run_folder(trainer), module.scene.train, module.assembly.development, module.iteration)


def _ends(trainer: pl.Trainer) -> bool:
    """Whether the steps or the time of a fit are used up."""
    return fraction_done(trainer).largest >= 1.0


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
        bars = module.scoring.error_bars()
    except InputError as error:
        say(f"no error bars: {error}")
        return None
    if bars is not None and path is not None:
        write_bars(bars, path)
    return bars


def _table(module: InverseRenderer, scores: Mapping[str, float], spp: int, steady: bool = False) -> str:
    """The closing table and, where its scores are not of held-out views, what they are of."""
    said = module.scene.scores_are_of
    table = score_table(scores, spp, steady=steady, views="Held-out views" if said is None else "Training photographs")
    return table if said is None else f"{table}\n\nneurad: {said}"


def _write_views(folder: Path, evaluation: Evaluation, module: InverseRenderer) -> None:
    """Write every view into ``images/`` of a run folder."""
    pictures.write_views(
        folder / "images", evaluation.maps, evaluation.exposure, evaluation.environment, title_of(module)
    )
