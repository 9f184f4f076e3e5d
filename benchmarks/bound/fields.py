"""The material fields fitted straight to the true maps of the training views."""

import time
from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.bench.supervised import SupervisedStep
from benchmarks.photos import PhotosInMemory
from neurad.assembly.model_settings import ModelSettings
from neurad.core.records import FloatArray
from neurad.metrics.held_out import HeldOut, Maps
from neurad.optim.polyak_average import averaged
from neurad.scene.description import Scene
from neurad.training.session import TrainingRun

PIXELS = 2048
"""Pixels of a batch: with no light to transport, more of them cost little."""


def training_run(scene: Scene, settings: ModelSettings, photographs: Sequence[FloatArray]) -> TrainingRun:
    """A run on photographs [h, w, 3] that does not train yet: camera rays and pixels that count are ready."""
    width = scene.train[0].camera.width
    images = torch.stack([torch.from_numpy(image).reshape(-1, 3) for image in photographs])
    return TrainingRun.of_scene(scene, PhotosInMemory(images, width, PIXELS), settings)


def fit_fields(run: TrainingRun, truth: dict[str, Tensor], seconds: float) -> None:
    """Train the run's material fields on true maps.

    Args:
        run: from :func:`training_run`.
        truth: ``albedo`` and ``roughness`` maps of the training views [views, pixels, channels].
        seconds: of processor time, so that a busy machine changes nothing.
    """
    run.step.objective = SupervisedStep(run.assembly.materials, run.views.primary, run.views.emitter_mask, truth)
    begin = time.process_time()
    while (spent := time.process_time() - begin) < seconds:
        run.advance(spent / seconds)


def predicted(run: TrainingRun, held_out: HeldOut) -> Sequence[Maps]:
    """What the run's materials, or their averages, are in the held-out views."""
    with averaged(run.assembly.average):
        return held_out.predict(run.assembly.materials)
