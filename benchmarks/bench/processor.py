"""A stopwatch that also has the processor's time, which other programs on the machine do not stretch."""

import time
from dataclasses import dataclass, field
from typing import Any

import lightning.pytorch as pl

from benchmarks.bench.measure import Stopwatch


@dataclass
class ProcessorWatch(Stopwatch):
    """Times of steps, and the time that all threads of this process had in each."""

    processor: list[float] = field(default_factory=list)
    _process: float = 0.0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set-up has ended."""
        super().on_train_start(trainer, pl_module)
        self._process = time.process_time()

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *rest: Any) -> None:
        """A step has ended."""
        counted = len(self.plain)
        super().on_train_batch_end(trainer, pl_module, *rest)
        now = time.process_time()
        if len(self.plain) > counted:
            self.processor.append(now - self._process)
        self._process = now
