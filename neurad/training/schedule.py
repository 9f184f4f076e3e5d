"""How far a run is, what it has taken, and its learning rates."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Timer

from neurad.assembly.settings import Optimization
from neurad.optim.schedule import cosine, warmup
from neurad.runtime.clock import processor_seconds, training_seconds
from neurad.training.optimizers import RATES

FINAL = 0.02
"""Fraction of the rates left at the end of the cosine."""

WARMUP = 20
"""Iterations over which the rates of the cosine rise from zero: Adam's first steps rest on few gradients."""


@dataclass
class Counters:
    """What a run has done so far."""

    iteration: int = 0
    samples: int = 0
    """Path samples drawn: pixels x spp x samples per vertex, of all processes."""


class Spent:
    """What a fit has taken so far; outside of one what its checkpoint says."""

    def __init__(self) -> None:
        self.counts = False
        """Whether this process fits, so that its own time is added."""
        self.rays_before = 0
        """Rays cast before the fit was interrupted."""
        self._seconds_before = 0.0
        self._processor_before = 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Seconds since the start of the process, evaluation left out, earlier runs of a continued fit included."""
        return self._seconds_before + (training_seconds() if self.counts else 0.0)

    @property
    def processor_seconds(self) -> float:
        """Seconds in which threads of the fit ran, as :attr:`seconds`."""
        return self._processor[0]

    @property
    def processor_share(self) -> float:
        """Fraction of the processor time that the fit's threads asked for which they got, by the seconds in which they
        ran and in which they waited for others; 1 where the system does not tell.
        """
        used, waited = self._processor
        return used / (used + waited) if used > 0.0 else 1.0

    @property
    def _processor(self) -> tuple[float, float]:
        before, waited_before = self._processor_before
        used, waited = processor_seconds() if self.counts else (0.0, 0.0)
        return used + before, waited + waited_before

    def state(self) -> dict[str, float]:
        """What a checkpoint keeps of it, the rays left out."""
        used, waited = self._processor
        return {"seconds": self.seconds, "processor_seconds": used, "waited_seconds": waited}

    def continue_from(self, state: Mapping[str, Any]) -> None:
        """Go on from what a checkpoint says of the fit."""
        self.rays_before = state["rays"]
        self._seconds_before = state["seconds"]
        self._processor_before = state["processor_seconds"], state["waited_seconds"]


def rate_factor(settings: Optimization, iteration: int, progress: float) -> float:
    """What the learning rates are multiplied by.

    Args:
        progress: fraction of the run that is over, or of the way to its roughness refinement; 1 or more is the end.
    """
    return 1.0 if settings.schedule == "constant" else warmup(iteration, WARMUP) * cosine(progress, FINAL)


def learning_rate(settings: Optimization, name: str, iteration: int, factor: float, roughness_begins: int = 0) -> float:
    """The learning rate of the optimizer of this name in an iteration.

    Args:
        name: ``albedo``, ``roughness``, ``radiance``, ``environment``, ``lamps``, ``exposure`` or ``response``.
        factor: of all rates, see :func:`rate_factor`.
        roughness_begins: iterations before which roughness stays as it is.
    """
    setting = "light" if name in ("environment", "lamps") else name
    rate: float = factor * (RATES[name] if name in RATES else getattr(settings, setting))
    if name != "roughness":
        return rate
    learnt = iteration - roughness_begins
    return rate * warmup(learnt, settings.roughness_warmup) if learnt >= 0 else 0.0


@dataclass(frozen=True)
class Progress:
    """Fractions of a run's limits that are used up; None where there is no such limit."""

    by_steps: float | None
    by_time: float | None
    seconds: float
    """Seconds of the fit so far, those of an interrupted run included."""

    @property
    def largest(self) -> float:
        """The fraction that counts: the run ends when either limit is reached."""
        return max(self.by_steps or 0.0, self.by_time or 0.0)

    @property
    def seconds_by_time(self) -> float | None:
        """Seconds until the time limit; None without one, or before it began."""
        return self.seconds * (1 - self.by_time) / self.by_time if self.by_time else None


def time_limit(trainer: pl.Trainer) -> float | None:
    """Seconds that the fit may take; None without a limit."""
    timer = _timer(trainer)
    left = None if timer is None else timer.time_remaining()
    whole = None if timer is None or left is None else timer.time_elapsed() + left
    return getattr(timer, "seconds", whole)  # a budget counts its set-up, too


def fraction_done(trainer: pl.Trainer) -> Progress:
    """How much of ``max_steps`` and of ``max_time`` is used up."""
    by_steps = trainer.global_step / trainer.max_steps if trainer.max_steps > 0 else None
    timer = _timer(trainer)
    if timer is None:
        return Progress(by_steps, None, 0.0)
    elapsed, left = timer.time_elapsed(), timer.time_remaining()
    by_time = elapsed / (elapsed + left) if left is not None and elapsed + left > 0 else None
    return Progress(by_steps, by_time, elapsed)


def _timer(trainer: pl.Trainer) -> Timer | None:
    return next((c for c in trainer.callbacks if isinstance(c, Timer)), None)  # type: ignore[attr-defined]
