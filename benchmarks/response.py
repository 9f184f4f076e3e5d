"""What photographs ask of a fit's roughness, beside what is wrong with it: what holds the roughness back.

With the truth at hand the error ``w`` of the recovered roughness is known. Patches ask for a change ``g / F`` of it
(:mod:`neurad.evidence.roughness_evidence`), which were ``w`` if pixels were linear and nothing else were wrong. The
slope ``sum g w / sum F w^2`` is the part that they ask for. Rendered with the true roughness and all else as fitted,
the same pixels tell two causes apart: how far they answer to so large a change as their derivative says, and what
albedo and light have made up for, since then they ask to go back. With true materials all over they tell whether the
light that arrives at surfaces displaces the roughness that they ask for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from benchmarks.bound.fields import training_run
from benchmarks.true_views import training_truth
from neurad.assembly.build import FittedMaterials
from neurad.core.errors import InputError
from neurad.core.parameters import ROUGHNESS
from neurad.core.protocols import Materials
from neurad.core.records import BoolArray, Float64Array, Surface, SurfaceInteraction
from neurad.evidence.closing_calibration import robust_weight
from neurad.evidence.error_bars import ToUnitCube, cells, in_cube
from neurad.evidence.pixel_means import PixelMeans, pixel_means
from neurad.evidence.roughness_evidence import Evidence, evidence
from neurad.fields.material import CORRECTION_CELLS, Correction
from neurad.integrators.radiometric import Radiometric
from neurad.runs.load import LoadedRun
from neurad.scene.textures import TrueMaterials
from neurad.training.closing_step import MAX_GROUP, PATCHES

BLOCKS = 16
"""Slabs of the room that are left out in turn, for standard errors."""
KNOWN = 1.0 / 3.0
"""Fraction of the patches with any information: those that photographs know best."""
BINS = (0.25, 0.4)
"""Bounds of true roughness between which what is asked at the truth is averaged."""


@dataclass(frozen=True)
class Estimate:
    """A ratio of sums over patches, with its standard error from blocks that are left out in turn."""

    value: float
    error: float

    @classmethod
    def ratio(cls, above: Float64Array, below: Float64Array) -> Estimate:
        """``sum above / sum below`` over patches [m] that lie in space as they are numbered."""
        parts = [
            (float(a.sum()), float(b.sum()))
            for a, b in zip(*(np.array_split(x, BLOCKS) for x in (above, below)), strict=True)
        ]
        a, b = (sum(column) for column in zip(*parts, strict=True))
        if b == 0.0:
            return cls(float("nan"), float("nan"))
        others = np.array([(a - x) / (b - y) if b != y else a / b for x, y in parts])
        return cls(a / b, float(np.sqrt((BLOCKS - 1) / BLOCKS * np.square(others - others.mean()).sum())))

    def __str__(self) -> str:
        return f"{self.value:.3f} +- {self.error:.3f}"


@dataclass(frozen=True)
class Asked:
    """What pixels ask for, one row."""

    name: str
    parts: tuple[Estimate, ...]


@dataclass(frozen=True)
class Response:
    """What was found of a fit."""

    wrong: float
    """Root mean square of the recovered roughness's error over the pixels, before the closing step."""
    slopes: list[Asked]
    """Parts of the error that are asked for: of all patches, and of those that photographs know best."""
    displaced: list[Asked]
    """Changes that are asked for at true materials: of true roughness below, between and above :data:`BINS`, and of
    those patches of the lower two that photographs know best."""


