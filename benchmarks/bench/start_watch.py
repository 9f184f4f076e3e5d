"""What takes the times of a start for ``neurad bench start``."""

import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl

from neurad.runtime.tables import Record, write_csv


class StartWatch(pl.Callback):
    """Writes when each part of a start was over, in seconds since the process began, as a table.

    Args:
        out: the table.
        begun: when the process was started, on the system's monotonic clock.
    """

    def __init__(self, out: str, begun: float) -> None:
        super().__init__()
        self.out = Path(out)
        self.begun = begun
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
