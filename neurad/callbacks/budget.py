"""A time limit on the training seconds, the column ``seconds`` of ``metrics.csv``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.trainer.states import RunningStage

from neurad.core.ranges import Positive, checked
from neurad.runtime import clock

if TYPE_CHECKING:
    from neurad.training.inverse import InverseRenderer


class WarmUp(pl.Callback):
    """Counts training seconds from the end of the first iteration on.

    What comes before it, imports, the scene, camera rays and compiled kernels, takes longer the first time that
    something runs on a machine, which says nothing about methods that are compared.
    """

    def __init__(self) -> None:
        super().__init__()
        self._over = False

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Nothing counts yet."""
        if stage == "fit":
            clock.hold()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Count from here on."""
        if not self._over:
            self._over = True
            clock.restart()


class TrainingBudget(Timer):
    """Ends a fit after so many seconds of training: set-up and compilation count, evaluations do not.

    Lightning's own timer (``max_time``) counts the other way round, so two methods whose evaluations differ in cost
    would get different training times. Where both are given, this one counts.

    Raises:
        InputError: ``seconds`` is not positive.
    """

    def __init__(self, seconds: Positive) -> None:
        super().__init__(duration=None, interval="step", verbose=False)
        self._duration = seconds
        self.seconds = seconds
        checked(self)
        self._module: InverseRenderer | None = None
        self._begin: float | None = None

    def on_fit_start(self, trainer: pl.Trainer, *args: Any, **kwargs: Any) -> None:
        """A continued run may have used up its budget already."""
        if self._begin is not None:
            self._module = cast("InverseRenderer", trainer.lightning_module)
            self._duration = self.seconds - self._begin
        super().on_fit_start(trainer, *args, **kwargs)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Training begins here: schedules follow the time that is left after set-up."""
        super().on_train_start(trainer, pl_module)
        self._module = cast("InverseRenderer", pl_module)
        if self._begin is None:
            self._begin = self._module.spent.seconds
        self._duration = self.seconds - self._begin

    def time_elapsed(self, stage: str = RunningStage.TRAINING) -> float:
        """Training seconds since the first step; those of an interrupted run included."""
        if self._module is None or stage != RunningStage.TRAINING:
            return 0.0
        return self._module.spent.seconds - (self._begin or 0.0)

    def state_dict(self) -> dict[str, Any]:
        """When training began, for a continued run."""
        return {"begin": self._begin}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the state of the interrupted run."""
        self._begin = state_dict["begin"]
