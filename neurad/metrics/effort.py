"""How much of large held-out views an evaluation during a fit looks at."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from neurad.core.scene_records import View

GRID = 4
"""Positions along a side of a pixel, if there is time for all."""
FEWER = 2
SECONDS = 30.0
"""That an evaluation may always take: no ordinary scene is cut."""
UNLIMITED = 60.0
"""That it may take in a run without a time limit."""
PER_FIT = 4
"""Evaluations that there must be time for in a run."""
MAX_SPP = 16
_SECONDS = 0.8e-6, 1.5e-6, 6e-6
"""Nominal seconds of a position, a sample and a pixel, as measured on one core; not of this machine, so that a run is
repeatable."""


@dataclass(frozen=True)
class EvaluationResolution:
    """Which pixels of the held-out views count, and how closely they are looked at."""

    grid: int = GRID
    """Each pixel is predicted at ``grid`` x ``grid`` positions."""
    stride: int = 1
    """Every so many-th row and column is looked at."""

    @property
    def whole(self) -> bool:
        """Whether nothing is left out."""
        return self == EvaluationResolution()


def seconds_of(views: Sequence[View], spp: int, effort: EvaluationResolution = EvaluationResolution()) -> float:
    """Nominal seconds of an evaluation.

    Args:
        spp: samples per pixel of the renderings; more than 16 count as 16, since who wants them has the time.
    """
    pixels = sum(
        math.ceil(view.camera.width / effort.stride) * math.ceil(view.camera.height / effort.stride) for view in views
    )
    position, sample, pixel = _SECONDS
    return pixels * (position * effort.grid**2 + sample * min(spp, MAX_SPP) + pixel)


def affordable(views: Sequence[View], spp: int, fraction: float, seconds: float | None) -> EvaluationResolution:
    """The effort of each evaluation of a fit: first fewer positions in a pixel, then fewer pixels.

    Args:
        spp: as in :func:`seconds_of`.
        fraction: of the training time that all evaluations together may take.
        seconds: of the fit; None without a time limit.
    """
    most = UNLIMITED if seconds is None else max(SECONDS, fraction * seconds / PER_FIT)
    if seconds_of(views, spp) <= most:
        return EvaluationResolution()
    stride = 1
    while seconds_of(views, spp, EvaluationResolution(FEWER, stride)) > most:
        stride += 1
    return EvaluationResolution(FEWER, stride)
