"""When and how a fit asks the pixels that it never draws."""

import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.parameters import PARAMETERS
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.evidence.pixel_derivatives import derivatives_of
from neurad.evidence.validation import LevelFit, fit_levels
from neurad.training.training_views import TrainingViews

EVERY = 256
"""Iterations after which training goes on from what is kept: noise comes back in some thousands. They alone decide, so
that a continued run is the same."""
MIN_PIXELS = 64
"""Pixels of which fewer say nothing."""
GROUPS = 2
"""Groups of samples in each half of a pixel for what is shown: one alone leaves too much noise of the samples."""
SETTLED = 0.9
"""Fraction of the way to the end of the learning rates, which are at a fortieth then."""
WHOLE = 0.95
"""A level of which so much is kept counts as kept whole in what is said."""


def shrink_levels(assembly: Assembly, views: TrainingViews, photographs: PhotoSource, iteration: int) -> None:
    """Let training go on from what the pixels that no batch draws confirm of each level of the albedo. Of the roughness
    they confirm no noise while a fit runs: factors below 1 are as rare as chance makes them.
    """
    batch = photographs.validation_batch()
    if assembly.average is None or batch is None:
        return
    found = _fit(assembly, views, batch, iteration, quick=True)
    clear = [_noise_alone(fit.factors) if fit.is_clear else torch.ones_like(fit.factors) for fit in found or []]
    assembly.average.levels.set(clear or None)
    assembly.average.shrink()


def _noise_alone(factors: Tensor) -> Tensor:
    """What factors take out of the levels as noise: no factor above 1, and no level's below any that is finer, since
    more pixels show each entry of its table. A coarse level that is damped by mistake loses signal everywhere.
    """
    return factors.flip(0).cummax(0).values.flip(0).clamp(max=1.0)


def update_levels(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, iteration: int, settled: bool
) -> str | None:
    """Fit the factors of the averages' levels to the pixels that no batch draws, and keep them where that helps.

    While learning rates are high coarse levels are asked for changes that are not right, probably as the radiance field
    is that of the present materials and not of their averages: then only noise is taken out. Factors do not depend on
    what they were before. Rays are not counted: the last of these passes is made wherever a run is stopped. Returns a
    sentence on what was found; None where the finest levels are kept whole, where there are no such pixels or averages,
    or where a field has no levels.

    Args:
        iteration: iterations done, the key of the random numbers.
        settled: whether learning rates have come down.
    """
    batch = photographs.validation_batch()
    if assembly.average is None or batch is None:
        return None
    found = _fit(assembly, views, batch, iteration)
    shown = [fit.factors if settled else _noise_alone(fit.factors) for fit in found or []]
    assembly.average.levels.set(shown or None)
    return _summary(found)


def _fit(
    assembly: Assembly, views: TrainingViews, batch: PixelBatch, iteration: int, quick: bool = False
) -> list[LevelFit] | None:
    average, materials = assembly.average, assembly.materials
    if average is None or not isinstance(materials, FittedMaterials):
        return None
    if any(average.levels.of(field.grid) is None for field in materials.recovered.values()):
        return None
    if len(batch.view) < MIN_PIXELS:
        return None
    if assembly.development is not None:
        batch = assembly.development(batch)
    with torch.no_grad(), average.used(whole=True), assembly.world.tracer.uncounted():
        pixels = derivatives_of(
            assembly.estimator, views.primary, batch, views.emitter_mask, assembly.settings.seed, iteration,
            1 if quick else GROUPS,
        )  # fmt: skip
        found = None
        if pixels is not None and len(pixels) >= MIN_PIXELS:
            epsilon = assembly.settings.objective.epsilon * views.mean_square_radiance
            found = fit_levels(pixels, materials.recovered, average.levels, epsilon, quick)
    return found


def _summary(found: list[LevelFit] | None) -> str | None:
    """A sentence on what was found; None if the finest levels are kept whole."""
    parts = [
        f"{float(fit.factors[-1]):.2f} of {name}'s finest level"
        for name, fit in zip((parameter.name for parameter in PARAMETERS), found or [], strict=False)
        if float(fit.factors[-1]) < WHOLE
    ]
    if not parts:
        return None
    return f"what is shown keeps {' and '.join(parts)}, by training pixels that were never drawn; the rest is noise"
