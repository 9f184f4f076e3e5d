"""What offsets between photographs say: by how many pixels photographs disagree, and which lie beside all others."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Self

import torch
from torch import Tensor

from neurad.core.records import FloatArray
from neurad.core.robust import NORMAL
from neurad.runtime.reading import listed

MIN_OFFSETS, MIN_OF_VIEW = 24, 8
"""Offsets below which all photographs together, and one of them, are not judged."""
SAID, BESIDE = 0.5, 1.0
"""Pixels from which on it is said that photographs disagree, and that a single one lies beside all others. Those of
exact rooms disagree by 0.05 at most, see docs/check.md."""
FARTHER = 4.0
"""Times what the others disagree by that a single one must lie beside them."""
NAMED = 6
"""Photographs that are named at most."""


@dataclass(frozen=True)
class TextureOffsets:
    """How far photographs lie beside each other, in pixels: root mean squares of what one of them is off by."""

    pixels: float
    """Offset of all photographs together, without those that lie beside all others; NaN where too few patches have a
    texture."""
    length: float
    """Offset of all photographs on the surfaces, in scene units."""
    views: FloatArray
    """Offset of each, in pixels [views]; NaN where it has too few patches."""
    beside: tuple[int, ...] = ()
    """Photographs that lie beside all others, the farthest first."""

    def sentences(self, names: Sequence[str]) -> list[str]:
        """What is wrong, in words; none where photographs agree, or where nobody knows."""
        said = []
        if self.pixels >= SAID:
            said.append(
                f"photographs disagree by {self.pixels:.1f} pixels where they show the same surfaces: textures finer "
                f"than {self.length:.2g} scene units are blurred; poses, lens or mesh are off by as much"
            )
        if self.beside:
            which_views = listed([f"{names[i]} ({self.views[i]:.1f} pixels)" for i in self.beside], NAMED)
            which = ("photographs of", "lie") if len(self.beside) > 1 else ("photograph of", "lies")
            said.append(
                f"the {which[0]} {which_views} {which[1]} beside what all others show of the same surfaces: "
                "check the pose"
            )
        return said


@dataclass(frozen=True)
class OffsetTable:
    """Patches that two photographs show, a row each."""

    first: Tensor
    """The photograph on whose pixels both are compared [n], int64 ..."""
    second: Tensor
    """... and the other one [n]."""
    place: Tensor
    """Middle of the patch in the world [n, 3], float64."""
    along: Tensor
    """Unit direction in the first photograph in which the offset is measured [n, 2]."""
    change: Tensor
    """Places in the second photograph by those in the first [n, 2, 2]."""
    offset: Tensor
    """By how many pixels of the first the second photograph lies aside of it there [n]."""
    error: Tensor
    """Standard errors [n]."""
    size: Tensor
    """Size of a pixel of the first on the surface, in scene units [n]."""

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Rows of all parts, one after the other."""
        if not parts:
            no, whole = torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.int64)
            return cls(whole, whole, no.view(0, 3), no.view(0, 2), no.view(0, 2, 2), no, no, no)
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def summary(self, views: int) -> TextureOffsets:
        """What the offsets say of so many photographs."""
        rows, beside = torch.ones_like(self.first, dtype=torch.bool), list[int]()
        each = torch.tensor([self._off_of(i, rows) for i in range(views)])
        for _ in range(views):
            # A photograph that is off moves the medians of those that it was compared with: one after the other.
            left = torch.tensor([self._off_of(i, rows) for i in range(views)])
            worst = int(left.nan_to_num(-1.0).argmax())
            others = self._off(rows & ~self.of(worst), MIN_OFFSETS)
            if not left[worst] > max(FARTHER * others, BESIDE):  # not either where nobody knows of the others
                break
            beside.append(worst)
            rows = rows & ~self.of(worst)
        pixels = self._off(rows, MIN_OFFSETS)
        length = pixels * float(self.size[rows].median()) if bool(rows.any()) else math.nan
        return TextureOffsets(pixels, length, each.float().numpy(), tuple(beside))

    def of(self, view: int) -> Tensor:
        """Rows that a photograph is one of the two of [n], bool."""
        return (self.first == view) | (self.second == view)

    def _off_of(self, view: int, rows: Tensor) -> float:
        """What a photograph is off by, of some rows: the median over the others that it was compared with, since what
        one of them shares with it may be a shadow or a reflection. NaN with fewer than two of them.
        """
        mine = rows & self.of(view)
        others = torch.unique((self.first + self.second - view)[mine]).tolist()
        if int(mine.sum()) < MIN_OF_VIEW or len(others) < 2:
            return math.nan
        return median(self._off(mine & self.of(other), 1) for other in others)

    def _off(self, rows: Tensor, least: int) -> float:
        """Root mean square of what one of two photographs is off by in both ways, of offsets of both in one way and
        without what their errors make of it; by their median, which highlights do not move.
        """
        if int(rows.sum()) < least:
            return math.nan
        spread = NORMAL * float(self.offset[rows].abs().median())
        return math.sqrt(max(spread**2 - float(self.error[rows].square().median()), 0.0))
