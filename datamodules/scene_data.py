"""The data module: a scene, its training photographs, and batches of their pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from datamodules.image_cache import ImageCache
from datamodules.settings import DataSettings
from datamodules.training_photographs import TrainingPhotographs
from neurad.core.errors import InputError
from neurad.core.patch_sampler import PatchSampler, validation_pixels
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.formats.load import load_scene
from neurad.images.development import Photography
from neurad.runtime.numbers import check_bright
from neurad.scene.description import Scene

_CANDIDATES = 14
"""Last number of the key of the candidates' stream; those of the patches are beside it."""
VALIDATION_PIXELS = 1 << 14
"""Most training pixels that are never drawn."""


class SceneData(pl.LightningDataModule, TrainingPhotographs):
    """Pixels of a scene's training photographs. Held-out photographs and ground-truth maps are never opened here.

    A batch is a pure function of seed, iteration and rank, so a continued run draws what it would have drawn.

    Raises:
        InputError: the response is none.
    """

    replace_every = 16
    """Iterations after which a photograph in memory is replaced, if not all are there."""

    def __init__(self, settings: DataSettings) -> None:
        super().__init__()
        self.settings = settings
        self.seed, self.resident, self.lamps_true = settings.seed, settings.resident, settings.lamps_true
        self.reader = settings.reader
        self._photography = Photography.of(vars(settings))
        self._with_blurred = False
        self._patches = 256 if settings.patches == "auto" else settings.patches  # the command line knows the device
        self._focused = self._times = 0
        self._cache: ImageCache | None = None

    @cached_property
    def scene(self) -> Scene:
        """The scene, checked; read at the first access."""
        own = self.settings
        return load_scene(own.root, own.scene, own.hold_out, self._photography, own.hints, self.reader)

    def relight(self, scene: Scene) -> None:
        """Take a scene of the same views and triangles from now on, in which other meshes or parts of them shine, or in
        which training cameras stand elsewhere.
        """
        self.__dict__["scene"] = scene

    def setup(self, stage: str) -> None:
        """Read the scene and, for a fit, all training photographs that are to stay in memory.

        Raises:
            InputError: anything in the folder is missing or wrong.
        """
        scene = self.scene
        if stage != "fit":
            return
        if not scene.train:
            raise InputError(
                f"scene {scene.name}: it has no photograph to learn from; put a transforms_train.json or a "
                "transforms.json and its photographs into the folder"
            )
        if not self.streams:
            stats = self.dataset_stats(self.ignored())
            check_bright(stats.mean_square_radiance, stats.brightest, scene.name)
        (width, height), side = min(self._sizes, key=min), self.settings.patch_size
        if side > min(width, height):
            raise InputError(f"--data.patch_size: {side} does not fit in photographs of {width} x {height} pixels")

    def request_blurred(self) -> None:
        """From now on every batch has ``blurred``."""
        self._with_blurred = True
        self._cache = None  # its photographs have no means

    def request_candidates(self, fraction: float, times: int) -> None:
        """From now on batches have fewer pixels in turn by ``fraction``, and ``times`` as many candidates for each that
        is missing: uniform draws. Where batches are made of patches they stay as they are.
        """
        if self.settings.patch_size == 1:
            self._focused, self._times = round(fraction * self._patches), times

    def over(self, scene: Scene, photographs: Tensor | None = None) -> SceneData:
        """A data module with the same settings over another scene.

        Args:
            photographs: of its training views [views, pixels, 3 or 4], kept in memory; None reads the views' files.
        """
        own = self.settings
        made = SceneData(
            DataSettings(
                patches=own.patches, patch_size=own.patch_size, seed=own.seed, resident=own.resident,
                hold_out=own.hold_out, validation_pixels=own.validation_pixels,
            )
        )  # fmt: skip
        made.scene = scene
        if photographs is not None:
            made._pixels = photographs
        return made

    def _window(self, iteration: int, rank: int) -> ImageCache:
        """The photographs in memory at an iteration."""
        cache = self._cache
        if cache is None or cache.rank != rank:
            views = (self._stats or self.dataset_stats()).foreground
            cache = self._cache = ImageCache(
                self._streamed_spread, views, self._sizes, self.resident or 1, self.replace_every,
                self.settings.patch_size, self.seed, rank, self._with_blurred, self._validation,
            )  # fmt: skip
        cache.move(iteration)
        return cache

    @cached_property
    def _validation(self) -> float:
        """Fraction of the pixels that are never drawn: more than :data:`VALIDATION_PIXELS` would say nothing more."""
        if self.settings.patch_size > 1:
            return 0.0
        return min(self.settings.validation_pixels, VALIDATION_PIXELS / max(sum(w * h for w, h in self._sizes), 1))

    def validation_batch(self) -> PixelBatch | None:
        """Pixels that no batch draws, on the CPU; None where all are drawn."""
        return self._validation_batch

    @cached_property
    def _validation_batch(self) -> PixelBatch | None:
        fraction, parts = self._validation, []
        read = self._streamed_spread if self.streams else self._resident
        for index, size in enumerate(self._sizes):
            pixel = validation_pixels(size, self.seed, fraction)
            if len(pixel):
                found = read(index)[pixel]
                alpha = found[:, 3] if self.has_alpha else torch.ones(len(pixel))
                parts.append((torch.full_like(pixel, index), pixel, found[:, :3], alpha))
        if not parts:
            return None
        view, pixel, color, alpha = (torch.cat(columns) for columns in zip(*parts, strict=True))
        return self._marked(PixelBatch(view, pixel, color, alpha, 0))

    def _marked(self, batch: PixelBatch) -> PixelBatch:
        """The batch, with what of it is clipped or rounded."""
        return batch if self._limits is None else self._limits.marked(batch)

    @cached_property
    def _sampler(self) -> PatchSampler:
        """Draws patches of all photographs, where they are in memory."""
        return PatchSampler.build(self._sizes, self.settings.patch_size, self.alpha, self.seed, self._validation)

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """The batch of an iteration, on the CPU: ``patches * patch_size^2`` pixels, fewer where candidates are wanted,
        and the candidates after them.
        """
        in_turn = self._patches - self._focused
        cache = self._window(iteration, rank) if self.streams else None
        sampler = self._sampler if cache is None else cache.sampler
        view, pixel = sampler.draw(iteration * in_turn, in_turn, rank)
        candidates = self._times * self._focused
        if candidates > 0:
            drawn = sampler.draw_uniform(candidates, Stream(self.seed, iteration, rank, _CANDIDATES))
            view, pixel = torch.cat((view, drawn[0])), torch.cat((pixel, drawn[1]))
        if cache is not None:
            return self._marked(replace(cache.batch(view, pixel, iteration), candidates=candidates))
        index = view * self.photographs.shape[1] + pixel
        color = self.photographs.view(-1, 3).index_select(0, index)
        alpha = torch.ones(len(index)) if self.alpha is None else self.alpha.view(-1).index_select(0, index)
        means = self._blurred.view(-1, 3).index_select(0, index) if self._with_blurred else None
        return self._marked(PixelBatch(view, pixel, color, alpha, iteration, means, candidates))

    def transfer_batch_to_device(
        self, batch: PixelBatch | Tensor, device: torch.device, dataloader_idx: int
    ) -> PixelBatch | Tensor:
        """Move the tensors of a batch; an index of a held-out view is a tensor of its own."""
        return batch.to(device)

    def train_dataloader(self) -> DataLoader[PixelBatch]:
        """Batches without end, from the iteration that the module has reached."""
        return DataLoader(_Batches(self), batch_size=None, num_workers=0)

    def val_dataloader(self) -> DataLoader[int]:
        """Indices of the views that are scored, one an item."""
        return DataLoader(range(len(self.scene.scored)), batch_size=1, num_workers=0)  # type: ignore[arg-type]

    test_dataloader = val_dataloader
    predict_dataloader = val_dataloader


class _Batches(IterableDataset[PixelBatch]):
    """Batches without end, from the iteration that the trainer's module has reached; from 0 without a trainer."""

    def __init__(self, data: SceneData) -> None:
        self.data = data

    def __iter__(self) -> Iterator[PixelBatch]:
        trainer = self.data.trainer
        iteration, rank = 0, 0
        if trainer is not None:
            module: Any = trainer.lightning_module
            iteration, rank = int(module.iteration), trainer.global_rank
        while True:
            yield self.data.batch(iteration, rank)
            iteration += 1
