"""The run folder: when it is created, and what of an interrupted run a continued one takes over."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl
from lightning.fabric.loggers.logger import _DummyExperiment as DummyExperiment
from lightning.pytorch.cli import SaveConfigCallback
from lightning.pytorch.loggers import TensorBoardLogger

from neurad.callbacks.table import MetricsTable

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class RunLogger(TensorBoardLogger):
    """TensorBoard events in ``lightning_logs/version_N``; nothing is created before training really starts.

    A run that fails over its input must leave neither an empty folder nor a trace in the run that it was to continue.
    """

    def __init__(self, save_dir: str | Path, name: str = "lightning_logs", version: int | str | None = None) -> None:
        super().__init__(save_dir=str(save_dir), name=name, version=version, default_hp_metric=False)
        self.opened = False

    @classmethod
    def of_checkpoint(cls, checkpoint: Path) -> RunLogger | None:
        """The logger of the run that wrote ``<run>/checkpoints/last.ckpt``; None for a checkpoint kept elsewhere."""
        folder = checkpoint.resolve().parent
        if folder.name != "checkpoints":
            return None
        run = folder.parent
        return cls(os.path.relpath(run.parent.parent), name=run.parent.name, version=run.name)

    @property
    def experiment(self) -> SummaryWriter:
        """The writer of events, or one that drops them before :meth:`open`."""
        return super().experiment if self.opened else DummyExperiment()  # type: ignore[return-value]

    def open(self) -> None:
        """Create the folder and write events from now on."""
        self.opened = True

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Nothing: ``config.yaml`` holds every setting."""

    def save(self) -> None:
        """Flush events to disk; there is no ``hparams.yaml``, ``config.yaml`` holds every setting."""
        if self.opened:
            self.experiment.flush()


def run_folder(trainer: pl.Trainer) -> Path | None:
    """Where this run keeps its files, or None if logging is switched off."""
    logger = trainer.logger
    if logger is None or getattr(trainer, "fast_dev_run", False):
        return None
    # Not ``trainer.log_dir``: it waits for all processes, and the first one calls this more often than the others.
    folder = logger.log_dir if isinstance(logger, TensorBoardLogger) else logger.save_dir
    return None if folder is None else Path(folder)


class RunFolder(SaveConfigCallback):
    """Opens the run folder when training starts: writes ``config.yaml``, cuts ``metrics.csv``."""

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Nothing yet: input may still turn out bad."""

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Everything is built and restored, so the run exists from here on."""
        folder = run_folder(trainer)
        if folder is None or not trainer.is_global_zero:
            return
        folder.mkdir(parents=True, exist_ok=True)
        if isinstance(trainer.logger, RunLogger):
            trainer.logger.open()
        part = folder / "config.yaml.part"
        self.parser.save(self.config, str(part), skip_unset=False, overwrite=True, multifile=False)
        os.replace(part, folder / "config.yaml")
        MetricsTable(folder / "metrics.csv").cut(int(pl_module.iteration))  # type: ignore[arg-type]
