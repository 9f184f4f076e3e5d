"""How well each training view agrees with the others: a wrong pose shows as a residual that is far too large."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import FloatArray, PixelBatch, Surface
from neurad.core.rng import Stream
from neurad.core.robust import robust_deviation
from neurad.integrators.estimator import Estimator
from neurad.integrators.primary_hits import PrimaryHits

PIXELS = 1 << 14
"""Pixels of the sample, all views together, but no fewer than EACH of a view."""
EACH = 64
SPP = 2
_STREAM = 23  # last number of the stream's key
FAR = 6.0
"""Robust standard deviations from the median at which a view stands out ..."""
LARGER = 1.5
"""... if its residual is also this many times the median."""


def few(sample: PixelBatch, views: int) -> PixelBatch:
    """The first pixels of each view in a sample, so many that all views together have about PIXELS."""
    each = max(PIXELS // max(views, 1), EACH)
    order = torch.argsort(sample.view, stable=True)
    view = sample.view[order]
    place = torch.arange(len(view), device=view.device) - torch.searchsorted(view, view)
    kept = order[place < each]
    if sample.clipped is not None:  # they say nothing of how bright it was
        kept = kept[~sample.clipped[kept].any(-1)]
    return PixelBatch(sample.view[kept], sample.pixel[kept], sample.color[kept], sample.alpha[kept], 0)


def per_view(values: Tensor, view: Tensor, views: int) -> FloatArray:
    """Means of ``values`` [n] over the pixels of each view [views]; NaN where the sample has none."""
    total = torch.zeros(views, dtype=torch.float64).index_add_(0, view.cpu(), values.double().cpu())
    count = torch.bincount(view.cpu(), minlength=views)
    return (total / count).numpy()


@torch.no_grad()
def surface_fractions(primary: PrimaryHits, sample: PixelBatch, seed: int) -> FloatArray:
    """Fraction of each training view's pixels in which its camera meets a surface [views], in [0, 1].

    Args:
        sample: random photographed pixels that show no emitter.
        seed: of the positions in the pixels.
    """
    chosen = _on(few(sample, len(primary.cameras)), primary)
    with primary.world.tracer.uncounted():
        valid = primary(chosen, 1, Stream(seed, _STREAM, device=primary.origin.device)).si.valid
    return per_view(valid.float(), chosen.view, len(primary.cameras))


@torch.no_grad()
def view_residuals(estimator: Estimator, primary: PrimaryHits, sample: PixelBatch, seed: int) -> FloatArray:
    """Mean relative difference between each training photograph and what is recovered so far [views], in [0, 1].

    Of a pixel, the sum over the colours of absolute differences, over the sum of both. The radiance field is asked
    where there is one; it is noise-free. Other methods are rendered with a few samples.

    Args:
        estimator: the method with the present materials and radiance field.
        sample: random photographed pixels that show no emitter.
        seed: of the positions in the pixels.
    """
    world = estimator.world
    chosen = _on(few(sample, len(primary.cameras)), primary)
    stream = Stream(seed, _STREAM, device=primary.origin.device)
    with world.tracer.uncounted():
        first = primary(chosen, SPP, stream)
        surface: Surface = estimator.materials(first.si)
        reflected = estimator.shown(first.si, surface, stream)
        found = first.attenuate(world.emitted(first.si) + reflected).view(-1, SPP, 3).mean(1)  # [b, 3]
    sizes = (found.abs() + chosen.color.abs()).sum(-1).clamp_min(1e-30)
    return per_view((found - chosen.color).abs().sum(-1) / sizes, chosen.view, len(primary.cameras))


def outliers(residuals: FloatArray | Sequence[float]) -> list[int]:
    """Views whose residual is far outside the others', the farthest first; none of fewer than four views.

    Far is against the median, in robust standard deviations, so that a few wrong views do not hide each
    other.
    """
    values = np.asarray(residuals, np.float64)
    known = values[np.isfinite(values)]
    if len(known) < 4:
        return []
    median = float(np.median(known))
    limit = max(median + FAR * robust_deviation(known, median), LARGER * median)
    far = [int(i) for i in np.flatnonzero(values > limit)]
    return sorted(far, key=lambda i: -values[i])


def _on(sample: PixelBatch, primary: PrimaryHits) -> PixelBatch:
    """The sample on the device of the camera rays."""
    device = primary.origin.device
    view, pixel, color, alpha = (x.to(device) for x in (sample.view, sample.pixel, sample.color, sample.alpha))
    return PixelBatch(view, pixel, color, alpha, 0)
