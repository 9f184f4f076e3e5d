"""What the guide records of each iteration."""

from __future__ import annotations

from torch import Tensor

from neurad.core.frame import faceforward
from neurad.integrators.guide import Guide
from neurad.training.objective import GuideSamples


def bin_guide_samples(guide: Guide | None, samples: GuideSamples | None) -> tuple[Tensor, Tensor] | None:
    """Bins [n] of the guide's histogram and what is to be added there [n, 2]; None without a guide or samples."""
    if guide is None or samples is None:
        return None
    return guide.bin_samples(samples.si, faceforward(samples.si), samples.wi, samples.radiance)


def update_guide(guide: Guide | None, binned: tuple[Tensor, Tensor] | None, iteration: int) -> None:
    """Record the samples of ``iteration``; from time to time the directions of later iterations follow them."""
    if guide is None or binned is None:
        return
    guide.record(*binned)
    if (iteration + 1) % guide.refresh == 0:
        guide.update()
