"""What is fixed before the first step: the training views' camera rays, emitter pixels and unit of radiance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.exposure import brightness, mean_square_radiance, random_pixels, warn_if_far
from neurad.core.errors import InputError
from neurad.integrators.primary_hits import PrimaryHits
from neurad.losses.relative import blurred


@dataclass(frozen=True)
class TrainingViews:
    """The training views of a run."""

    primary: PrimaryHits
    """Camera rays of the views."""
    emitter_mask: Tensor
    """Pixels that an emitter covers, in part or whole; they train nothing [views, pixels], bool."""
    mean_square_radiance: float
    """Of all other pixels of the photographs."""
    blurred: Tensor | None = field(default=None, repr=False)
    """Photographs without their noise, where residuals are relative to them [views, pixels, 3]."""


def prepare_views(
    assembly: Assembly,
    photographs: Any,
    device: torch.device | str = "cpu",
    emitters_train: bool = False,
    check_brightness: bool = True,
) -> TrainingViews:
    """Trace the camera rays of the training views, and take the unit of radiance from the photographs.

    The radiance field and an environment that is recovered get that unit: the root of the mean squared radiance.

    Args:
        assembly: on ``device`` already.
        photographs: of the training views.
        device: where the rays are traced.
        emitters_train: let pixels that an emitter covers train too: where everything emits there are no others.
        check_brightness: warn if the photographs are far brighter or darker than the lights make the scene.

    Raises:
        InputError: every pixel shows an emitter, or every photograph is black.
    """
    scene, settings = assembly.scene, assembly.settings
    settings.sampling.split_over(getattr(photographs, "pixel_multiplier", 1))  # refuses what cannot be
    cameras = [view.camera for view in scene.train]
    # Stage 1: primary hits and the emitter mask [views, pixels].
    primary = PrimaryHits(assembly.world, cameras, settings.sampling.cached_spp, settings.seed, torch.device(device))
    emitter_mask = primary.sees_emitter()
    if emitters_train:
        emitter_mask = torch.zeros_like(emitter_mask)
    if bool(emitter_mask.all()):
        raise InputError(f"scene {scene.name}: every pixel of every training view shows an emitter")
    # Stage 2: the unit of radiance.
    mean_square, sample = mean_square_radiance(photographs, emitter_mask, settings.objective.firefly_clamp)
    if assembly.environment is not None:
        assembly.environment.set_unit(math.sqrt(mean_square))
    elif check_brightness:
        shown = random_pixels(photographs.photographs, emitter_mask, settings.seed) if sample is None else sample
        warn_if_far(brightness(primary, shown, settings.seed))
    if assembly.radiance is not None:
        assembly.radiance.set_scale(math.sqrt(mean_square))
    return TrainingViews(primary, emitter_mask, mean_square, _blurred(assembly, photographs, cameras[0].width, device))


def _blurred(assembly: Assembly, photographs: Any, width: int, device: torch.device | str) -> Tensor | None:
    """Means over 5 x 5 pixels where residuals are relative to them [views, pixels, 3]; None where they are not, and
    where batches of streamed photographs bring them.
    """
    kind = assembly.settings.objective.normaliser
    if kind == "blurred" or (kind == "prediction" and not assembly.settings.method.needs_field):
        if getattr(photographs, "streams", False):
            photographs.wants_blurred = True
            return None
        return blurred(photographs.photographs, photographs.alpha, width).to(device)
    return None
