"""A module and a data module with the outward behaviour of the real ones, and nothing to render."""

import time
from dataclasses import dataclass, field

import lightning.pytorch as pl
import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset

from neurad.core.errors import InputError
from neurad.runtime.clock import training_seconds

NAMES = ("psnr_linear", "psnr_srgb", "albedo_psnr", "albedo_mape", "roughness_psnr", "roughness_mape")


@dataclass
class StandInEvaluation:
    scores: dict[str, float]
    maps: list[dict[str, np.ndarray]] = field(default_factory=list)
    environment: dict[str, np.ndarray] = field(default_factory=dict)


class Endless(IterableDataset):
    def __iter__(self):
        while True:
            yield 0


@dataclass(frozen=True)
class Size:
    width: int = 4
    depth: int = 1


class StandInData(pl.LightningDataModule):
    def __init__(
        self, root: str | None = None, scene: str | None = None, patches: int = 256, patch_size: int = 1, seed: int = 0
    ) -> None:
        super().__init__()
        self.root = root

    def setup(self, stage):
        if self.root is not None:
            raise InputError(f"{self.root}/transforms_train.json: no such file")

    def train_dataloader(self):
        return DataLoader(Endless(), batch_size=None)

    def val_dataloader(self):
        return DataLoader([0])

    test_dataloader = predict_dataloader = val_dataloader


class StandIn(pl.LightningModule):
    def __init__(
        self,
        size: Size = Size(),
        rate: float = 0.1,
        seed: int = 0,
        sleep: float = 0.0,
        fail_at: int = -1,
        interrupt_at: int = -1,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.size, self.rate, self.seed, self.sleep = size, rate, seed, sleep
        self.fail_at, self.interrupt_at = fail_at, interrupt_at
        self.iteration, self.rays, self.seconds_before = 0, 0, 0.0
        self.samples = 0
        self.last_losses: dict[str, float] = {}

    def configure_model(self):
        if not hasattr(self, "theta"):
            torch.manual_seed(self.seed)
            self.theta = torch.nn.Parameter(torch.rand(self.size.width))
            self.phi = torch.nn.Parameter(torch.rand(self.size.width))

    @property
    def train_seconds(self):
        return self.seconds_before + training_seconds()

    def configure_optimizers(self):
        return [torch.optim.Adam([p], self.rate) for p in (self.theta, self.phi)]

    def training_step(self, batch, index):
        draw = torch.rand(self.size.width, generator=torch.Generator().manual_seed(self.iteration))
        time.sleep(self.sleep)
        first, second = self.optimizers()
        second._on_before_step = second._on_after_step = lambda: None
        loss = ((self.theta - draw) ** 2).sum() + ((self.phi - self.theta.detach() * draw) ** 2).sum()
        first.zero_grad()
        second.zero_grad()
        self.manual_backward(loss)
        second.step()
        if self.iteration == self.fail_at:
            raise RuntimeError("a bug in the middle of a step")
        first.step()
        self.iteration += 1
        self.rays += 10
        self.last_losses = {"loss": float(loss.detach())}
        if self.iteration == self.interrupt_at:
            import os
            import signal

            os.kill(os.getpid(), signal.SIGINT)

    def validation_step(self, *_):
        pass

    test_step = predict_step = validation_step

    def evaluate(self, render_spp=4, glossy=False):
        value = float((self.theta.sum() + self.phi.sum()).detach())
        scores = {name + end: value for end in ("", "_seen") for name in NAMES}
        scores |= {"albedo_psnr_constant": 1.5, "albedo_psnr_constant_seen": 2.5}
        grey = np.full((6, 8, 3), 0.25, np.float32)
        one = {
            "render": 2 * grey, "photograph": 3 * grey, "albedo": grey, "albedo_true": grey, "roughness": grey[..., :1],
            "roughness_true": grey[..., :1], "residual": grey,
        }  # fmt: skip
        return StandInEvaluation(scores, [one])

    def on_save_checkpoint(self, checkpoint):
        checkpoint["neurad"] = {"iteration": self.iteration, "seconds": self.train_seconds, "rays": self.rays}

    def on_load_checkpoint(self, checkpoint):
        state = checkpoint["neurad"]
        self.iteration, self.seconds_before, self.rays = state["iteration"], state["seconds"], state["rays"]
