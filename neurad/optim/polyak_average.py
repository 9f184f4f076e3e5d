"""Materials averaged over the last part of a run, which evaluations and results show.

While learning rates are high, parameters wander about the point that they are drawn to; their average lies closer to it
(Polyak and Juditsky 1992). Training itself never sees the average, but for levels that are noise in part.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn

from neurad.fields.hash_grid import HashGrid
from neurad.fields.segments import Segments

EVERY = 16
"""Iterations between two updates: tables are large, and neighbouring iterations much alike."""


class LevelFactors(nn.Module):
    """Factors [levels] of every hash grid in a module, ones at first: how much of what each level has learnt is kept.
    Results show them; training goes on with those below 1, see :meth:`shrink`.

    Photographs have noise, and the finest levels of a hash grid learn it: in veach-ajar albedo peaks after three
    minutes and has lost 0.9 dB after eight. Training pixels that were never drawn have noise of their own, so a fit to
    them tells signal from noise: one factor a level, a Wiener filter whose strength is cross-validated.
    """

    def __init__(self, part: nn.Module) -> None:
        super().__init__()
        self._grids = {  # not registered here
            name.replace(".", "_"): module for name, module in part.named_modules() if isinstance(module, HashGrid)
        }
        for name, grid in self._grids.items():
            self.register_buffer(name, torch.ones(grid.levels))

    def of(self, grid: nn.Module) -> Tensor | None:
        """The factors [levels] of a grid; None where it has no levels."""
        for name, own in self._grids.items():
            if own is grid:
                found: Tensor = getattr(self, name)
                return found
        return None

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Names of the grids and their factors."""
        for name in self._grids:
            yield name, getattr(self, name)

    @torch.no_grad()
    def set(self, factors: list[Tensor] | None) -> None:
        """Take over new factors of the first grids, and make all others 1."""
        for index, (_, own) in enumerate(self.items()):
            own.copy_(factors[index]) if factors is not None and index < len(factors) else own.fill_(1.0)

    @torch.no_grad()
    def scale(self) -> None:
        """Multiply the grids' tables, for good."""
        for name, factors in self.items():
            self._multiply(self._grids[name], self._grids[name].table, factors)

    @torch.no_grad()
    def shrink(self, parameters: Sequence[Tensor], averages: Sequence[Tensor]) -> None:
        """Multiply the grids' tables among ``parameters`` and their ``averages`` by the factors below 1, for good, and
        make these 1.
        """
        for name, factors in self.items():
            grid = self._grids[name]
            at = next(i for i, values in enumerate(parameters) if values is grid.table)
            for values in (grid.table, averages[at]):
                self._multiply(grid, values, factors.clamp(max=1.0))
            factors.clamp_(min=1.0)

    @staticmethod
    def _multiply(grid: HashGrid, table: Tensor, factors: Tensor) -> None:
        for (_, _, first, entries), factor in zip(grid.level_table.tolist(), factors.tolist(), strict=True):
            if factor != 1.0:
                table[first : first + entries].mul_(factor)


class PolyakAverage(nn.Module):
    """Moving average of a module's parameters. All of it is state, so a continued run has the same.

    Args:
        fraction: of the iterations so far that the average reaches back over, in (0, 1].
        every: iterations between two updates.
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
