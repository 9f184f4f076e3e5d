"""When and how a fit asks the pixels that it never draws."""

from __future__ import annotations

import torch

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.assembly.training_views import TrainingViews
from neurad.core.protocols import PhotoSource
from neurad.metrics.pixel_derivatives import derivatives_of
from neurad.metrics.validation import LevelFit, fit_levels

FIRST, EVERY = 512, 4096
"""Factors are fitted after so many iterations, whenever their number has doubled, and at multiples of the second."""
LEAST = 256
"""Pixels of which fewer say nothing."""


def is_due(iteration: int) -> bool:
    """Whether the factors are to be fitted after this many iterations; of nothing else, so a continued run is the same."""
    doubled = iteration >= FIRST and iteration & (iteration - 1) == 0
    return doubled or (iteration > 0 and iteration % EVERY == 0)


def update_levels(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, iteration: int
) -> LevelFit | None:
    """Fit the factors of the averages' levels to the pixels that no batch draws, and keep them if that helps.

    They do not depend on what they were before. None where there are no such pixels, averages or levels.

    Args:
        assembly: of the run.
        views: the training views.
        photographs: of the training views.
        iteration: iterations done, the key of the random numbers.
    """
    average, materials = assembly.average, assembly.materials
    if average is None or not isinstance(materials, FittedMaterials) or len(dict(average.levels.items())) == 0:
        return None
    batch = photographs.validation_batch()
    if batch is None or len(batch.view) < LEAST:
        return None
    with torch.no_grad(), average.used(whole=True):
        pixels = derivatives_of(
            assembly.estimator, views.primary, batch, views.emitter_mask, assembly.settings.seed, iteration
        )
        found = None
        if pixels is not None and len(pixels) >= LEAST:
            epsilon = assembly.settings.objective.epsilon * views.mean_square_radiance
            found = fit_levels(pixels, materials, average.levels, epsilon)  # type: ignore[arg-type]
    average.levels.set(found.factors if found is not None and found.holds else None)
    return found
