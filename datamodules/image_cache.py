"""Large photo sets: some photographs in memory, the others on disk, taking turns."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from datamodules.pixels import neighbourhood
from neurad.core.patch_sampler import PatchSampler, corners
from neurad.core.records import Camera, PixelBatch
from neurad.core.rng import Stream

SAMPLE = 1 << 16
"""Pixels of a survey's sample, all views together, or one of each view where there are more views."""
_ORDER, _SAMPLE = 11, 12  # last numbers of the streams' keys

Read = Callable[[int], Tensor]
"""Reads the photograph of a view [h * w, 3 or 4]."""


@dataclass(frozen=True)
class Survey:
    """What one look at every photograph tells."""

    mean_square: float
    """Mean squared radiance of the pixels that count."""
    foreground: list[int]
    """Views that have any pixel with alpha above 0."""
    sample: PixelBatch
    """Random pixels that count, equally many looked for in each view."""


def dataset_stats(read: Read, views: int, left_out: Tensor | None, seed: int) -> Survey:
    """Look at the photographs one after the other; one is in memory at a time.

    Args:
        read: reads a photograph.
        views: their number.
        left_out: pixels that do not count [views, h * w], bool; None for none. Pixels with alpha 0 never do.
        seed: of the sample.
    """
    total, square = 0, 0.0
    foreground: list[int] = []
    each = -(-SAMPLE // views)
    # Made beforehand: small tensors that stay, between large ones that come and go, would leave the heap full of holes.
    view_of, place = torch.empty(2, views * each, dtype=torch.int64)
    kept, filled = torch.empty(views * each, 3), 0
    for view in range(views):
        pixels = read(view)
        color = pixels[:, :3]
        alpha = pixels[:, 3] if pixels.shape[1] == 4 else None
        counts = torch.ones(len(pixels), dtype=torch.bool) if left_out is None else ~left_out[view]
        if alpha is not None:
            counts &= alpha > 0
        if alpha is None or bool((alpha > 0).any()):
            foreground.append(view)
        total += int(counts.sum())
        square += float((color.square().mean(-1) * counts).sum(dtype=torch.float64))
        pixel = Stream(seed, view, _SAMPLE).integers(len(pixels), each)
        pixel = pixel[counts[pixel]]
        here, filled = slice(filled, filled + len(pixel)), filled + len(pixel)
        view_of[here], place[here], kept[here] = view, pixel, color[pixel]
    sample = PixelBatch(view_of[:filled], place[:filled], kept[:filled], torch.ones(filled), 0)
    return Survey(square / total if total else 0.0, foreground, sample)


class ImageCache:
    """The photographs in memory, a window over a shuffled order of the views that moves on with the iterations.

    Iteration ``i`` sees places ``i // every`` to ``i // every + count - 1`` of the order, repeated without end: what is
    in memory is a function of the iteration, and every view is there equally long. The next one is read while the
    present ones are used.

    Args:
        read: reads a photograph; called in another thread.
        views: those that take part.
        camera: size of the photographs.
        count: photographs in memory; all of ``views`` where there are fewer.
        every: iterations after which one is replaced.
        patch_size: side of the patches to draw.
        seed: of the order.
        rank: each process has its own order.
    """

    def __init__(
        self,
        read: Read,
        views: list[int],
        camera: Camera,
        count: int,
        every: int,
        patch_size: int,
        seed: int,
        rank: int,
    ) -> None:
        self.seed = seed
        order = torch.randperm(len(views), generator=Stream(seed, rank, _ORDER).generator)
        self.order = [views[i] for i in order.tolist()]
        self.count = min(count, len(views))
        self.every = every
        self.rank = rank
        self.camera = camera
        self.patch_size = patch_size
        self._read = read
        self._tick = -1
        self._slots = [-1] * self.count
        self._next: tuple[int, Future[Tensor]] | None = None
        self._reader = ThreadPoolExecutor(1, "photographs")
        self._pixels = torch.empty(0)
        self._lists = torch.empty(0)
        self._where: PatchSampler | None = None

    @property
    def views(self) -> list[int]:
        """The views in memory."""
        return list(self._slots)

    def move(self, iteration: int) -> None:
        """Have in memory what the iteration sees.

        Raises:
            InputError: a photograph cannot be read any more.
        """
        tick = iteration // self.every
        if tick == self._tick:
            return
        for place in range(tick, tick + self.count):
            view, slot = self.order[place % len(self.order)], place % self.count
            if self._slots[slot] != view:
                self._slots[slot] = -1  # in case reading fails
                self._put(slot, self._take(view))
                self._slots[slot] = view
        self._tick = tick
        if self.count < len(self.order):
            view = self.order[(tick + self.count) % len(self.order)]
            if self._next is None or self._next[0] != view:
                self._next = view, self._reader.submit(self._read, view)

    def _take(self, view: int) -> Tensor:
        """The photograph of a view, as a rule one that was read meanwhile."""
        if self._next is not None and self._next[0] == view:
            future, self._next = self._next[1], None
            return future.result()
        return self._reader.submit(self._read, view).result()

    def _put(self, slot: int, pixels: Tensor) -> None:
        if not len(self._pixels):
            self._pixels = pixels.new_empty(self.count, *pixels.shape)
        self._pixels[slot] = pixels
        width, height, size = self.camera.width, self.camera.height, self.patch_size
        if pixels.shape[1] < 4:
            self._where = self._where or corners(self.count, size, None, width, height, self.seed)
            return
        found = corners(1, size, pixels[None, :, 3], width, height, self.seed).corner
        if self._where is None:
            most = (width - size + 1) * (height - size + 1)
            self._lists = torch.empty(self.count, most, dtype=torch.int32)
            slots = torch.arange(self.count)
            self._where = PatchSampler(slots, slots * most, torch.ones_like(slots), self._lists.view(-1))
        self._lists[slot, : len(found)] = found.int()
        self._where.count[slot] = len(found)

    def corners(self) -> PatchSampler:
        """Where patches may begin; the views in it are places in memory."""
        assert self._where is not None
        return self._where

    def batch(self, slot: Tensor, pixel: Tensor, iteration: int, pixel_multiplier: int, blurred: bool) -> PixelBatch:
        """Pixels of photographs in memory.

        Args:
            slot: places in memory [b], int64.
            pixel: row-major pixels [b], int64.
            iteration: that the batch belongs to.
            pixel_multiplier: times the usual number of pixels.
            blurred: whether to add the means around the pixels.
        """
        index = slot * self._pixels.shape[1] + pixel
        values = self._pixels.view(-1, self._pixels.shape[2]).index_select(0, index)
        alpha = values[:, 3].contiguous() if values.shape[1] == 4 else torch.ones(len(index))
        view = torch.tensor(self._slots)[slot]
        batch = PixelBatch(view, pixel, values[:, :3].contiguous(), alpha, iteration, pixel_multiplier=pixel_multiplier)
        if not blurred:
            return batch
        return replace(batch, blurred=neighbourhood(self._pixels, slot, pixel, self.camera.width))
