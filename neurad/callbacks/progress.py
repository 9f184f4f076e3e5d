"""The bar that shows how far a run is."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, cast

import lightning.pytorch as pl
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm

from neurad.core.ranges import NonNegative, checked
from neurad.training.schedule import fraction_done

if TYPE_CHECKING:
    from neurad.training.inverse import InverseRenderer


class Bar(TQDMProgressBar):
    """One line: iterations, losses, rays a second, albedo PSNR of the last evaluation, time left.

    Args:
        refresh_seconds: at most one update of the line in this time.
    """

    def __init__(self, refresh_seconds: NonNegative = 0.5) -> None:
        super().__init__(refresh_rate=1, leave=True)
        self.refresh_seconds = refresh_seconds
        checked(self)
        self._shown = 0.0
        self._begin = (0.0, 0, 0.0)

    def init_train_tqdm(self) -> Tqdm:
        """A bar over the run's limit rather than over an epoch, which means nothing here."""
        return Tqdm(
            leave=True,
            dynamic_ncols=True,
            bar_format="fit {percentage:3.0f}%|{bar:12}| {desc}",
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
        """Update the line, at most once in ``refresh_seconds``."""
        now = time.monotonic()
        if self.is_disabled or now - self._shown < self.refresh_seconds:
            return
        self._shown = now
        module = cast("InverseRenderer", pl_module)
        self.train_progress_bar.n = round(min(fraction_done(trainer).largest, 1.0) * 1000)
        self.train_progress_bar.set_description_str(self.text(trainer, module))

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Close the bar."""
        if not self.is_disabled:
            self.train_progress_bar.n = round(min(fraction_done(trainer).largest, 1.0) * 1000)
            self.train_progress_bar.set_description_str(self.text(trainer, cast("InverseRenderer", pl_module)))
        self.train_progress_bar.close()

    def text(self, trainer: pl.Trainer, module: InverseRenderer) -> str:
        """The text behind the bar."""
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
            now = fraction_done(trainer).largest
            left = seconds * (1 - now) / (now - done) if now > done else None
        if left is not None:
            parts.append(f"{int(left) // 60}:{int(left) % 60:02d} left")
        return ", ".join(parts)
