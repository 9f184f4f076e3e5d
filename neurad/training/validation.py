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
LEAST = 64
"""Pixels of which fewer say nothing."""
GROUPS = 2
"""Of samples in each half of a pixel: with one, noise of the samples hides what there is to see."""
WHOLE = 0.95
"""A level of which so much is kept counts as kept whole in what is said."""


def is_due(iteration: int) -> bool:
    """Whether factors are fitted after this many iterations; they alone decide, so a continued run is the same."""
    doubled = iteration >= FIRST and iteration & (iteration - 1) == 0
    return doubled or (iteration > 0 and iteration % EVERY == 0)


def update_levels(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, iteration: int
) -> list[LevelFit] | None:
    """Fit the factors of the averages' levels to the pixels that no batch draws, and keep them where that helps.

    They do not depend on what they were before. Rays are not counted: the last of these passes is made wherever a run
    is stopped. None where there are no such pixels or averages, or a field has no levels.

    Args:
        assembly: of the run.
        views: the training views.
        photographs: of the training views.
        iteration: iterations done, the key of the random numbers.
    """
    average, materials = assembly.average, assembly.materials
    if average is None or not isinstance(materials, FittedMaterials):
        return None
    fields = [materials.albedo] + ([] if materials.roughness is None else [materials.roughness])
    grids = [getattr(field, "grid", None) for field in fields]
    if any(grid is None or average.levels.of(grid) is None for grid in grids):
        return None
    batch = photographs.validation_batch()
    if batch is None or len(batch.view) < LEAST:
        return None
    if assembly.development is not None:
        batch = assembly.development(batch)
    with torch.no_grad(), average.used(whole=True), assembly.world.tracer.uncounted():
        pixels = derivatives_of(
            assembly.estimator, views.primary, batch, views.emitter_mask, assembly.settings.seed, iteration, GROUPS
        )
        found = None
        if pixels is not None and len(pixels) >= LEAST:
            epsilon = assembly.settings.objective.epsilon * views.mean_square_radiance
            found = fit_levels(pixels, materials, average.levels, epsilon)  # type: ignore[arg-type]
    average.levels.set(None if found is None else [fit.factors for fit in found])
    return found


def said(found: list[LevelFit] | None) -> str | None:
    """A sentence on what was found; None if the finest levels are kept whole."""
    parts = [
        f"{float(fit.factors[-1]):.2f} of {name}'s finest level"
        for name, fit in zip(("albedo", "roughness"), found or [], strict=False)
        if fit.holds and float(fit.factors[-1]) < WHOLE
    ]
    if not parts:
        return None
    return f"what is shown keeps {' and '.join(parts)}, by training pixels that were never drawn; the rest is noise"
