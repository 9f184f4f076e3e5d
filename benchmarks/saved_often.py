"""Checkpoints that come more often than every minute, for fits whose steps take milliseconds."""

import json

import lightning.pytorch as pl

from neurad.callbacks import checkpoint


class SavedOften(pl.Callback):
    """Lets a fit write a checkpoint every so many seconds."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """From the first step on."""
        checkpoint.EVERY_SECONDS = self.seconds


def saved_every(seconds: float) -> list[str]:
    """Arguments of a fit for that."""
    name = f"{SavedOften.__module__}.{SavedOften.__qualname__}"
    callback = {"class_path": name, "init_args": {"seconds": seconds}}
    return ["--trust=benchmarks", f"--trainer.callbacks+={json.dumps(callback)}"]
