"""Where the recovery of roughness begins.

From a wide lobe no gradient leads to a near mirror: all pixels but those of a mirrored lamp get darker without it, and
those are too few to outweigh the rest. And while albedo and light are not known, their errors carry roughness to an end
of its range, from where next to no gradient leads back. So in the first iterations it stays as it is. Then the
photometric loss is looked at with all surfaces at each of a few roughnesses. If one of them is surely better than what
there is, the field goes on from there.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.distributed as dist
from torch import Tensor

from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.model_settings import ModelSettings
from neurad.core.parameters import ROUGHNESS
from neurad.core.protocols import Materials
from neurad.core.records import PixelBatch, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.fields.mlp import MLP
from neurad.training.objective import ObjectiveStep

AFTER = 48
"""Iterations before the look."""
LEVELS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8)
"""Roughnesses that are tried."""
BATCHES = 12
"""Batches that they are tried on."""
MIN_SIGMAS = 3.0
"""Standard errors, over batches, by which a level must be better than the field as it is. What a batch loses is
compared with what it loses in all: a few bright pixels of one batch outweigh all others, and are no more evidence."""


def roughness_begins(settings: ModelSettings) -> int:
    """Iterations before which roughness stays as it is: 0 in runs that do not look for where it begins."""
    return 0 if settings.roughness.begin == "middle" else AFTER


@dataclass(frozen=True)
class _AtLevel:
    """Materials with one roughness everywhere."""

    materials: Materials
    roughness: float

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """As it is."""
        return self.materials.albedo(si)

    def __call__(self, si: SurfaceInteraction) -> Surface:
        found = self.materials(si)
        return replace(found, roughness=torch.full_like(found.roughness, self.roughness))


@torch.no_grad()
def losses(objective: ObjectiveStep, batch: PixelBatch, stream: Callable[[], Stream]) -> Tensor:
    """Photometric losses of a batch with the materials as they are, and then at each level [1 + levels].

    Args:
        stream: the same random numbers at every call.
    """
    estimator = objective.estimator
    settings = replace(objective.settings, prior=0.0, lhs=0.0)
    tried = [estimator, *(replace(estimator, materials=_AtLevel(estimator.materials, level)) for level in LEVELS)]
    terms = [replace(objective, estimator=e, settings=settings)(batch, stream()).materials for e in tried]
    return torch.stack([term["photometric"][1].value for term in terms])


def best_level(found: Tensor) -> float | None:
    """The level to begin at from the losses of several batches [batches, 1 + levels]; None to go on as it is."""
    present, tried = found[:, :1], found[:, 1:]
    gain = (present - tried) / (present.abs() + tried.abs()).clamp_min(1e-30)  # losses without noise can be negative
    mean, error = gain.mean(0), gain.std(0) / math.sqrt(len(gain))
    mean = torch.where(mean > MIN_SIGMAS * error, mean, 0.0)
    return LEVELS[int(mean.argmax())] if bool((mean > 0).any()) else None


@torch.no_grad()
def choose_start(
    objective: ObjectiveStep, batches: Iterable[PixelBatch], key: tuple[int, ...], exchanges: bool
) -> float | None:
    """Look at the levels, and shift the field to the best one if it is surely better than the field as it is.

    Args:
        batches: pixels to look at; each process has its own.
        exchanges: whether other processes look, too.

    Returns:
        The level; None where the field stays as it is.
    """
    materials = objective.estimator.materials
    field = materials.recovered.get(ROUGHNESS.name) if isinstance(materials, FittedMaterials) else None
    if field is None or not isinstance(field.mlp, MLP):
        return None
    device = objective.emitter_mask.device
    rows, means = [], []
    for index, batch in enumerate(batches):
        rows.append(losses(objective, batch, partial(Stream, *key, index, device=device)))
        si = objective.primary(batch, 2, Stream(*key, index, device=device)).si
        means.append(materials(si).roughness[si.valid].mean())
    found = torch.cat((torch.stack(rows), torch.stack(means).unsqueeze(1)), 1)
    if exchanges:
        parts = [torch.empty_like(found) for _ in range(dist.get_world_size())]
        dist.all_gather(parts, found)
        found = torch.cat(parts)
    level = best_level(found[:, :-1])
    if level is not None:
        field.shift(float(found[:, -1].nanmean()), level)
    return level
