"""The data module: a scene, its training photographs, and batches of their pixels."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset

from datamodules.pixels import Corners, corners, draw
from neurad.core.errors import InputError
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
        patches: patches in a batch, each of a random view.
        patch_size: side of a patch in pixels; 1 draws single pixels.
        seed: of the draws.

    Raises:
        InputError: a number is not positive.
    """

    def __init__(
        self, root: str | None = None, scene: str | None = None, patches: int = 256, patch_size: int = 1, seed: int = 0
    ) -> None:
        super().__init__()
        for name, value in (("patches", patches), ("patch_size", patch_size)):
            if value < 1:
                raise InputError(f"--data.{name}: {value} is not a positive number")
        self.root = root
        self.scene_name = scene
        self.patches = patches
        self.patch_size = patch_size
        self.seed = seed

    @cached_property
    def scene(self) -> Scene:
        """The scene, checked; read when first asked for."""
        return load_scene(self.root, self.scene_name)

    def setup(self, stage: str) -> None:
        """Read the scene and, for a fit, all training photographs.

        Raises:
            InputError: anything in the folder is missing or wrong.
        """
        scene = self.scene
        if stage != "fit":
            return
        if self.mean_square() <= 0:
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
            if image.shape != first.shape:
                count = image.shape[-1], first.shape[-1]
                raise InputError(f"{view.image}: it has {count[0]} channels, but {views[0].image} has {count[1]}")
            pixels[index] = image
        return pixels

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
        square = self.photographs.square().mean(-1)
        weight = torch.ones_like(square) if counted is None else counted.to(square)
        if self.alpha is not None:
            weight = weight * (self.alpha > 0)
        total = float(weight.sum(dtype=torch.float64))
        return float((square * weight).sum(dtype=torch.float64)) / total if total > 0 else 0.0

    # ---- batches

    @cached_property
    def _corners(self) -> Corners:
        camera = self.scene.train[0].camera
        return corners(len(self.scene.train), self.patch_size, self.alpha, camera.width, camera.height)

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """The batch of ``patches * patch_size^2`` pixels that belongs to an iteration, on the CPU."""
        camera = self.scene.train[0].camera
        view, pixel = draw(
            self._corners, iteration, self.seed, rank, self.patches, self.patch_size, camera.width, camera.height
        )
        index = view * (camera.width * camera.height) + pixel
        color = self.photographs.view(-1, 3).index_select(0, index)
        alpha = torch.ones(len(index)) if self.alpha is None else self.alpha.view(-1).index_select(0, index)
        return PixelBatch(view, pixel, color, alpha, iteration)

    def transfer_batch_to_device(
        self, batch: PixelBatch | Tensor, device: torch.device, dataloader_idx: int
    ) -> PixelBatch | Tensor:
        """Move the tensors of a batch; its iteration is a plain number."""
        if isinstance(batch, Tensor):
            return batch.to(device)
        view, pixel, color, alpha = (x.to(device) for x in (batch.view, batch.pixel, batch.color, batch.alpha))
        return PixelBatch(view, pixel, color, alpha, batch.iteration)

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
