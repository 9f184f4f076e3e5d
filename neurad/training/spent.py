"""Seconds, processor time and rays of a fit, those before it was interrupted included."""

from collections.abc import Mapping
from typing import Any

from neurad.runtime.clock import processor_seconds, training_seconds


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
        """Seconds in which the fit's threads ran and waited."""
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
