"""Training photographs held in memory, for benchmarks on scenes without files."""

from collections.abc import Callable

import torch
from torch import Tensor

from datamodules.fireflies import find_fireflies, spread_fireflies
from datamodules.image_cache import blurred, dataset_stats
from neurad.core.protocols import PhotoSource
from neurad.core.records import DatasetStats, PixelBatch
from neurad.core.rng import Stream


class PhotosInMemory(PhotoSource):
    """Photographs without alpha, of which a batch holds random pixels.

    Args:
        images: photographs [views, h * w, 3].
        width: of the photographs in pixels.
        pixels: in a batch.
        seed: of the draws.
    """

    has_alpha = False

    def __init__(self, images: Tensor, width: int, pixels: int = 64, seed: int = 0) -> None:
        self.photographs, self.width, self.pixels, self.seed = images, width, pixels, seed
        self._means: Tensor | None = None

    def dataset_stats(self, left_out: Tensor | None = None) -> DatasetStats:
        """Statistics of all pixels but those ``left_out`` [views, pixels], bool."""
        return dataset_stats(lambda view: self.photographs[view], len(self.photographs), left_out, self.seed)

    def colors(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Photographed radiance [n, 3] of pixels [n] of views [n]."""
        return self.photographs[view, pixel]

    def spread_fireflies(self, left_out: Tensor, beyond: Callable[[], Tensor] | None = None) -> float:
        """As the data module of scene folders does; the tensor that was given stays as it was."""
        read, widths = self.photographs.__getitem__, [self.width] * len(left_out)
        found, masks = find_fireflies(read, left_out.unbind(), widths, beyond)
        if not found.spread:
            return 0.0
        pairs = zip(self.photographs, masks, strict=True)
        self.photographs = torch.stack([spread_fireflies(image, mask, self.width) for image, mask in pairs])
        return found.light

    def request_blurred(self) -> None:
        """From now on every batch has ``blurred``."""
        self._means = blurred(self.photographs, None, self.width)

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """The random pixels of an iteration."""
        views, count = self.photographs.shape[:2]
        index = Stream(self.seed, iteration, 5).integers(views * count, self.pixels)
        means = None if self._means is None else self._means.view(-1, 3)[index]
        color = self.photographs.view(-1, 3)[index]
        return PixelBatch(index // count, index % count, color, torch.ones(len(index)), iteration, means)
