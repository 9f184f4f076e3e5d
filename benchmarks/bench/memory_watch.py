"""What takes the memory of a fit for ``neurad bench memory``."""

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
        self.out = Path(out)
        self.every = every
        self.rows: list[Record] = []

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Take the memory if it is time."""
        iteration = int(cast(Any, pl_module).iteration)
        if iteration % self.every == 0:
            self.rows.append({"iteration": iteration, "resident_KiB": resident_memory() // 1024})

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write the table."""
        write_csv(self.out, ("iteration", "resident_KiB"), self.rows)
