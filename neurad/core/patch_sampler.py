"""Random patches of photographs, as a pure function of seed, patches drawn so far, and rank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from neurad.core.rng import Stream

_START, _ORDER = 0, 13  # last numbers of the streams' keys; the training step has streams of its own
_MIN_FOREGROUND = 0.5  # of the pixels of a patch


@dataclass(frozen=True)
class PatchSampler:
    """Draws square patches without replacement: views take turns, and so do the patches of each view.

    No patch is drawn a second time before every other patch of its view has been drawn. Compared with independent
    draws, which after one visit a pixel on average have left out a third of them, the kitchen gains 0.3 dB after 20 s.

    Attributes:
        views: indices of the views, in the order in which they take turns [m], int64.
        begin: first entry of each view's list in ``corners`` [m], int64; views may share a list.
        count: length of each view's list [m], int64.
        corners: row-major pixel indices of the patches' upper left pixels, in random order, int64 or int32.
        patch_size: side of a patch in pixels.
        width: of the photographs in pixels.
        seed: of the place in its list where each view begins.
    """

    views: Tensor
    begin: Tensor
    count: Tensor
    corners: Tensor
    patch_size: int
    width: int
    seed: int

    @classmethod
    def build(cls, views: int, patch_size: int, alpha: Tensor | None, width: int, height: int, seed: int) -> Self:
        """A sampler of the patches that lie inside the photographs.

        With alpha these are only the patches of which at least half is foreground (alpha > 0), so that at least half
        of any batch is; in a view that has no such patch, those with the most foreground. Views without any
        foreground are left out, since they contain no information about surfaces.

        Args:
            views: number of training views.
            patch_size: side of a patch in pixels, at most that of the photographs.
            alpha: coverage [views, height * width], or None.
            width: of the photographs in pixels.
            height: of the photographs in pixels.
            seed: of the order.
        """
        generator = Stream(seed, _ORDER).generator
        order = torch.randperm(views, generator=generator)
        column = torch.arange(width - patch_size + 1)
        row = torch.arange(height - patch_size + 1)
        inside = (row[:, None] * width + column).flatten()
        inside = inside[torch.randperm(len(inside), generator=generator)]
        begin, count = torch.zeros_like(order), torch.full_like(order, len(inside))
        everywhere = cls(order, begin, count, inside, patch_size, width, seed)
        if alpha is None:
            return everywhere
        chosen, lists = [], []
        for view in order.tolist():
            foreground = (alpha[view] > 0).view(1, height, width).float()
            fraction = torch.zeros(width * height)
            means = torch.nn.functional.avg_pool2d(foreground, patch_size, 1)[0]
            fraction.view(height, width)[: len(row), : len(column)] = means
            best = float(fraction.max())
            if best > 0:
                chosen.append(view)
                lists.append(inside[fraction[inside] >= min(_MIN_FOREGROUND, best) - 1e-6])
        if not chosen:
            return everywhere
        count = torch.tensor([len(entries) for entries in lists])
        return cls(torch.tensor(chosen), count.cumsum(0) - count, count, torch.cat(lists), patch_size, width, seed)

    @property
    def total(self) -> int:
        """Number of different patches."""
        return int(self.count.sum())

    def draw(self, first: int, patches: int, rank: int = 0) -> tuple[Tensor, Tensor]:
        """The pixels of one batch; each view has the same number of patches in it, give or take one.

        Args:
            first: number of patches in all earlier batches.
            patches: in this batch.
            rank: of the process; each begins elsewhere in the lists.

        Returns:
            View and row-major pixel index, patch by patch [patches * patch_size^2], int64.
        """
        views = len(self.views)
        number = torch.arange(first, first + patches)
        slot, turn = number % views, number // views
        start = torch.rand(views, generator=Stream(self.seed, rank, _START).generator, dtype=torch.float64)
        place = ((start * self.count).long()[slot] + turn) % self.count[slot]
        view, corner = self.views[slot], self.corners[self.begin[slot] + place].long()
        if self.patch_size == 1:
            return view, corner
        step = torch.arange(self.patch_size)
        offset = (step[:, None] * self.width + step).flatten()
        return view.repeat_interleave(len(offset)), (corner[:, None] + offset).flatten()
