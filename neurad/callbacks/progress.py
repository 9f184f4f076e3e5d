"""The line that shows how far a fit is."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ProgressBar

from neurad.core.decibels import figure
from neurad.core.durations import clock
from neurad.runtime import progress
from neurad.training.schedule import fraction_done

if TYPE_CHECKING:
    from neurad.training.inverse import InverseRenderer

REFRESH = 0.5
"""Seconds between two updates of the line."""
LOGGED_EVERY = 30.0
"""Seconds between two lines where standard errors is no terminal but, say, a file."""


class Bar(ProgressBar):
    """One line: iterations, picture and albedo at the last evaluation and its age, time left.

    What comes before and after training has a line of its own, see :mod:`neurad.runtime.progress`. Where standard
    errors is no terminal there is a line every half minute.
    """

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True
        self._shown = 0.0
        self._began: tuple[float, float] | None = None

    def disable(self) -> None:
        """Show nothing: Lightning asks all processes but the first for it."""
        self._enabled = False

    def enable(self) -> None:
        """Show the line again."""
        self._enabled = True

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Show the line."""
        super().on_train_start(trainer, pl_module)
        self._began = None
        self._update(trainer, pl_module)

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Update the line, at most once in :data:`REFRESH` seconds."""
        if self._began is None:  # the first step compiles kernels, which says nothing about the others
            self._began = (time.monotonic(), fraction_done(trainer).by_steps or 0.0)
        every = REFRESH if progress.on_terminal() else LOGGED_EVERY
        if time.monotonic() - self._shown >= every:
            self._update(trainer, pl_module)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the last line standing; evaluations come before this callback."""
        if self._enabled and self._began is not None:
            text = self.text(trainer, cast("InverseRenderer", pl_module), progress.width(), ended=True)
            if progress.on_terminal():
                progress.finish(text)
            else:
                print(text.rstrip(), file=sys.stderr, flush=True)
        self._began = None
        progress.stage("writing")

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Leave the line as it was when the fit was stopped."""
        if self._enabled and self._began is not None:
            progress.finish(self.text(trainer, cast("InverseRenderer", pl_module), progress.width()))
        self._began = None

    def _update(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not self._enabled:
            return
        self._shown = time.monotonic()
        text = self.text(trainer, cast("InverseRenderer", module), progress.width())
        if progress.on_terminal():
            progress.show(text)
        else:
            print(text.rstrip(), file=sys.stderr, flush=True)

    def text(self, trainer: pl.Trainer, module: InverseRenderer, width: int, ended: bool = False) -> str:
        """The line of ``width`` columns; nothing is left to wait for where training has ``ended``."""
        done = 1.0 if ended else min(fraction_done(trainer).largest, 1.0)
        parts = [f"step {module.iteration}"]
        scores, age = _last_scores(trainer)
        found = [
            f"{name} {figure(scores[key], 1)}"
            for name, key in (("image", "psnr_srgb"), ("albedo", "albedo_psnr"))
            if key in scores
        ]
        if found:
            old = "" if ended or age < 1 else f" ({int(age)} s ago)" if age < 600 else f" ({int(age / 60)} m ago)"
            parts.append(f"{' '.join(found)} dB{old}")
        elif module.last_losses:
            parts.append(f"loss {sum(float(value) for value in module.last_losses.values()):.3g}")
        left = 0.0 if ended else self._left(trainer)
        parts += [] if left is None else [f"{clock(left)} left"]
        return progress.with_bar(f"fit {int(100 * done):3d}%", done, ", ".join(parts), width, progress.full())

    def _left(self, trainer: pl.Trainer) -> float | None:
        """Seconds until the nearer of the two limits; None as long as nobody knows."""
        now = fraction_done(trainer)
        ends = []
        if now.by_time:
            ends.append(now.seconds * (1.0 - now.by_time) / now.by_time)
        if now.by_steps and self._began is not None and now.by_steps > self._began[1]:
            begin, done = self._began
            ends.append((time.monotonic() - begin) * (1.0 - now.by_steps) / (now.by_steps - done))
        return min(ends, default=None)


def _last_scores(trainer: pl.Trainer) -> tuple[dict[str, float], float]:
    """Scores of the last evaluation of the fit, and their age in seconds."""
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if scores := getattr(callback, "last_scores", None):
            return scores, time.monotonic() - getattr(callback, "last_scored", time.monotonic())
    return {}, 0.0
