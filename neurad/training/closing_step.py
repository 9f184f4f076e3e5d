"""A Gauss-Newton step of the roughness late in a fit, from all training pixels at once.

A gradient by roughness is noise above all, a hundredth of the pixels tells most, and the steps of Adam are as long
where nothing is known as where much is. So a fit of minutes makes use of a fiftieth of what the photographs tell. Late
in a fit its materials and light are good enough for the pixels to be linear in what is left, and samples of a pass
without an optimizer cost a third of those of training. :mod:`neurad.evidence.roughness_evidence` gathers what pixels
ask for, :func:`neurad.optim.multilevel.solve` weighs it against how little is to be expected, and the field adds what
comes out from then on, while all parts go on for the rest of the fit.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
import torch

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array
from neurad.evidence.bar_calibration import RoughnessBars
from neurad.evidence.closing_calibration import calibrate_at_closing, robust_weight
from neurad.evidence.error_bars import cells as cells_of
from neurad.evidence.error_bars import in_cells
from neurad.evidence.nodes import Nodes
from neurad.evidence.pixel_derivatives import GROUP
from neurad.evidence.pixel_means import PixelMeans, pixel_means
from neurad.evidence.roughness_evidence import Evidence, evidence
from neurad.fields.material import CORRECTION_FACTOR, Correction
from neurad.fields.settings import RoughnessConfig
from neurad.optim.multilevel import solve, upsample
from neurad.optim.polyak_average import averaged
from neurad.runtime.progress import phase
from neurad.training.schedule import Counters, Progress
from neurad.training.training_views import TrainingViews

RESERVED_TIME, STEPS = 0.25, 0.95
"""Time that is kept for the step by its samples over those of the fit, which cost less than four times as much, and the
fraction of a fit's steps after which it is made. Learning rates fall to their end until then: higher ones would undo it
(half of it in living-room-2)."""
EVERY = 16
"""Iterations after which processes agree whether it is time."""
MAX_SAMPLES = 256
"""Samples in a pixel."""
MAX_GROUP = 16
"""Samples that are stratified together at most: sixteen of them tell a sixth more than four times four."""
SHARE = 0.85
"""Fraction of the time left that samples may take: the equations and iterations at the lowest rates follow."""
TRIED = 1 << 15
"""Pixels that tell how long a pass will take."""
MIN_PIXELS, MAX_PIXELS = 256, 1 << 21
"""Fewer say nothing; more would take gigabytes."""
LEVELS, STDS = (CORRECTION_FACTOR, 4, 2, 1), (0.08, 0.08, 0.1, 0.13)
"""Cells of the grid of corrections along one of a level, and what is expected of the details there: with three quarters
as much rooms gain within 0.04 dB the same."""
PATCHES = 2
"""Patches, each with an albedo of its own, along a cell of the grid of corrections."""


@dataclass(frozen=True)
class ClosingStep:
    """What was found."""

    kept: float
    """Fraction of the step that one half of the pixels confirms of the other's."""
    size: float
    """Root mean square of the change over what the pixels see."""

    def sentence(self) -> str:
        """What there is to say."""
        if self.kept <= 0.0:
            return "roughness stays as it is: halves of the training pixels do not agree on a change"
        return f"roughness corrected by {self.size:.3f} (rms) from all training pixels at once"


def progress_before(done: Progress, settings: RoughnessConfig) -> float:
    """How far a fit is on its way to the step, 1 or more from then on: what its learning rates go by."""
    time_before = 1.0 - RESERVED_TIME * settings.closing_samples
    return max((done.by_time or 0.0) / time_before, (done.by_steps or 0.0) / STEPS)


def should_close(correction: Correction | None, progress: float) -> bool:
    """Whether the step is to be made at this :func:`progress_before` it, in a fit in which it was not made yet. A fit
    that goes on for longer than it was to makes another one.
    """
    if correction is None:
        return False
    if progress < 1.0 and correction.done:
        correction.reopen()
    return progress >= 1.0 and not correction.done


