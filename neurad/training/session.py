"""A training run without a trainer, for benchmarks: the parts and the step of a fit."""

from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn

from neurad.assembly.build import Assembly, assemble
from neurad.assembly.model_settings import ModelSettings
from neurad.core.protocols import PhotoSource
from neurad.scene.description import Scene
from neurad.tracing.select import tracer_for
from neurad.training.guard import Guard
from neurad.training.optimizers import make_optimizers
from neurad.training.prepared_scene import prepare_scene
from neurad.training.schedule import Progress
from neurad.training.step import TrainingStep
from neurad.training.training_views import prepare_views


class TrainingRun:
    """The parts of a run and its step, driven by whoever holds it.

    Args:
        emitters_train: let pixels that an emitter covers train too: where everything emits there are no others.
    """

    def __init__(self, assembly: Assembly, photographs: PhotoSource, emitters_train: bool = False) -> None:
        self.assembly, self.photographs = assembly, photographs
        self.views = prepare_views(assembly, photographs, emitters_train, check_brightness=False)
        self.optimizers = make_optimizers(assembly)
        self.step = TrainingStep(
            assembly,
            self.views,
            photographs,
            Guard(nn.ModuleDict(dict(assembly.modules()))),
            optimizers=self.optimizers,
        )

    @classmethod
    def of_scene(
        cls,
        scene: Scene,
        photographs: PhotoSource,
        settings: ModelSettings,
        device: torch.device | str = "cpu",
        emitters_train: bool = False,
    ) -> Self:
        """Build the parts from the scene.

        Args:
            emitters_train: as above; the materials of emitting surfaces are then fitted, too.
        """
        settings = replace(settings, tracer=tracer_for(settings.tracer, device))
        scene = prepare_scene(scene, photographs, settings, device).scene
        assembly = assemble(scene, settings, photographs.has_alpha, device, not emitters_train)
        for _, part in assembly.modules():
            part.to(device)
        return cls(assembly, photographs, emitters_train)

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.step.counters.iteration

    def advance(self, progress: float) -> Tensor:
        """One iteration, where the fraction ``progress`` of the run is over; the weighted sum of the losses."""
        batch = self.photographs.batch(self.iteration).to(self.step.device)
        return self.step(batch, Progress(progress, None, 0.0))
