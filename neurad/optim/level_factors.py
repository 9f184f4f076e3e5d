"""Factors of a field's levels: how much of what each of them has learnt is kept.

Photographs have noise, and the finest levels of a hash grid learn it: in veach-ajar albedo peaks after three minutes
and has lost 0.9 dB after eight. Training pixels that were never drawn have noise of their own, so a fit to them tells
signal from noise: one factor a level, a Wiener filter whose strength is cross-validated.
"""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from neurad.fields.hash_grid import HashGrid


class LevelFactors(nn.Module):
    """Factors [levels] of every hash grid in a module, ones at first. Results show them; training goes on with those
    below 1, see :meth:`shrink`.
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