class TrueRoughness:
    """The albedo that a fit has found, and the true roughness."""

    def __init__(self, fitted: FittedMaterials, truth: Materials) -> None:
        self.fitted, self.truth = fitted, truth

    def __call__(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        found: Surface = self.fitted(si)
        return replace(found, roughness=self.truth(si).roughness)

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]."""
        found: Tensor = self.fitted.albedo(si)
        return found


def measure_response(
    run: LoadedRun, pixels: int, spp: int, report: Callable[[str], None] = lambda text: None
) -> Response:
    """Set what photographs ask for beside what is wrong.

    Args:
        run: a fit.
        pixels: of the training views, at most.
        spp: samples in each pixel.
        report: told what is done.

    Raises:
        InputError: the run has no radiance field, known materials or no roughness; or true maps or photographs are
            missing.
    """
    fitted, estimator = run.materials, run.assembly.estimator
    if run.radiance is None or isinstance(fitted, TrueMaterials) or ROUGHNESS.name not in fitted.recovered:
        raise InputError(
            f"--ckpt_path {run.checkpoint}: this needs a fit of roughness by a method with a radiance field"
        )
    maps, photographs = training_truth(run)
    truth = TrueMaterials(run.scene, run.world.geometry)
    training = training_run(run.scene, run.settings, photographs)
    views, correction = training.views, run.assembly.correction
    groups = max(1, round(spp / MAX_GROUP))

    def look(what: str, materials: Materials, method: Radiometric | None = None) -> PixelMeans:
        report(what)
        present = replace(estimator, materials=materials)
        found = pixel_means(
            present if method is None else replace(present, method=method), views.primary, training.photographs,
            views.emitter_mask, 0, min(pixels, views.pixels), groups, run.settings.seed, views.mean_square_radiance,
            run.assembly.development, min(spp, MAX_GROUP),
        )  # fmt: skip
        if found is None:
            raise InputError(f"scene {run.scene.name}: no training pixel shows a surface")
        return found

    def true_roughness(means: PixelMeans) -> Float64Array:
        at = means.corner[:, 1] * run.scene.train[0].camera.width + means.corner[:, 0]
        return np.asarray(maps[means.view, at, 3], np.float64)

    with torch.no_grad(), run.world.tracer.uncounted(), _without(correction):
        side = PATCHES * (CORRECTION_CELLS if correction is None else correction.cells)
        to_cube = fitted.to_unit_cube
        # ---------------------- What is wrong, and what is asked for ----------------------

        as_fitted, as_true = _same_pixels(
            look("as fitted", fitted), look("with the true roughness", TrueRoughness(fitted, truth))
        )
        recovered = fitted.at(torch.from_numpy(as_fitted.p))[ROUGHNESS.name].squeeze(-1).cpu().numpy()
        wrong = true_roughness(as_fitted) - recovered
        rows = {
            "as fitted": evidence(as_fitted, to_cube, side)[0],
            "pixels' answer": evidence(as_fitted, to_cube, side, as_fitted.e - as_true.e)[0],
            "with the true roughness": evidence(as_true, to_cube, side)[0],
        }
        slopes = [
            Asked(name, slopes_on(found, in_patches(as_fitted, to_cube, found.side, wrong)))
            for name, found in rows.items()
        ]
        # ---------------------- What displaces the truth ----------------------

        displaced = []
        for name, method in (("the radiance field", None), ("two bounces, then the field", Radiometric(2))):
            means = look(f"with true materials, light by {name}", truth, method)
            found = evidence(means, to_cube, side)[0]
            there = in_patches(means, to_cube, found.side, true_roughness(means))
            displaced.append(Asked(name, changes(found, there)))
    return Response(float(np.sqrt(np.square(wrong).mean())), slopes, displaced)


def slopes_on(found: Evidence, wrong: Float64Array) -> tuple[Estimate, ...]:
    """Part of what is ``wrong`` with the roughness of patches [m] that they ask for: of all, of those known best."""
    weight = robust_weight(found.information)
    above, below = weight * found.gradient * wrong, weight * found.information * np.square(wrong)
    return tuple(Estimate.ratio(above[part], below[part]) for part in (np.ones(len(wrong), bool), _known(found)))


def changes(found: Evidence, truth: Float64Array) -> tuple[Estimate, ...]:
    """Mean changes that patches of some true roughness [m] ask for, see :attr:`Response.displaced`."""
    weight = robust_weight(found.information)
    edges = (-np.inf, *BINS, np.inf)
    parts = [(truth >= low) & (truth < high) for low, high in pairwise(edges)]
    parts.append(_known(found) & (truth < BINS[-1]))
    return tuple(Estimate.ratio((weight * found.gradient)[part], (weight * found.information)[part]) for part in parts)


def _known(found: Evidence) -> BoolArray:
    """Patches [m] that photographs know best."""
    has = found.information > 0
    least = np.quantile(found.information[has], 1.0 - KNOWN) if has.any() else np.inf
    return np.asarray(found.information >= least)


def in_patches(means: PixelMeans, to_cube: ToUnitCube, side: int, values: Float64Array) -> Float64Array:
    """Means [m] of the pixels' ``values`` [n] in the patches of their evidence, ``side`` along the unit cube."""
    patch, count = cells(in_cube(to_cube, means.p), side)
    return np.asarray(np.bincount(patch, values, count) / np.bincount(patch, minlength=count))


def _same_pixels(first: PixelMeans, second: PixelMeans) -> tuple[PixelMeans, PixelMeans]:
    """Those that both have, in the same order."""
    _, here, there = np.intersect1d(first.number, second.number, assume_unique=True, return_indices=True)
    return first[here], second[there]


@contextmanager
def _without(correction: Correction | None) -> Iterator[None]:
    """Inside the block the fit's closing step has not been made."""
    if correction is None or not correction.found:
        yield
        return
    table = correction.grid.table.clone()
    correction.grid.table.zero_()
    try:
        yield
    finally:
        correction.grid.table.copy_(table)
