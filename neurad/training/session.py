"""A training run without a trainer, for studies: the same parts and the same step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from neurad.assembly.build import Assembly, assemble
from neurad.assembly.settings import ModelSettings
from neurad.assembly.training_views import prepare_views
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.scene.description import Scene
from neurad.training.guard import Guard
from neurad.training.objective import make_objective
from neurad.training.optimizers import make_optimizers
from neurad.training.step import TrainingStep

PIXELS = 256
"""Pixels of a batch, as in the shipped configs."""


class MemoryPhotographs:
    """Photographs held in memory; each batch draws its pixels independently and uniformly.

    Args:
        scene: its training views are those of the photographs.
        photographs: linear colours [views, pixels, 3].
        pixels: of a batch.
        seed: of the draws.
    """

    has_alpha = False
    alpha = None
    streams = False
    pixel_multiplier = 1

    def __init__(self, scene: Scene, photographs: Tensor, pixels: int = PIXELS, seed: int = 0) -> None:
        self.scene, self.photographs, self.pixels, self.seed = scene, photographs, pixels, seed

    def mean_square(self, counted: Tensor | None = None) -> float:
        """Mean squared radiance of the pixels that count [views, pixels], bool; None for all."""
        square = self.photographs.double().square().mean(-1)
        kept = square if counted is None else square[counted.to(square.device)]
        return float(kept.mean()) if kept.numel() else 0.0

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """The batch of an iteration, on the device of the photographs."""
        device = self.photographs.device
        views, pixels = self.photographs.shape[:2]
        index = Stream(self.seed, iteration, rank, 5, device=device).integers(views * pixels, self.pixels)
        color = self.photographs.view(-1, 3)[index]
        return PixelBatch(index // pixels, index % pixels, color, torch.ones_like(color[:, 0]), iteration)


class TrainingRun:
    """The parts of a run and its step, driven by whoever holds it.

    Args:
        assembly: the parts, on the device that ``photographs`` bring their batches on.
        photographs: of the training views.
        emitters_train: let pixels that an emitter covers train too: where everything emits there are no others.
    """

    def __init__(self, assembly: Assembly, photographs: Any, emitters_train: bool = False) -> None:
        device = assembly.world.geometry.vertices.device
        self.assembly, self.photographs = assembly, photographs
        self.views = prepare_views(assembly, photographs, device, emitters_train, check_brightness=False)
        self.optimizers = make_optimizers(assembly)
        self.step = TrainingStep(
            assembly,
            make_objective(assembly, self.views),
            Guard(nn.ModuleDict(dict(assembly.modules()))),
            optimizers=self.optimizers,
            device=device,
        )

    @classmethod
    def of_scene(
        cls,
        scene: Scene,
        photographs: Any,
        settings: ModelSettings,
        device: torch.device | str = "cpu",
        emitters_train: bool = False,
    ) -> TrainingRun:
        """Build the parts from the scene.

        Args:
            scene: a checked scene.
            photographs: of its training views.
            settings: of the model.
            device: where everything is to lie.
            emitters_train: as above.
        """
        assembly = assemble(scene, settings, photographs.has_alpha, device)
        for _, part in assembly.modules():
            part.to(device)
        return cls(assembly, photographs, emitters_train)

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.step.counters.iteration

    def advance(self, progress: float) -> Tensor:
        """One iteration.

        Args:
            progress: fraction of the run that is over, in [0, 1], for the learning rates.

        Returns:
            The weighted sum of the losses.
        """
        return self.step(self.photographs.batch(self.iteration), progress)
