"""For photographs that do not fit in memory: a cache of some of them, statistics of all of them, and their blur."""

import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor

from neurad.core.patch_sampler import PatchSampler
from neurad.core.records import DatasetStats, PixelBatch
from neurad.core.rng import Stream
from neurad.runtime.progress import counted

SAMPLE = 1 << 16
"""Pixels in the sample of :func:`dataset_stats`, all views together, or one of each view where there are more views."""
MAX_EXTREME = 100.0
"""How many times brighter than one pixel in a hundred a photograph's pixels count for the unit of radiance."""
_WINDOW = 5
"""Side in pixels of the square that :func:`blurred` averages over."""
_ORDER, _SAMPLE = 11, 12  # last numbers of the streams' keys

Read = Callable[[int], Tensor]
"""Reads the photograph of a view [h * w, 3 or 4]."""


def dataset_stats(read: Read, views: int, left_out: Tensor | None, seed: int) -> DatasetStats:
    """Statistics of all photographs, with one of them in memory at a time.

    Args:
        left_out: pixels that do not count [views, h * w], bool; None for none. Pixels with alpha 0 never count.
    """
    total, square = 0, 0.0
    foreground: list[int] = []
    checksums: list[int] = []
    covered: list[int] = []
    each = -(-SAMPLE // views)
    # Allocated once: small tensors that stay, between large ones that come and go, would fragment the heap.
    view_of, place = torch.empty(2, views * each, dtype=torch.int64)
    kept, filled = torch.empty(views * each, 3), 0
    for view in counted(range(views), "reading", views, "photographs"):
        pixels = read(view)
        checksums.append(checksum(pixels))
        color = pixels[:, :3]
        alpha = pixels[:, 3] if pixels.shape[1] == 4 else None
        counts = torch.ones(len(pixels), dtype=torch.bool) if left_out is None else ~left_out[view, : len(pixels)]
        if alpha is not None:
            counts &= alpha > 0
        if alpha is None or bool((alpha > 0).any()):
            foreground.append(view)
        if alpha is not None and bool((alpha >= 1).all()):
            covered.append(view)
        total += int(counts.sum())
        square += float((_without_extremes(color.square().mean(-1)) * counts).sum(dtype=torch.float64))
        pixel = Stream(seed, view, _SAMPLE).integers(len(pixels), each)
        pixel = pixel[counts[pixel]]
        here, filled = slice(filled, filled + len(pixel)), filled + len(pixel)
        view_of[here], place[here], kept[here] = view, pixel, color[pixel]
    sample = PixelBatch(view_of[:filled], place[:filled], kept[:filled], torch.ones(filled), 0)
    return DatasetStats(square / total if total else 0.0, sample, foreground, tuple(checksums), total, tuple(covered))


def _without_extremes(square: Tensor) -> Tensor:
    """Squares [n] of a photograph's pixels, the brightest at most :data:`MAX_EXTREME` times one in a hundred: the sun
    itself in one pixel would make all else dark.
    """
    bright = square.kthvalue(max(int(0.99 * len(square)), 1)).values
    return square.clamp_max(MAX_EXTREME**2 * bright) if bright > 0 else square


def checksum(pixels: Tensor) -> int:
    """CRC-32 of a photograph [h * w, 3 or 4] as it was read."""
    return zlib.crc32(pixels.contiguous().numpy().data)


def blurred(photographs: Tensor, alpha: Tensor | None, width: int) -> Tensor:
    """Means over the 5 x 5 pixels around each pixel, as far as they lie in the photograph: normalisers of residuals.

    The residual of a pixel has the noise of the pixel's own photograph in it. A weight with the same noise would
    correlate with the residual and bias the result towards dark; the mean has little of it.

    Args:
        photographs: linear colours, premultiplied by alpha [views, h * w, 3].
        alpha: coverage [views, h * w], or None.
        width: of the photographs in pixels.

    Returns:
        Premultiplied colours [views, h * w, 3]; with alpha the mean is over what is covered.
    """
    if alpha is None:
        return _box_filtered(photographs, width)
    coverage = alpha.unsqueeze(-1)
    mean = _box_filtered(photographs, width) / _box_filtered(coverage, width).clamp_min(1e-6)
    return mean * coverage


def _box_filtered(values: Tensor, width: int) -> Tensor:
    """Means over 5 x 5 pixels, at the border over those inside [views, h * w, c]."""
    views, pixels, channels = values.shape
    image = values.view(views, pixels // width, width, channels).permute(0, 3, 1, 2)
    mean = torch.nn.functional.avg_pool2d(image, _WINDOW, 1, _WINDOW // 2, count_include_pad=False)
    return mean.permute(0, 2, 3, 1).reshape(views, pixels, channels)


class ImageCache:
    """Some of the photographs, a window over a shuffled order of the views that moves on with the iterations.

    Iteration ``i`` sees places ``i // every`` to ``i // every + count - 1`` of the order, repeated without end: what is
    in memory is a function of the iteration, and every view is in memory equally long. The next photograph is read
    while the present ones are in use.

    Args:
        read: reads a photograph; called in another thread.
        views: those that take part.
        sizes: width and height of every photograph in pixels; memory is taken for the largest of ``views``.
        count: photographs in memory; all of ``views`` where there are fewer.
        every: iterations after which one is replaced.
        rank: of the process; each has an order of its own.
        with_blurred: keep the photographs' means over 5 x 5 pixels too, and add them to batches.
        validation: fraction of the pixels that is never drawn.
    """

    def __init__(
        self,
        read: Read,
        views: list[int],
        sizes: Sequence[tuple[int, int]],
        count: int,
        every: int,
        patch_size: int,
        seed: int,
        rank: int,
        with_blurred: bool = False,
        validation: float = 0.0,
    ) -> None:
        self.seed = seed
        self.validation = validation
        order = torch.randperm(len(views), generator=Stream(seed, rank, _ORDER).generator)
        self.order = [views[i] for i in order.tolist()]
        self.count = min(count, len(views))
        self.every = every
        self.rank = rank
        self.sizes = sizes
        self._most = max(sizes[view][0] * sizes[view][1] for view in views)
        self.patch_size = patch_size
        self.with_blurred = with_blurred
        self._read = read
        self._tick = -1
        self._slots = [-1] * self.count
        self._next: tuple[int, Future[tuple[Tensor, Tensor | None]]] | None = None
        self._reader = ThreadPoolExecutor(1, "photographs")
        self._pixels = self._blurred = torch.empty(0)  # [count, h * w, 3 or 4], [count, h * w, 3]
        self._corners = torch.empty(0)
        self._sampler: PatchSampler | None = None

    @property
    def sampler(self) -> PatchSampler:
        """Draws patches of the photographs in memory; its views are slots of the cache."""
        assert self._sampler is not None, "move() comes first"
        return self._sampler

    def move(self, iteration: int) -> None:
        """Load what the iteration sees.

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
                self._put(slot, view, *self._take(view))
                self._slots[slot] = view
        self._tick = tick
        if self.count < len(self.order):
            view = self.order[(tick + self.count) % len(self.order)]
            if self._next is None or self._next[0] != view:
                self._next = view, self._reader.submit(self._load, view)

    def _load(self, view: int) -> tuple[Tensor, Tensor | None]:
        """The photograph of a view [h * w, 3 or 4] and, where wanted, its means over 5 x 5 pixels [h * w, 3]."""
        pixels = self._read(view)
        if not self.with_blurred:
            return pixels, None
        images = pixels.unsqueeze(0)
        alpha = images[..., 3] if images.shape[-1] == 4 else None
        return pixels, blurred(images[..., :3].contiguous(), alpha, self.sizes[view][0])[0]

    def _take(self, view: int) -> tuple[Tensor, Tensor | None]:
        """What :meth:`_load` returns; usually it has been read ahead."""
        if self._next is not None and self._next[0] == view:
            future, self._next = self._next[1], None
            return future.result()
        return self._reader.submit(self._load, view).result()

    def _put(self, slot: int, view: int, pixels: Tensor, means: Tensor | None) -> None:
        """Place a photograph in a slot, and update the list of the slot's patches."""
        if not len(self._pixels):
            self._pixels = pixels.new_empty(self.count, self._most, pixels.shape[1])
        self._pixels[slot, : len(pixels)] = pixels
        if means is not None:
            if not len(self._blurred):
                self._blurred = means.new_empty(self.count, self._most, 3)
            self._blurred[slot, : len(means)] = means
        size, patch = self.sizes[view], self.patch_size
        if pixels.shape[1] < 4 and len(set(self.sizes)) == 1:
            self._sampler = self._sampler or PatchSampler.build(
                [size] * self.count, patch, None, self.seed, self.validation
            )
            return
        alpha = pixels[None, :, 3] if pixels.shape[1] == 4 else None
        found = PatchSampler.build([size], patch, alpha, self.seed, self.validation).corners
        if self._sampler is None:
            self._corners = torch.empty(self.count, self._most, dtype=torch.int32)
            slots, ones = torch.arange(self.count), torch.ones(self.count, dtype=torch.int64)
            lists = self._corners.view(-1)
            self._sampler = PatchSampler(slots, slots * self._most, ones, lists, patch, ones.clone(), self.seed)
        self._corners[slot, : len(found)] = found.int()
        self._sampler.count[slot] = len(found)
        self._sampler.width[slot] = size[0]

    def batch(self, slot: Tensor, pixel: Tensor, iteration: int) -> PixelBatch:
        """Pixels of photographs in memory.

        Args:
            slot: slots of the cache [b], int64.
            pixel: row-major pixels [b], int64.
        """
        index = slot * self._pixels.shape[1] + pixel
        values = self._pixels.view(-1, self._pixels.shape[2]).index_select(0, index)
        alpha = values[:, 3].contiguous() if values.shape[1] == 4 else torch.ones(len(index))
        means = self._blurred.view(-1, 3).index_select(0, index) if self.with_blurred else None
        view = torch.tensor(self._slots)[slot]
        return PixelBatch(view, pixel, values[:, :3].contiguous(), alpha, iteration, means)
