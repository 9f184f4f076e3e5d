"""A training run with a stopwatch: the whole step without instrumentation, then its stages, then their work."""

import argparse
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import lightning.pytorch as pl
import torch

from benchmarks.bench.machine import Row, bandwidth, matrix_rate, peak_bytes, ray_rates, wait
from benchmarks.bench.session import prepare
from benchmarks.bench.stages import STAGES, Recorder, Work, instrumented
from neurad.core.errors import InputError
from neurad.core.records import Rays
from neurad.training.inverse import InverseRenderer


@dataclass
class StepFigures:
    """What was measured."""

    device: torch.device
    milliseconds: float
    """Median of a step without any stopwatch inside."""
    rays: float
    """Rays of a step."""
    samples: float
    """Path samples of a step."""
    peak: int
    """Bytes."""
    rates: dict[str, float]
    """Rates of the machine: 'closest' and 'shadow' (rays/s), 'matrix' (operations/s), 'bandwidth' (bytes/s)."""
    rows: list[Row]
    setup_seconds: float = 0.0
    """Seconds from the start of the fit to its first step."""


@dataclass
class Stopwatch(pl.Callback):
    """Times of steps: ``warmup`` that do not count, ``steps`` without instrumentation, ``steps`` by stage, one
    to count work.
    """

    steps: int
    warmup: int
    plain: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    """Seconds that all threads of this process had in each of the plain steps, which other programs do not stretch."""
    staged: list[tuple[float, dict[str, float], float]] = field(default_factory=list)
    rays: list[int] = field(default_factory=list)
    recorder: Recorder | None = None
    setup_seconds: float = 0.0
    peak: int = 0
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
        elif self.recorder is not None and not self.recorder.counting:
            self.staged.append((seconds, *self.recorder.take()))
        if self._done == self.warmup + self.steps:
            module.step.replayed = None  # nobody sees into a graph
            self.recorder = Recorder(module.device)
            self._stack.enter_context(instrumented(module, self.recorder))
        if self.recorder is not None and self._done == self.warmup + 2 * self.steps:
            self.recorder.take()
            self.recorder.counting = True
        self._rays = module.rays
        self._process = time.process_time()
        self._begin = time.perf_counter()

    def on_train_end(self, *_: Any) -> None:
        """Remove the instrumentation."""
        self._stack.close()

    def on_exception(self, *_: Any) -> None:
        """Remove the instrumentation."""
        self._stack.close()


def measure_step(options: argparse.Namespace, steps: int, warmup: int) -> StepFigures:
    """Run ``warmup + 2 steps + 1`` iterations and take medians.

    Raises:
        InputError: the settings are wrong.
    """
    if steps < 1 or warmup < 1:
        raise InputError("--steps and --warmup must be at least 1")
    trainer, module, data = prepare(options, warmup + 2 * steps + 1)
    watch = Stopwatch(steps, warmup)
    fit(trainer, module, data, watch)
    recorder = watch.recorder
    assert recorder is not None
    device = module.device
    closest = Rays.cat(*recorder.closest) if recorder.closest else None
    shadow = Rays.cat(*(rays for rays, _ in recorder.shadow)) if recorder.shadow else None
    t_max = torch.cat([t for _, t in recorder.shadow]) if recorder.shadow else None
    rates = {"matrix": matrix_rate(device), "bandwidth": bandwidth(device), "closest": 0.0, "shadow": 0.0}
    if closest is not None:
        rates["closest"], rates["shadow"] = ray_rates(module.assembly.world.tracer, closest, shadow, t_max)
    milliseconds = 1e3 * median(watch.plain)
    samples = module.samples / max(module.iteration, 1)
    rows = [*stage_rows(watch, recorder, rates), total_row(milliseconds)]
    return StepFigures(
        device, milliseconds, median(watch.rays), samples, watch.peak, rates, rows, watch.setup_seconds,
    )  # fmt: skip


def fit(trainer: pl.Trainer, module: InverseRenderer, data: pl.LightningDataModule, watch: Stopwatch) -> None:
    """Run the steps with the stopwatch; set-up begins here."""
    trainer.callbacks = [watch]  # type: ignore[attr-defined]
    watch.setup_seconds = -time.perf_counter()
    trainer.fit(module, data)


def stage_rows(watch: Stopwatch, recorder: Recorder, rates: dict[str, float]) -> list[Row]:
    """A row for each stage: median milliseconds, percent of the step, and the floor with what limits it."""
    whole = 1e3 * median(seconds for seconds, _, _ in watch.staged)
    rows: list[Row] = []
    known = 0.0
    for stage in STAGES:
        ms = 1e3 * median(parts.get(stage, 0.0) for _, parts, _ in watch.staged)
        if ms == 0.0:
            continue
        known += ms
        work = recorder.work.get(stage, Work())
        rows.append(_row(stage, ms, whole, work.lanes, *floor(stage, work, rates)))
    rows.append(_row("losses, Lightning and the rest", whole - known, whole, 0, None, ""))
    second = 1e3 * median(seconds for _, _, seconds in watch.staged)
    rows.append(_row("(of these: second hits)", second, whole, 0, None, ""))
    return rows


def total_row(milliseconds: float) -> Row:
    """The step without instrumentation."""
    return _row("whole step, no stopwatch", milliseconds, milliseconds, 0, None, "")


def floor(stage: str, work: Work, rates: dict[str, float]) -> tuple[float | None, str]:
    """Milliseconds that the machine needs at least, and what limits it; None where no floor is known."""
    if stage.startswith("tracing"):
        kind = stage.split(": ")[1]
        return (1e3 * work.lanes / rates[kind], "tracer") if rates[kind] > 0 else (None, "")
    if work.operations > 0:
        return 1e3 * work.operations / rates["matrix"], "matrix"
    return (1e3 * work.bytes / rates["bandwidth"], "bandwidth") if work.bytes > 0 else (None, "")


def _row(stage: str, ms: float, whole: float, lanes: int, least: float | None, limit: str) -> Row:
    ratio = ms / least if least else None
    return {
        "stage": stage, "ms": ms, "percent": 100.0 * ms / whole, "lanes": lanes or None, "floor_ms": least,
        "ratio": ratio, "limit": limit,
    }  # fmt: skip
