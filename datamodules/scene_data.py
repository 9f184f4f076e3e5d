"""The data module: a scene, its training photographs, and batches of their pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset

from datamodules.image_cache import ImageCache, Survey, dataset_stats
from datamodules.pixels import breadth_at
from neurad.core.errors import InputError
from neurad.core.patch_sampler import PatchSampler, corners, draw
from neurad.core.records import PixelBatch, View
from neurad.scene.description import Scene
from neurad.scene.image_io import read_photograph
from neurad.scene.load import load_scene


class SceneData(pl.LightningDataModule):
    """Pixels of a scene's training photographs. Held-out photographs and ground-truth maps are never opened here.

    A batch is a pure function of seed, iteration and rank, so a continued run draws what it would have drawn.

    Args:
        root: a scene folder.
        scene: name of a built-in scene instead.
        patches: patches in a batch, of all views in turn.
        patch_size: side of a patch in pixels; 1 draws single pixels.
        pixel_multiplier: times as many patches, with as many times fewer positions in each pixel, in the first
            batches. It halves whenever the pixels have been visited a few times: at first too few pixels seen limits
            what is known, and noise later. A power of two.
        seed: of the draws.
        resident: training photographs in memory at once; the others are read from disk as their turn comes. None
            keeps all in memory.
        replace_every: iterations after which one of them is replaced, if not all are in memory.

    Raises:
        InputError: a number is not positive, or ``pixel_multiplier`` no power of two.
    """

    def __init__(
        self,
        root: str | None = None,
        scene: str | None = None,
        patches: int = 256,
        patch_size: int = 1,
        pixel_multiplier: int = 1,
        seed: int = 0,
        resident: int | None = None,
        replace_every: int = 16,
    ) -> None:
        super().__init__()
        numbers = {"patches": patches, "patch_size": patch_size, "replace_every": replace_every}
        for name, value in (numbers if resident is None else numbers | {"resident": resident}).items():
            if value < 1:
                raise InputError(f"--data.{name}: {value} is not a positive number")
        if pixel_multiplier < 1 or pixel_multiplier & (pixel_multiplier - 1):
            raise InputError(f"--data.pixel_multiplier: {pixel_multiplier} is not a power of two")
        self.root = root
        self.scene_name = scene
        self.patches = patches
        self.patch_size = patch_size
        self.pixel_multiplier = pixel_multiplier
        self.seed = seed
        self.resident = resident
        self.replace_every = replace_every
        self.wants_blurred = False
        """Whether streamed batches carry means over the pixels around theirs."""
        self._survey: Survey | None = None
        self._residents: ImageCache | None = None

    @property
    def streams(self) -> bool:
        """Whether photographs stay on disk, but for some of them."""
        return self.resident is not None and self.resident < len(self.scene.train)

    @cached_property
    def scene(self) -> Scene:
        """The scene, checked; read when first asked for."""
        return load_scene(self.root, self.scene_name)

    def setup(self, stage: str) -> None:
        """Read the scene and, for a fit, all training photographs; streamed ones are read by :meth:`survey`.

        Raises:
            InputError: anything in the folder is missing or wrong.
        """
        scene = self.scene
        if stage != "fit":
            return
        if not self.streams and self.mean_square() <= 0:
            raise InputError(f"scene {scene.name}: every training photograph is black")
        camera = scene.train[0].camera
        if self.patch_size > min(camera.width, camera.height):
            size = f"{camera.width} x {camera.height}"
            raise InputError(f"--data.patch_size: {self.patch_size} does not fit in photographs of {size} pixels")

    # ---- photographs

    @cached_property
    def _pixels(self) -> Tensor:
        """Training photographs [views, h * w, 3 or 4]."""
        views = self.scene.train
        if not views:
            raise InputError(f"scene {self.scene.name}: it has no training photographs")
        first = self._read(views[0])
        pixels = first.new_empty(len(views), *first.shape)
        pixels[0] = first
        for index, view in enumerate(views[1:], 1):
            image = self._read(view)
            self._check_channels(view, image, first.shape[-1])
            pixels[index] = image
        return pixels

    def _check_channels(self, view: View, image: Tensor, expected: int) -> None:
        if image.shape[-1] != expected:
            first = self.scene.train[0].image
            raise InputError(f"{view.image}: it has {image.shape[-1]} channels, but {first} has {expected}")

    @staticmethod
    def _read(view: View) -> Tensor:
        """One photograph [h * w, 3 or 4]."""
        if view.image is None:
            raise InputError(f"training view {view.name}: it has no photograph")
        image = read_photograph(view.image)
        height, width = image.shape[:2]
        expected = view.camera
        if (width, height) != (expected.width, expected.height):
            raise InputError(
                f"{view.image}: it has {width} x {height} pixels, its camera {expected.width} x {expected.height}"
            )
        return torch.from_numpy(image).view(height * width, -1)

    @cached_property
    def photographs(self) -> Tensor:
        """Linear colours of the training views, premultiplied by alpha [views, h * w, 3]."""
        return self._pixels[..., :3].contiguous()

    @cached_property
    def alpha(self) -> Tensor | None:
        """Coverage of the training views [views, h * w], or None if the photographs have no alpha channel."""
        if not self.has_alpha:
            return None
        alpha = self._pixels[..., 3].contiguous()
        empty = (alpha <= 0).all()
        if empty:
            raise InputError(f"scene {self.scene.name}: alpha is 0 in every training photograph")
        return alpha

    @cached_property
    def has_alpha(self) -> bool:
        """Whether the photographs have an alpha channel: the first of them tells, for scenes that have any."""
        if "_pixels" in self.__dict__:
            return self._pixels.shape[-1] == 4
        views = self.scene.train
        return bool(views) and views[0].image is not None and self._read(views[0]).shape[-1] == 4

    def mean_square(self, counted: Tensor | None = None) -> float:
        """Mean squared radiance of the training photographs, for the epsilon of relative losses.

        Args:
            counted: pixels that count [views, h * w], bool; None for all. Pixels with alpha 0 never do.
        """
        if self.streams:
            return self.dataset_stats(None if counted is None else ~counted).mean_square
        square = self.photographs.square().mean(-1)
        weight = torch.ones_like(square) if counted is None else counted.to(square)
        if self.alpha is not None:
            weight = weight * (self.alpha > 0)
        total = float(weight.sum(dtype=torch.float64))
        return float((square * weight).sum(dtype=torch.float64)) / total if total > 0 else 0.0

    # ---- photographs on disk

    def dataset_stats(self, left_out: Tensor | None = None) -> Survey:
        """Look at every training photograph once, without keeping it.

        Args:
            left_out: pixels that do not count [views, h * w], bool, such as those that show emitters; None for none.

        Raises:
            InputError: a photograph is missing or wrong, or alpha is 0 in all of them.
        """
        self._survey = dataset_stats(self._streamed, len(self.scene.train), left_out, self.seed)
        if not self._survey.foreground:
            raise InputError(f"scene {self.scene.name}: alpha is 0 in every training photograph")
        return self._survey

    def _streamed(self, index: int) -> Tensor:
        """One training photograph [h * w, 3 or 4]; also called from the thread that reads ahead."""
        view = self.scene.train[index]
        if view.image is not None and Path(view.image).is_file():
            # OpenEXR holds Python's lock while it waits for the disk; this does not.
            Path(view.image).read_bytes()
        image = self._read(view)
        self._check_channels(view, image, 4 if self.has_alpha else 3)
        return image

    def _window(self, iteration: int, rank: int) -> ImageCache:
        """The photographs in memory at an iteration."""
        found = self._residents
        if found is None or found.rank != rank:
            views = (self._survey or self.dataset_stats()).foreground
            found = self._residents = ImageCache(
                self._streamed, views, self.scene.train[0].camera, self.resident or 1, self.replace_every,
                self.patch_size, self.seed, rank,
            )  # fmt: skip
        found.move(iteration)
        return found

    # ---- batches

    @cached_property
    def _corners(self) -> PatchSampler:
        camera = self.scene.train[0].camera
        return corners(len(self.scene.train), self.patch_size, self.alpha, camera.width, camera.height, self.seed)

    @cached_property
    def _total(self) -> int:
        """Patches that make up all photographs, as far as they are drawn."""
        camera = self.scene.train[0].camera
        streamed = len(self.scene.train) * camera.width * camera.height
        return -(-(streamed if self.streams else int(self._corners.count.sum())) // self.patch_size**2)

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """The batch that belongs to an iteration, on the CPU: ``pixel_multiplier * patches * patch_size^2`` pixels."""
        camera = self.scene.train[0].camera
        window = self._window(iteration, rank) if self.streams else None
        pixel_multiplier, first = breadth_at(iteration, self.patches, self.pixel_multiplier, self._total)
        where = self._corners if window is None else window.corners()
        view, pixel = draw(
            where, first, pixel_multiplier * self.patches, self.seed, rank, self.patch_size, camera.width
        )
        if window is not None:
            return window.batch(view, pixel.long(), iteration, pixel_multiplier, self.wants_blurred)
        index = view * (camera.width * camera.height) + pixel
        color = self.photographs.view(-1, 3).index_select(0, index)
        alpha = torch.ones(len(index)) if self.alpha is None else self.alpha.view(-1).index_select(0, index)
        return PixelBatch(view, pixel, color, alpha, iteration, pixel_multiplier=pixel_multiplier)

    def transfer_batch_to_device(
        self, batch: PixelBatch | Tensor, device: torch.device, dataloader_idx: int
    ) -> PixelBatch | Tensor:
        """Move the tensors of a batch; its iteration is a plain number."""
        if isinstance(batch, Tensor):
            return batch.to(device)
        view, pixel, color, alpha = (x.to(device) for x in (batch.view, batch.pixel, batch.color, batch.alpha))
        blurred = None if batch.blurred is None else batch.blurred.to(device)
        return replace(batch, view=view, pixel=pixel, color=color, alpha=alpha, blurred=blurred)

    def train_dataloader(self) -> DataLoader[PixelBatch]:
        """Batches without end, from the iteration that the module has reached."""
        return DataLoader(_Batches(self), batch_size=None, num_workers=0)

    def val_dataloader(self) -> DataLoader[int]:
        """Indices of the held-out views, one an item."""
        return DataLoader(_Range(len(self.scene.test)), batch_size=1, num_workers=0)

    test_dataloader = val_dataloader
    predict_dataloader = val_dataloader


class _Batches(IterableDataset[PixelBatch]):
    """Every batch from the module's present iteration on."""

    def __init__(self, data: SceneData) -> None:
        self.data = data

    def __iter__(self) -> Iterator[PixelBatch]:
        trainer = self.data.trainer
        iteration, rank = 0, 0
        if trainer is not None:
            iteration, rank = int(getattr(trainer.lightning_module, "iteration", 0)), trainer.global_rank
        while True:
            yield self.data.batch(iteration, rank)
            iteration += 1


class _Range(Dataset[int]):
    """The numbers 0 .. count - 1."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> int:
        if not 0 <= index < self.count:
            raise IndexError(index)
        return index
