"""What the guide records of each iteration."""

from __future__ import annotations

from torch import Tensor

from neurad.core.frame import faceforward
from neurad.integrators.guide import Guide
from neurad.training.objective import IncidentSamples


def guide_samples(guide: Guide | None, arrived: IncidentSamples | None) -> tuple[Tensor, Tensor] | None:
    """What the light that arrived tells the guide, for :func:`teach`; None where there is nothing to tell."""
    if guide is None or arrived is None:
        return None
    return guide.bin_samples(arrived.si, faceforward(arrived.si), arrived.wi, arrived.light)


def update_guide(guide: Guide | None, seen: tuple[Tensor, Tensor] | None, iteration: int) -> None:
    """Let the iterations after ``iteration`` look where samples found light."""
    if guide is None or seen is None:
        return
    guide.record(*seen)
    if (iteration + 1) % guide.refresh == 0:
        guide.update()
