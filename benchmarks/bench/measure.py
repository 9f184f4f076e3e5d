"""A training run with a stopwatch: the whole step without instrumentation, then its stages."""

import argparse
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import lightning.pytorch as pl

from benchmarks.bench.machine import describe, peak_bytes, wait
from benchmarks.bench.session import prepare
from benchmarks.bench.stages import STAGES, Recorder, instrumented
from neurad.core.errors import InputError
from neurad.runtime.tables import Record
from neurad.training.inverse import InverseRenderer


@dataclass
class Stopwatch(pl.Callback):
    """Times of steps: ``warmup`` that do not count, ``steps`` without instrumentation, ``steps`` by stage."""

    steps: int
    warmup: int
    plain: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    """Seconds that all threads of this process had in each of the plain steps, which other programs do not stretch."""
    staged: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    rays: list[int] = field(default_factory=list)
    setup_seconds: float = 0.0
    """From the start of the fit to its first step."""
    peak: int = 0
    """Bytes."""
    _recorder: Recorder | None = None
    _begin: float = 0.0
    _process: float = 0.0
    _done: int = 0
    _rays: int = 0
    _stack: ExitStack = field(default_factory=ExitStack)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set-up has ended."""
        wait(pl_module.device)
        self._process = time.process_time()
        self._begin = time.perf_counter()
        self.setup_seconds += self._begin

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Record the step that has ended, Lightning's own work included."""
        module = pl_module
        assert isinstance(module, InverseRenderer)
        wait(module.device)
        seconds = time.perf_counter() - self._begin
        index, self._done = self._done, self._done + 1
        if self.warmup <= index < self.warmup + self.steps:
            self.plain.append(seconds)
            self.processor.append(time.process_time() - self._process)
            self.rays.append(module.rays - self._rays)
            self.peak = peak_bytes(module.device)
        elif self._recorder is not None:
            self.staged.append((seconds, self._recorder.take()))
        if self._done == self.warmup + self.steps:
            module.step.replayed = None  # nobody sees into a graph
            self._recorder = Recorder(module.device)
            self._stack.enter_context(instrumented(module, self._recorder))
        self._rays = module.rays
        self._process = time.process_time()
        self._begin = time.perf_counter()

    def on_train_end(self, *_: Any) -> None:
        """Remove the instrumentation."""
        self._stack.close()

    def on_exception(self, *_: Any) -> None:
        """Remove the instrumentation."""
        self._stack.close()


def fit(trainer: pl.Trainer, module: InverseRenderer, data: pl.LightningDataModule, watch: Stopwatch) -> None:
    """Run the steps with the stopwatch; set-up begins here."""
    trainer.callbacks = [watch]  # type: ignore[attr-defined]
    watch.setup_seconds = -time.perf_counter()
    trainer.fit(module, data)


def measure_step(options: argparse.Namespace) -> tuple[str, list[Record]]:
    """Run ``warmup + 2 steps`` iterations: a sentence on the whole step, and a row for each stage of it, its median
    milliseconds and percent of a step with stopwatches.

    Raises:
        InputError: the settings are wrong.
    """
    if options.warmup < 1:
        raise InputError("--steps and --warmup must be at least 1")
    trainer, module, data = prepare(options, options.warmup + 2 * options.steps)
    watch = Stopwatch(options.steps, options.warmup)
    fit(trainer, module, data, watch)
    milliseconds, samples = 1e3 * median(watch.plain), module.samples / max(module.iteration, 1)
    title = (
        f"training step on {describe(module.device)}: {milliseconds:.1f} ms a step, "
        f"{median(watch.rays) / milliseconds / 1e3:.2f} million rays/s, "
        f"{samples / milliseconds / 1e3:.3f} million samples/s, peak memory {watch.peak / 2**30:.2f} GiB"
    )
    whole = 1e3 * median(seconds for seconds, _ in watch.staged)
    spent = {stage: 1e3 * median(parts.get(stage, 0.0) for _, parts in watch.staged) for stage in STAGES}
    spent = {stage: ms for stage, ms in spent.items() if ms > 0.0}
    spent["losses, Lightning and the rest"] = whole - sum(spent.values())
    rows: list[Record] = [{"stage": stage, "ms": ms, "percent": 100.0 * ms / whole} for stage, ms in spent.items()]
    return title, [*rows, {"stage": "whole step, no stopwatch", "ms": milliseconds, "percent": 100.0}]
