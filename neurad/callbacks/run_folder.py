"""The run folder: when it is created, whom it belongs to, and what a continued run takes over."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
from lightning.pytorch.cli import SaveConfigCallback
from lightning.pytorch.loggers import Logger

from neurad.callbacks.board import method_name
from neurad.callbacks.table import MetricsTable
from neurad.runtime.files import check_folder, check_space, make_folder, remove_parts, replacing, writing
from neurad.runtime.folders import FolderLock

if TYPE_CHECKING:
    from neurad.callbacks.events import EventFile
    from neurad.training.inverse import InverseRenderer

MAX_CHECKPOINTS = 3
"""Checkpoints that are there at once: the last, the one before, and the one that is being written."""
ADAM = 3
"""Numbers of a checkpoint for each number that is trained: its value, and two moments."""


class RunLogger(Logger):
    """The run folder ``lightning_logs/version_N`` and its TensorBoard events; nothing is created before training really
    starts. ``config.yaml`` holds every setting, so Lightning logs nothing.

    A run that fails over its input must leave neither an empty folder nor a trace in the run that it was to continue.
    """

    def __init__(self, save_dir: str | Path, name: str = "lightning_logs", version: str | None = None) -> None:
        super().__init__()
        self.root = Path(save_dir) / name
        self._version = version
        self.run_name = ""
        """Folder of the events in that of the run: what TensorBoard calls it."""
        self._opened = False
        self._events: EventFile | None = None

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
    def name(self) -> str:
        """Of the folder of runs."""
        return self.root.name

    @property
    def version(self) -> str:
        """The run folder's name. Before :meth:`open` it is a guess: another run may take it."""
        return self._version or f"version_{self._next_number()}"

    @property
    def log_dir(self) -> str:
        """The run folder."""
        return str(self.root / self.version)

    @property
    def events(self) -> EventFile | None:
        """The file of events; None before :meth:`open`."""
        if self._opened and self._events is None:
            from neurad.callbacks.events import EventFile

            self._events = EventFile(Path(self.log_dir) / self.run_name)
        return self._events

    def open(self) -> None:
        """Create the folder and write events from now on. A new run's number is one that no other run has."""
        number = self._next_number()
        make_folder(self.root)
        while self._version is None:
            with writing(self.root / f"version_{number}"):
                try:
                    os.mkdir(self.root / f"version_{number}")
                    self._version = f"version_{number}"
                except FileExistsError:
                    number += 1
        self._opened = True

    def _next_number(self) -> int:
        names = (path.name.removeprefix("version_") for path in self.root.glob("version_*"))
        return max((int(name) for name in names if name.isdecimal()), default=-1) + 1

    def log_metrics(self, metrics: Any, step: int | None = None) -> None:
        """Nothing."""

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Nothing."""


def run_folder(trainer: pl.Trainer) -> Path | None:
    """Where this run keeps its files, or None if logging is switched off."""
    # Not ``trainer.log_dir``: it waits for all processes, and the first one calls this more often than the others.
    return Path(trainer.logger.log_dir) if isinstance(trainer.logger, RunLogger) else None


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
            check_folder(trainer.logger.root)
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
            name = f"{module.scene.name}-{method_name(module)}"
            trainer.logger.run_name = name.replace("/", "_").replace(" ", "-").replace("'", "")
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
