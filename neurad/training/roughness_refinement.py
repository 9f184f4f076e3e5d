"""What all training pixels say of the roughness, late in a fit: it takes the place of what gradients have found.

A gradient by roughness is noise above all, a hundredth of the pixels tells most, and the steps of Adam are as long
where nothing is known as where much is. So a fit of minutes makes use of a fiftieth of what the photographs tell. Late
in a fit its materials and light are good enough for the pixels to be linear in what is left, and samples of a pass
without an optimizer cost a third of those of training. :mod:`neurad.evidence.roughness_evidence` gathers what patches
of surface ask for, and :mod:`neurad.evidence.random_effects` what rooms are made of. All other parts go on for the rest
of the fit.
"""

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.groups import group_sums
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array, IntArray
from neurad.evidence.pixel_derivatives import GROUP
from neurad.evidence.pixel_means import PixelMeans, pixel_means
from neurad.evidence.random_effects import fit_effects
from neurad.evidence.roughness_evidence import asked_about, evidence, patches_of
from neurad.fields.hierarchy import DETAILS, MIDDLE, Coefficients, Hierarchy, Places
from neurad.optim.polyak_average import averaged
from neurad.runtime.progress import phase
from neurad.training.schedule import Counters, Progress
from neurad.training.training_views import TrainingViews, training_pixels

SAMPLES = 0.3
"""Path samples of the step over those drawn before it."""
RESERVED_TIME, STEPS = 0.25 * SAMPLES, 0.95
"""Fraction of a fit's time that is kept for the step, whose samples cost about a quarter of those of the fit, and the
fraction of a fit's steps after which it is made. Learning rates fall to their end until then."""
MAX_SAMPLES = 256
"""Samples in a pixel."""
MAX_GROUP = 16
"""Samples that are stratified together at most: sixteen of them tell a sixth more than four times four."""
SHARE = 0.6
"""Fraction of the time left that samples may take: the equations and iterations at the lowest rates follow."""
TRIED = 1 << 15
"""Pixels that tell how long a pass will take, at most: an eighth of it, as it costs a method that traces paths much."""
MIN_PIXELS, MAX_PIXELS = 256, 1 << 21
"""Fewer say nothing; more would take gigabytes."""
PATCHES = 2
"""Patches, each with an albedo of its own, along a cell of the finest details."""


def progress_before(done: Progress) -> float:
    """How far a fit is on its way to the step, 1 or more from then on: what its learning rates go by."""
    return max((done.by_time or 0.0) / (1.0 - RESERVED_TIME), (done.by_steps or 0.0) / STEPS)


def should_refine(hierarchy: Hierarchy | None, progress: float) -> bool:
    """Whether the step is to be made at this :func:`progress_before` it, in a fit in which it was not made yet. A fit
    that goes on for longer than it was to makes another one.
    """
    if hierarchy is None:
        return False
    if progress < 1.0 and hierarchy.done:
        hierarchy.reopen()
    return progress >= 1.0 and not hierarchy.done


def refine_roughness(
    assembly: Assembly,
    views: TrainingViews,
    photographs: PhotoSource,
    counters: Counters,
    processes: int = 1,
    seconds: float | None = None,
) -> float | None:
    """Find the roughness; None where there are too few pixels, else the root mean square of the change over what the
    pixels see.

    Args:
        assembly: of the run; its averaged materials are what is looked at.
        processes: that have drawn these samples; this one makes the step alone.
        seconds: that the fit has left, of which the pass takes :data:`SHARE` at most; None for no limit.
    """
    hierarchy, materials = assembly.hierarchy, assembly.materials
    assert hierarchy is not None
    assert isinstance(materials, FittedMaterials)
    hierarchy.set(None)
    samples = SAMPLES * counters.samples / processes
    pixels = min(views.pixels, MAX_PIXELS, int(samples / MAX_GROUP))
    if pixels < MIN_PIXELS:
        return None
    with torch.no_grad(), averaged(assembly.average), phase("finding roughness"):
        in_pixel = min(samples / pixels, MAX_SAMPLES)
        together = _group_size(in_pixel)
        groups = max(round(in_pixel / together), 1)

        source = training_pixels(assembly, views, photographs)

        def look(pixels: int, groups: int) -> PixelMeans | None:
            return pixel_means(source, counters.iteration, pixels, groups, together)

        if seconds is not None:
            possible = SHARE * seconds / _seconds_a_pixel(look, min(max(pixels // 8, MIN_PIXELS), TRIED))
            pixels = max(min(pixels, int(possible)), MIN_PIXELS)
            groups = max(min(groups, int(possible / pixels)), 1)
        means = look(pixels, groups)
        if means is None or len(means) < MIN_PIXELS:
            return None
        counters.samples += len(means) * groups * together
        points = torch.from_numpy(means.p), torch.from_numpy(means.prim)
        present = materials.at(*points)
        places = materials.recovered[ROUGHNESS.name].places(points[0], present[ALBEDO.name], points[1])
        before = present[ROUGHNESS.name]
        hierarchy.set(_solve(means, places, before, hierarchy, assembly.settings.seed))
        change = materials.at(*points)[ROUGHNESS.name] - before
        return float(change.square().mean().sqrt())


def _solve(means: PixelMeans, places: Places, present: Tensor, hierarchy: Hierarchy, seed: int) -> Coefficients:
    """The map's effects by what the cells of the finest details ask for about the roughness ``present`` [n, 1] at the
    ``places`` [n] of pixels.
    """
    pixels = torch.cat((places.x, places.albedo, present), 1).cpu().double().numpy()
    part_of_pixel, mesh_of_pixel = (of.cpu().numpy() for of in (places.part, places.mesh))
    # ---------------------- What patches ask for ----------------------
    patch, patches = patches_of(pixels[:, :3], part_of_pixel, PATCHES * hierarchy.cells)
    part = np.zeros(patches, np.int64)
    part[patch] = part_of_pixel
    columns = _means(pixels, patch, patches)
    found = evidence(means, patch, patches)
    # ---------------------- What their cells do ----------------------
    cell, cells = patches_of(columns[:, :3], part, hierarchy.cells, pixels=0)
    mean = _means(columns, cell, cells)
    of_cell = np.zeros(cells, np.int64)
    of_cell[cell] = part
    mesh = np.zeros(int(part_of_pixel.max()) + 1, np.int64)
    mesh[part_of_pixel] = mesh_of_pixel
    around, _ = patches_of(mean[:, :3], of_cell, hierarchy.cells // DETAILS[0], pixels=0)
    change, information = found.of_groups(cell, cells).changes(around)
    x, albedo = (torch.from_numpy(v).float() for v in (mean[:, :3], mean[:, 3:6]))

    def asked(values: Float64Array | None) -> tuple[Float64Array, Float64Array]:
        target, known = asked_about(mean[:, 6], change, information, None if values is None else values + MIDDLE)
        return target - MIDDLE, known

    cells_at = Places(x, albedo, torch.from_numpy(of_cell), torch.from_numpy(mesh[of_cell]))
    return fit_effects(hierarchy.effects, cells_at, asked, seed)


def _means(columns: Float64Array, group: IntArray, count: int) -> Float64Array:
    """Means [count, c] of ``columns`` [m, c] in each group."""
    return group_sums(columns, group, count) / np.bincount(group, minlength=count)[:, None]


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
