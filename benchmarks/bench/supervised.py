"""A step that fits the material fields to the true maps of the training views, in place of the objective."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from neurad.core.errors import InputError
from neurad.core.parameters import recovered
from neurad.core.protocols import Materials
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.integrators.primary_hits import PrimaryHits
from neurad.losses.relative import Loss
from neurad.metrics.held_out import HeldOut
from neurad.training.objective import StepTerms

SPP = 2
"""Samples per pixel of a batch."""


@dataclass(frozen=True)
class SupervisedStep:
    """Squared differences of box-filtered fields and true maps, in the place of ``ObjectiveStep``."""

    materials: Materials
    primary: PrimaryHits
    emitter_mask: Tensor
    truth: dict[str, Tensor]
    """By parameter, maps of the training views [views, pixels, channels]."""

    def __call__(self, batch: PixelBatch, stream: Stream) -> StepTerms:
        """Terms for a batch of pixels."""
        surface = self.materials(self.primary(batch, SPP, stream).si)
        counts = (~self.emitter_mask[batch.view, batch.pixel]).float().unsqueeze(-1)
        terms = {}
        for name, true in self.truth.items():
            mean = getattr(surface, name).view(len(counts), SPP, -1).mean(1)
            loss = (counts * (mean - true[batch.view, batch.pixel]) ** 2).mean()
            terms[name] = (1.0, Loss(loss, loss.detach()))
        return StepTerms(terms, {})


class TrueMaps(pl.Callback):
    """Puts a :class:`SupervisedStep` in the place of the module's objective when a fit starts.

    Raises:
        InputError: a training view has no true map.
    """

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Read the true maps, by the one reader of ground truth."""
        module: Any = pl_module
        scene, views = module.scene, module.step.objective
        reader = HeldOut(replace(scene, test=scene.train), module.assembly.world.geometry, module.assembly.world.tracer)
        names = [parameter.name for parameter in recovered(reader.scene.parameters)]
        parts: dict[str, list[Tensor]] = {name: [] for name in names}
        for index, view in enumerate(scene.train):
            found = reader.truth(index)
            for name in names:
                if f"{name}_true" not in found:
                    raise InputError(f"training view {view.name}: it has no true {name} to fit")
                image = torch.from_numpy(found[f"{name}_true"])
                parts[name].append(image.reshape(-1, image.shape[-1]))
        device = views.emitter_mask.device
        truth = {name: pad_sequence(maps, batch_first=True).to(device) for name, maps in parts.items()}
        module.step.objective = SupervisedStep(module.assembly.materials, views.primary, views.emitter_mask, truth)
