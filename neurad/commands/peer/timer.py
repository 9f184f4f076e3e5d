"""A limit of time for ``neurad fit`` that counts as the peers' does."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from lightning.pytorch.callbacks import Timer

from neurad.core import clock


class TrainingTimer(Timer):
    """Ends a run after so many seconds from the start of its process, evaluations left out.

    ``max_time`` counts evaluations in, so a run that is evaluated often would train for less than its budget.

    Args:
        seconds: of training, start-up included.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__(duration=timedelta(seconds=seconds))

    def time_elapsed(self, stage: Any = "train") -> float:
        """Seconds of training so far."""
        return clock.training_seconds()
