"""Random patches of photographs, as a pure function of seed, patches drawn so far, and rank."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from neurad.core.rng import Stream

_START, _ORDER, _VALIDATION = 0, 13, 17  # last numbers of the streams' keys; the training step has streams of its own
_MIN_FOREGROUND = 0.5  # of the pixels of a patch


@dataclass(frozen=True)
class PatchSampler:
    """Draws square patches without replacement: views take turns, and so do the patches of each view.

    No patch is drawn a second time before every other patch of its view has been drawn. Compared with independent
    draws, which after one visit a pixel on average have left out a third of them, the built-in patterned kitchen gains
    0.3 dB after 20 s.

    Attributes:
        views: indices of the views, in the order in which they take turns [m], int64.
        begin: first entry of each view's list in ``corners`` [m], int64; views may share a list.
        count: length of each view's list [m], int64.
        corners: row-major pixel indices of the patches' upper left pixels, in random order, int64 or int32.
        patch_size: side of a patch in pixels.
        width: of each view's photograph in pixels [m], int64.
        seed: of the place in its list where each view begins.
    """

    views: Tensor
    begin: Tensor
    count: Tensor
    corners: Tensor
    patch_size: int
    width: Tensor
    seed: int

    @classmethod
    def build(
        cls, sizes: Sequence[tuple[int, int]], patch_size: int, alpha: Tensor | None, seed: int, validation: float = 0.0
    ) -> Self:
        """A sampler of the patches that lie inside the photographs.

        With alpha these are only the patches of which at least half is foreground (alpha > 0), so that at least half
        of any batch is; in a view that has no such patch, those with the most foreground. Views without any
        foreground are left out, since they contain no information about surfaces.

        Args:
            sizes: width and height in pixels of each training view's photograph.
            patch_size: at most the side of the smallest photograph.
            alpha: coverage [views, pixels], row by row, those of a smaller photograph first; or None.
            validation: fraction of the pixels that is never drawn, see :func:`validation_pixels`; for single pixels.
        """
        generator = Stream(seed, _ORDER).generator
        order = torch.randperm(len(sizes), generator=generator)
        inside: dict[tuple[int, int], Tensor] = {}
        for size in sizes:  # photographs of one size share a list
            if size not in inside:
                rows, columns = torch.arange(size[1] - patch_size + 1), torch.arange(size[0] - patch_size + 1)
                corners = (rows[:, None] * size[0] + columns).flatten()
                if validation > 0:
                    corners = corners[~torch.isin(corners, validation_pixels(size, seed, validation))]
                inside[size] = corners[torch.randperm(len(corners), generator=generator)]
        count = torch.tensor([len(entries) for entries in inside.values()])
        kinds = torch.tensor([list(inside).index(size) for size in sizes])[order]
        width = torch.tensor([size[0] for size in sizes])
        everywhere = cls(
            order, (count.cumsum(0) - count)[kinds], count[kinds], torch.cat([*inside.values()]), patch_size,
            width[order], seed,
        )  # fmt: skip
        if alpha is None:
            return everywhere
        chosen, lists = [], []
        for view in order.tolist():
            entries = _on_foreground(inside[sizes[view]], alpha[view], sizes[view], patch_size)
            if len(entries):
                chosen.append(view)
                lists.append(entries)
        if not chosen:
            return everywhere
        views, count = torch.tensor(chosen), torch.tensor([len(entries) for entries in lists])
        return cls(views, count.cumsum(0) - count, count, torch.cat(lists), patch_size, width[views], seed)

    def draw(self, first: int, patches: int, rank: int = 0) -> tuple[Tensor, Tensor]:
        """The pixels of one batch; each view has the same number of patches in it, give or take one.

        Args:
            first: number of patches in all earlier batches.
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
        row, column = step.repeat_interleave(self.patch_size), step.repeat(self.patch_size)
        offset = self.width[slot].unsqueeze(1) * row + column  # [patches, patch_size^2]
        return view.repeat_interleave(offset.shape[1]), (corner.unsqueeze(1) + offset).flatten()

    def draw_uniform(self, patches: int, stream: Stream) -> tuple[Tensor, Tensor]:
        """Independent draws of upper left pixels, every view and in it every patch alike: view and row-major pixel
        index [patches], int64.
        """
        slot = stream.integers(len(self.views), patches)
        count = self.count[slot]
        place = (stream.uniform(patches).double() * count).long().clamp_max(count - 1)
        return self.views[slot], self.corners[self.begin[slot] + place].long()


def validation_pixels(size: tuple[int, int], seed: int, fraction: float) -> Tensor:
    """Pixels of a photograph of this size that are never drawn, the same ones in all photographs of one size: row-major
    indices [k], int64, in random order.
    """
    pixels = size[0] * size[1]
    return torch.randperm(pixels, generator=Stream(seed, *size, _VALIDATION).generator)[: round(fraction * pixels)]


def _on_foreground(corners: Tensor, alpha: Tensor, size: tuple[int, int], patch_size: int) -> Tensor:
    """Those of the patches at ``corners`` with enough foreground in a photograph's ``alpha``; none where all is 0."""
    width, height = size
    foreground = (alpha[: width * height] > 0).view(1, height, width).float()
    fraction = torch.zeros(width * height)
    means = torch.nn.functional.avg_pool2d(foreground, patch_size, 1)[0]
    fraction.view(height, width)[: means.shape[0], : means.shape[1]] = means
    best = float(fraction.max())
    return corners[fraction[corners] >= min(_MIN_FOREGROUND, best) - 1e-6] if best > 0 else corners[:0]
