"""How far a run is, and the bar that shows it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Timer, TQDMProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm

if TYPE_CHECKING:
    from neurad.module.inverse import InverseRenderer


@dataclass(frozen=True)
class Progress:
    """Shares of a run's limits that are used up; None where there is no such limit."""

    by_steps: float | None
    by_time: float | None
    seconds: float
    """Seconds of the fit so far, those of an interrupted run included."""

    @property
    def largest(self) -> float:
        """The share that counts: the run ends when either limit is reached."""
        return max(self.by_steps or 0.0, self.by_time or 0.0)

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the nearer limit at the average speed so far; None if it cannot be told."""
        shares = [share for share in (self.by_steps, self.by_time) if share]
        return min((self.seconds * (1 - share) / share for share in shares), default=None)


def fraction_done(trainer: pl.Trainer) -> Progress:
    """How much of ``max_steps`` and of ``max_time`` is used up."""
    by_steps = trainer.global_step / trainer.max_steps if trainer.max_steps > 0 else None
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, Timer):
            elapsed, left = callback.time_elapsed(), callback.time_remaining()
            by_time = elapsed / (elapsed + left) if left is not None and elapsed + left > 0 else None
            return Progress(by_steps, by_time, elapsed)
    return Progress(by_steps, None, 0.0)


class Bar(TQDMProgressBar):
    """One line: iterations, losses, rays a second, albedo PSNR of the last evaluation, time left.

    Args:
        refresh_seconds: at most one update of the line in this time.
    """

    def __init__(self, refresh_seconds: float = 0.5) -> None:
        super().__init__(refresh_rate=1, leave=True)
        self.refresh_seconds = refresh_seconds
        self._shown = 0.0
        self._begin = (0.0, 0, 0.0)

    def init_train_tqdm(self) -> Tqdm:
        """A bar over the run's limit rather than over an epoch, which means nothing here."""
        return Tqdm(
            desc="fit",
            leave=True,
            dynamic_ncols=True,
            bar_format="{desc}: {percentage:3.0f}%|{bar:12}| {postfix}",
            total=1000,
            file=None,
        )

    def init_validation_tqdm(self) -> Tqdm:
        """No bar: there is nothing to count."""
        return Tqdm(disable=True)

    def init_test_tqdm(self) -> Tqdm:
        """No bar: there is nothing to count."""
        return Tqdm(disable=True)

    def init_predict_tqdm(self) -> Tqdm:
        """No bar: there is nothing to count."""
        return Tqdm(disable=True)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Open the bar and note where counting starts."""
        super().on_train_start(trainer, pl_module)
        module = cast("InverseRenderer", pl_module)
        self._begin = (time.monotonic(), module.rays, fraction_done(trainer).largest)

    def on_train_epoch_start(self, trainer: pl.Trainer, *_: Any) -> None:
        """The bar goes on."""

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The bar goes on."""

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Update the line, not more often than eyes can follow."""
        now = time.monotonic()
        if self.is_disabled or now - self._shown < self.refresh_seconds:
            return
        self._shown = now
        module = cast("InverseRenderer", pl_module)
        self.train_progress_bar.n = round(min(fraction_done(trainer).largest, 1.0) * 1000)
        self.train_progress_bar.set_postfix_str(self.text(trainer, module), refresh=True)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Close the bar."""
        if not self.is_disabled:
            self.train_progress_bar.n = round(min(fraction_done(trainer).largest, 1.0) * 1000)
            self.train_progress_bar.set_postfix_str(self.text(trainer, cast("InverseRenderer", pl_module)))
        self.train_progress_bar.close()

    def text(self, trainer: pl.Trainer, module: InverseRenderer) -> str:
        """What stands behind the bar."""
        begin, rays, done = self._begin
        seconds = max(time.monotonic() - begin, 1e-9)
        parts = [f"step {module.iteration}"]
        parts += [f"{name} {float(value):.3g}" for name, value in module.last_losses.items()]
        parts.append(f"{(module.rays - rays) / seconds / 1e6:.2f} Mrays/s")
        for callback in trainer.callbacks:  # type: ignore[attr-defined]
            if "albedo_psnr" in getattr(callback, "last_scores", {}):
                parts.append(f"albedo {callback.last_scores['albedo_psnr']:.2f} dB")
        left = fraction_done(trainer).seconds_left
        if left is None or left == 0.0:
            share = fraction_done(trainer).largest
            left = seconds * (1 - share) / (share - done) if share > done else None
        if left is not None:
            parts.append(f"{int(left) // 60}:{int(left) % 60:02d} left")
        return ", ".join(parts)
