"""The run folder: when it is created, whom it belongs to, and what a continued run takes over."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
from lightning.fabric.loggers.logger import _DummyExperiment as DummyExperiment
from lightning.pytorch.cli import SaveConfigCallback
from lightning.pytorch.loggers import TensorBoardLogger

from neurad.callbacks.board import method_name, run_name
from neurad.callbacks.table import MetricsTable
from neurad.runtime.files import check_folder, check_space, make_folder, remove_parts, replacing, writing
from neurad.runtime.lock import FolderLock

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

    from neurad.training.inverse import InverseRenderer

MAX_CHECKPOINTS = 3
"""Checkpoints that are there at once: the last, the one before, and the one that is being written."""
ADAM = 3
"""Numbers of a checkpoint for each number that is trained: its value, and two moments."""


class RunLogger(TensorBoardLogger):
    """TensorBoard events in ``lightning_logs/version_N``; nothing is created before training really starts.

    A run that fails over its input must leave neither an empty folder nor a trace in the run that it was to continue.
    """

    def __init__(self, save_dir: str | Path, name: str = "lightning_logs", version: int | str | None = None) -> None:
        super().__init__(save_dir=str(save_dir), name=name, version=version, default_hp_metric=False)
        self.opened = False
        self.run_name = ""
        """Folder of the events in that of the run: what TensorBoard calls it."""
        self._writer: SummaryWriter | None = None

    @classmethod
    def of_checkpoint(cls, checkpoint: Path) -> RunLogger | None:
        """The logger of the run that wrote ``<run>/checkpoints/last.ckpt``; None for a checkpoint kept elsewhere."""
        folder = checkpoint.resolve().parent
        if folder.name != "checkpoints":
            return None
        run = folder.parent
        return cls(os.path.relpath(run.parent.parent), name=run.parent.name, version=run.name)

    @property
    def is_new(self) -> bool:
        """Whether the run has no folder yet, only a guess at its number."""
        return self._version is None

    @property
    def version(self) -> int | str:
        """The run's number. Before :meth:`open` it is a guess: another run may take it."""
        return self._next_version() if self._version is None else self._version

    @property
    def experiment(self) -> SummaryWriter:
        """The writer of events, or one that drops them before :meth:`open`."""
        if not self.opened:
            return DummyExperiment()  # type: ignore[return-value]
        if self._writer is None:
            from neurad.callbacks.events import EventWriter

            self._writer = EventWriter(os.path.join(self.log_dir, self.run_name))
        return self._writer

    def open(self) -> None:
        """Create the folder and write events from now on. A new run's number is one that no other run has."""
        if self._version is None:
            root, number = make_folder(self.root_dir), self._next_version()
            while self._version is None:
                with writing(root / f"version_{number}"):
                    try:
                        os.mkdir(root / f"version_{number}")
                        self._version = number
                    except FileExistsError:
                        number += 1
        self.opened = True

    def _next_version(self) -> int:
        names = (path.name.removeprefix("version_") for path in Path(self.root_dir).glob("version_*"))
        return max((int(name) for name in names if name.isdecimal()), default=-1) + 1

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Nothing: ``config.yaml`` holds every setting."""

    def save(self) -> None:
        """Flush events to disk; there is no ``hparams.yaml``, ``config.yaml`` holds every setting."""
        if self._writer is not None:
            self._writer.flush()

    def finalize(self, status: str) -> None:
        """Close the file of events."""
        if self._writer is not None:
            self._writer.close()


def run_folder(trainer: pl.Trainer) -> Path | None:
    """Where this run keeps its files, or None if logging is switched off."""
    # Not ``trainer.log_dir``: it waits for all processes, and the first one calls this more often than the others.
    return Path(trainer.logger.log_dir) if isinstance(trainer.logger, TensorBoardLogger) else None


class RunFolder(SaveConfigCallback):
    """Opens the run folder when training starts: writes ``config.yaml``, cuts ``metrics.csv``.

    The folder belongs to this run alone as long as it lasts; others may read it.
    """

    _lock: FolderLock | None = None

    def claim(self, trainer: pl.Trainer) -> None:
        """Before anything is read or measured: see whether the folder can be written, and take it if it is there.

        Raises:
            InputError: it cannot, another run has it, or its ``metrics.csv`` is none.
        """
        folder = run_folder(trainer)
        if folder is None or not trainer.is_global_zero:
            return
        if isinstance(trainer.logger, RunLogger) and trainer.logger.is_new:
            check_folder(trainer.logger.root_dir)
            return
        check_folder(folder)
        check_folder(folder / "checkpoints")
        if folder.is_dir():
            MetricsTable(folder / "metrics.csv").rows()
            self._take(folder)

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Nothing yet: input may still turn out bad."""

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The fields are built, so it is known how large a checkpoint is: refuse a disk that has no room for it."""
        folder = run_folder(trainer)
        if folder is None or not trainer.is_global_zero:
            return
        state = sum(value.nbytes for value in pl_module.state_dict().values())
        size = state + (ADAM - 1) * sum(p.nbytes for p in pl_module.parameters() if p.requires_grad)
        there = len([*(folder / "checkpoints").glob("*.ckpt")])
        check_space(folder, size, max(MAX_CHECKPOINTS - there, 1), "its checkpoints")

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Everything is built and restored, so the run exists from here on."""
        if run_folder(trainer) is None or not trainer.is_global_zero:
            return
        if isinstance(trainer.logger, RunLogger):
            module = cast("InverseRenderer", pl_module)
            trainer.logger.run_name = run_name(module.scene.name, method_name(module))
            trainer.logger.open()
        folder = run_folder(trainer)
        assert folder is not None
        self._take(folder)
        with replacing(folder / "config.yaml") as part:
            self.parser.save(self.config, str(part), skip_unset=False, overwrite=True, multifile=False)
        MetricsTable(folder / "metrics.csv").cut(int(pl_module.iteration))  # type: ignore[arg-type]

    def release(self) -> None:
        """Give the folder back, if it was taken: when the trainer has ended and the last checkpoint is written."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _take(self, folder: Path) -> None:
        """Lock the folder, and remove what a killed run was writing."""
        if self._lock is None:
            self._lock = FolderLock(folder)
            remove_parts(folder)
            remove_parts(folder / "checkpoints")
