"""Materials averaged over the last part of a run, which evaluations and results show.

While learning rates are high, parameters wander about the point that they are drawn to; their average lies closer to it
(Polyak and Juditsky 1992). Training itself never sees the average, but for levels that are noise in part.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn

from neurad.fields.segments import Segments
from neurad.optim.level_factors import LevelFactors

EVERY = 16
"""Iterations between two updates: tables are large, and neighbouring iterations much alike."""


class PolyakAverage(nn.Module):
    """Moving average of a module's parameters. All of it is state, so a continued run has the same.

    Args:
        fraction: of the iterations so far that the average reaches back over, in (0, 1].
    """

    updates: Tensor

    def __init__(self, part: nn.Module, fraction: float, every: int = EVERY) -> None:
        super().__init__()
        self._parameters_of = [p for p in part.parameters() if p.requires_grad]  # not registered here
        self.fraction, self.every = fraction, every
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        for index, p in enumerate(self._parameters_of):
            self.register_buffer(f"mean_{index}", p.detach().clone())
        self.levels = LevelFactors(part)
        """Factors of the levels of what is averaged; the module has them where it has the averages."""
        self._segments = [module for module in part.modules() if isinstance(module, Segments)]

    def _means(self) -> list[Tensor]:
        return [getattr(self, f"mean_{index}") for index in range(len(self._parameters_of))]

    def _values(self) -> list[Tensor]:
        return [p.detach() for p in self._parameters_of]

    @torch.no_grad()
    def update(self, iteration: int) -> None:
        """Take the parameters after ``iteration`` iterations into account."""
        if iteration % self.every == 0:
            weight = 1.0 if self.updates == 0 else min(1.0, self.every / (self.fraction * iteration))
            torch._foreach_lerp_(self._means(), self._values(), weight)
            self.updates += 1

    def copy_to_module(self) -> None:
        """Give the module the averages, times their levels' factors, for good, and let it show paint; before the first
        update it keeps what it has.
        """
        if self.updates > 0:
            torch._foreach_copy_(self._values(), self._means())
            self.levels.scale()
            self._show_paint()

    def _show_paint(self) -> None:
        for segments in self._segments:
            segments.shows_paint = True

    @torch.no_grad()
    def shrink(self) -> None:
        """Go on from tables of which the factors below 1 are a part: what they take out is noise, which training would
        learn again only slowly where few pixels show a place, and signal, which comes back.
        """
        self.levels.shrink(self._parameters_of, self._means())

    @contextmanager
    def used(self, whole: bool = False) -> Iterator[None]:
        """The module has the averages inside the block; before the first update it keeps its present ones.

        Args:
            whole: without the factors of the levels, and without paint.
        """
        if self.updates == 0:
            yield
            return
        values, means = self._values(), self._means()
        kept, showed = [value.clone() for value in values], [segments.shows_paint for segments in self._segments]
        torch._foreach_copy_(values, means)
        if not whole:
            self.levels.scale()
            self._show_paint()
        try:
            yield
        finally:
            torch._foreach_copy_(values, kept)
            for segments, shown in zip(self._segments, showed, strict=True):
                segments.shows_paint = shown


def averaged(average: PolyakAverage | None) -> AbstractContextManager[None]:
    """A block in which a module has its averages; nothing changes where there are none."""
    return nullcontext() if average is None else average.used()
