"""Whole fits through the trainer, on scenes held in memory, in a folder that is thrown away."""

import io
import logging
import tempfile
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import lightning.pytorch as pl
from torch.utils.data import DataLoader, IterableDataset

from benchmarks.photos import PhotosInMemory
from benchmarks.stress.fit import small_settings
from neurad.training.inverse import InverseRenderer


class Memory(PhotosInMemory, pl.LightningDataModule):
    """A data module whose photographs are tensors [views, pixels, 3]."""

    def __init__(self, scene, images, pixels=64):
        pl.LightningDataModule.__init__(self)
        PhotosInMemory.__init__(self, images, scene.train[0].camera.width, pixels)
        self.scene = scene

    def train_dataloader(self):
        return DataLoader(_Endless(self), batch_size=None)

    def transfer_batch_to_device(self, batch, device, dataloader_idx):
        return batch


class _Endless(IterableDataset):
    def __init__(self, data):
        self.data = data

    def __iter__(self):
        for iteration in range(1 << 30):
            yield self.data.batch(iteration)


def fit(scene, images, steps=3, **settings):
    """Train through the trainer and return the module and what was printed."""
    module = InverseRenderer(replace(small_settings(), **settings))
    printed = io.StringIO()
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.ERROR)
    bare = replace(scene, test=[])
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), redirect_stdout(printed), \
            redirect_stderr(printed):  # fmt: skip
        warnings.simplefilter("ignore")
        trainer = pl.Trainer(
            max_steps=steps, accelerator="cpu", devices=1, logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False, default_root_dir=Path(folder),
        )  # fmt: skip
        trainer.fit(module, Memory(bare, images))
    return module, printed.getvalue()
