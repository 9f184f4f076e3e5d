"""The pass over training pixels that error bars are measured in."""

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.protocols import PhotoSource
from neurad.evidence.error_bars import ErrorBars, measure
from neurad.evidence.pixel_derivatives import SPP, pixel_derivatives
from neurad.training.schedule import Counters
from neurad.training.training_views import TrainingViews, training_pixels

FRACTION = 0.04
"""Samples of the pass over those that the fit has drawn. One of them costs about half of one of a training step."""
MIN_PIXELS, MAX_PIXELS = 64, 1 << 18
"""Pixels in a pass; of fewer nothing can be said."""


def error_bars(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, counters: Counters
) -> ErrorBars | None:
    """Error bars of the present materials, from pixels that the fit would have drawn next; the same ones at every call.

    None where materials are known, and of a fit too short to have drawn samples for :data:`MIN_PIXELS` pixels. Nothing
    of the run changes.

    Args:
        assembly: with the materials that are reported, the averaged ones if the run averages.
    """
    if not isinstance(assembly.materials, FittedMaterials):
        return None
    count = min(int(FRACTION * counters.samples) // SPP, MAX_PIXELS, views.pixels)
    if count < MIN_PIXELS:
        return None
    with assembly.world.tracer.uncounted():
        pixels = pixel_derivatives(training_pixels(assembly, views, photographs), counters.iteration, count)
    if pixels is None:
        return None
    return measure(pixels, assembly.materials, views.pixels, counters.iteration)
