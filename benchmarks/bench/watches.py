"""What takes memory and times within a fit for ``neurad bench memory`` and ``neurad bench start``."""

import time
from pathlib import Path
from typing import Any, cast

import lightning.pytorch as pl

from neurad.runtime.memory import resident_memory
from neurad.runtime.tables import Record, write_csv


class MemoryWatch(pl.Callback):
    """Writes the resident memory of the process as a table, a row every so many iterations.

    Args:
        out: the table.
        every: iterations between two rows.
    """

    def __init__(self, out: str, every: int) -> None:
        super().__init__()
        self.out, self.every = Path(out), every
        self.rows: list[Record] = []

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Take the memory if it is time."""
        iteration = int(cast(Any, pl_module).iteration)
        if iteration % self.every == 0:
            self.rows.append({"iteration": iteration, "resident_KiB": resident_memory() // 1024})

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write the table."""
        write_csv(self.out, ("iteration", "resident_KiB"), self.rows)


class StartWatch(pl.Callback):
    """Writes when each part of a start was over, in seconds since the process began, as a table.

    Args:
        out: the table.
        begun: when the process was started, on the system's monotonic clock.
    """

    def __init__(self, out: str, begun: float) -> None:
        super().__init__()
        self.out, self.begun = Path(out), begun
        self.rows: list[Record] = []
        self._take()  # imports and settings

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """The photographs have been read."""
        self._take()

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Scene and fields have been made."""
        self._take()

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Camera rays have been traced, and lamps and photographs compared."""
        self._take()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """The first step is done."""
        self._take()
        write_csv(self.out, tuple(self.rows[0]), self.rows)

    def _take(self) -> None:
        self.rows.append({"seconds": time.monotonic() - self.begun, "processor_s": time.process_time()})