def make_closing_step(
    assembly: Assembly,
    views: TrainingViews,
    photographs: PhotoSource,
    counters: Counters,
    processes: int = 1,
    seconds: float | None = None,
) -> ClosingStep | None:
    """Correct the roughness; None where there are too few pixels.

    Args:
        assembly: of the run; its averaged materials are what is corrected.
        views: the training views.
        photographs: of the training views.
        counters: iterations and samples of the fit.
        processes: that have drawn these samples; this one makes the step alone.
        seconds: that the fit has left, of which the pass takes :data:`SHARE` at most; None for no limit.
    """
    correction, materials = assembly.correction, assembly.materials
    assert correction is not None
    assert isinstance(materials, FittedMaterials)
    correction.add(None)
    samples = assembly.settings.roughness.closing_samples * counters.samples / processes
    pixels = min(views.pixels, MAX_PIXELS, int(samples / GROUP))
    if pixels < MIN_PIXELS:
        return None
    with torch.no_grad(), averaged(assembly.average), phase("correcting roughness"):
        in_pixel = min(samples / pixels, MAX_SAMPLES)
        together = _group_size(in_pixel)
        groups = max(round(in_pixel / together), 1)

        def look(pixels: int, groups: int) -> PixelMeans | None:
            return pixel_means(
                assembly.estimator, views.primary, photographs, views.emitter_mask, counters.iteration, pixels, groups,
                assembly.settings.seed, views.mean_square_radiance, assembly.development, together,
            )  # fmt: skip

        if seconds is not None:
            possible = SHARE * seconds / _seconds_a_pixel(look, min(pixels, TRIED))
            pixels = max(min(pixels, int(possible)), MIN_PIXELS)
            groups = max(min(groups, int(possible / pixels)), 1)
        means = look(pixels, groups)
        if means is None or len(means) < MIN_PIXELS:
            return None
        whole, first, second = evidence(means, materials.to_unit_cube, PATCHES * correction.cells)
        counters.samples += len(means) * groups * together
        agreed = agreement(first, second, correction.cells)
        values = agreed.kept * _solved(whole, correction.cells)
    information = in_cells(whole.x, whole.information, correction.cells)
    scales = _scales(whole, first, second, correction.cells, agreed.explained)
    correction.add(values.astype(np.float32), information, astuple(scales))
    size = float(np.sqrt(np.mean(np.square(_read(values, whole.x)))))
    return ClosingStep(agreed.kept, size)


def _group_size(samples: float) -> int:
    """How many of a pixel's samples make a group."""
    size = GROUP
    while 2 * size <= min(samples, MAX_GROUP):
        size *= 2
    return size


def _seconds_a_pixel(look: Callable[[int, int], object], pixels: int) -> float:
    """What one group of samples in one of so many pixels takes, without what only the first call does."""
    look(min(pixels, MIN_PIXELS), 1)
    begin = time.monotonic()
    look(pixels, 1)
    return max(time.monotonic() - begin, 1e-6) / pixels


@dataclass(frozen=True)
class Agreement:
    """How far the steps that two halves of the pixels ask for agree."""

    kept: float
    """The factor, from 0 to 1, by which each explains the other half's pixels best."""
    explained: float
    """By how much that lowers their squared residuals, each patch with its weight of
    :func:`neurad.evidence.closing_calibration.robust_weight`."""


def agreement(first: Evidence, second: Evidence, cells: int) -> Agreement:
    """How far halves agree on a step of so many ``cells`` along the unit cube."""
    asked = taken = 0.0
    for own, other in ((first, second), (second, first)):
        step = _read(_solved(own, cells), other.x)
        weight = robust_weight(other.information)
        asked += float((weight * other.gradient * step).sum())
        taken += float((weight * other.information * np.square(step)).sum())
    kept = min(max(asked / taken, 0.0), 1.0) if taken > 0.0 else 0.0
    return Agreement(kept, kept * (2.0 * asked - kept * taken))


def _scales(whole: Evidence, first: Evidence, second: Evidence, cells: int, explained: float) -> RoughnessBars:
    """By which error bars are made of the information in the cells of the correction's grid."""
    around = Nodes.scattered(whole.x, whole.information[:, None], cells).read(whole.x)[:, 0]
    information, gradient = (
        np.stack(halves) for halves in ((first.information, second.information), (first.gradient, second.gradient))
    )
    return calibrate_at_closing(information, gradient, around, cells_of(whole.x, cells)[0], explained)


def _solved(found: Evidence, cells: int) -> Float64Array:
    """The change at the nodes of the correction's grid. Of photographs so small that patches are larger than the grid's
    cells, details are only looked for that patches can tell; the last of these levels stands for finer ones, too.
    """
    levels = [cells // coarser for coarser in LEVELS]
    count = max(1, sum(PATCHES * level <= found.side for level in levels))
    stds = (*STDS[: count - 1], float(np.linalg.norm(STDS[count - 1 :])))
    values = solve(found.x, found.information, found.gradient, levels[:count], stds)
    return upsample(values, cells // levels[count - 1])


def _read(values: Float64Array, x: Float64Array) -> Float64Array:
    """Trilinear values [m] of a grid over the unit cube at positions [m, 3]."""
    grid = Correction(len(values) - 1)
    grid.add(values.astype(np.float32))
    found: Float64Array = grid(torch.from_numpy(x.astype(np.float32))).detach().squeeze(-1).double().numpy()
    return found
