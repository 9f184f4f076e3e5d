"""Which surfaces are metals, decided once, halfway through a fit: see :mod:`neurad.evidence.metal`.

Until then all are dielectrics, and albedo, roughness and light are known well enough to tell; after it there is time to
find the base colours and roughness of what was found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array
from neurad.evidence.metal import PRIOR, ROUGHNESS, log_odds, metal_pixels
from neurad.evidence.pixel_derivatives import SPP
from neurad.evidence.roughness_evidence import patches_of
from neurad.fields.metalness import EVEN, Metalness
from neurad.optim.polyak_average import averaged
from neurad.runtime.progress import phase
from neurad.runtime.reading import listed
from neurad.training.schedule import Counters
from neurad.training.training_views import TrainingViews

HALF = 0.5
"""Fraction of the way to the end of the learning rates after which it is decided."""
SHARE = {"auto": 0.06, "fit": 0.24}
"""Samples of the look at the pixels over those that the fit has drawn, by ``model.metallic.recover``. One of them costs
about a fourth of one of a training step."""
DOUBT = 0.25
"""Probability from which on it is said that a group may be a metal."""
MIN_PIXELS, MAX_PIXELS = 256, 1 << 17
"""Fewer say nothing; more would take gigabytes."""
PATCHES = 64
"""Patches with base colours of their own along the unit cube."""


@dataclass(frozen=True)
class Decision:
    """What was found."""

    metals: list[str]
    """Names of the meshes with groups that are metals."""
    undecided: list[str]
    """Names of those with groups that metal explains better, but not by enough."""

    def __str__(self) -> str:
        metals = f"metal is {listed(self.metals)}" if self.metals else "no surface is a metal"
        doubt = f"; {listed(self.undecided)} may be in part, of which too little is seen, and counts as none"
        return metals + (doubt if self.undecided else "")


def should_decide(metalness: Metalness | None, progress: float) -> bool:
    """Whether it is to be decided at this progress, 1 where learning rates have come to their end."""
    return metalness is not None and not metalness.done and progress >= HALF


def decide_metal(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, counters: Counters, processes: int = 1
) -> Decision | None:
    """Decide which groups of surface are metals; None where there are too few pixels, and all stay dielectrics.

    Args:
        assembly: of the run; its averaged materials are what is looked at.
        views: the training views.
        photographs: of the training views.
        counters: iterations and samples of the fit.
        processes: that have drawn these samples; this one decides alone.
    """
    metalness, materials = assembly.metalness, assembly.materials
    assert metalness is not None
    assert isinstance(materials, FittedMaterials)
    from scipy.special import expit, logit  # imported where it is needed: it loads slowly

    samples = SHARE[assembly.settings.metallic.recover] * counters.samples / processes
    count = min(int(samples / (2 * len(ROUGHNESS) * SPP)), views.pixels, MAX_PIXELS)
    pixels = None
    if count >= MIN_PIXELS:
        with torch.no_grad(), averaged(assembly.average), phase("looking for metal"):
            pixels = metal_pixels(
                assembly.estimator, views.primary, photographs, views.emitter_mask, counters.iteration, count,
                assembly.settings.seed, views.mean_square_radiance, assembly.development,
            )  # fmt: skip
    if pixels is None:
        metalness.set(torch.zeros(metalness.groups.count))
        return None
    counters.samples += len(pixels) * 2 * len(ROUGHNESS) * SPP
    prim = torch.from_numpy(pixels.prim)
    group = metalness.groups.of(prim.to(metalness.probability.device)).cpu().numpy()
    x = materials.to_unit_cube(torch.from_numpy(pixels.p)).cpu().double().numpy()
    meshes = assembly.world.geometry.mesh_index.cpu()[metalness.groups.triangles].numpy()  # of groups
    odds = _each(log_odds(pixels, group, patches_of(x, group, PATCHES)[0]), len(meshes))
    # Parts of a mesh are mostly of one material: what the others tell is what each begins with.
    mesh = meshes[group]
    whole = _each(log_odds(pixels, mesh, patches_of(x, mesh, PATCHES)[0]), int(meshes.max()) + 1)[meshes]
    others = 1.0 - np.bincount(group, None, len(meshes)) / np.maximum(np.bincount(mesh, None, len(meshes))[meshes], 1)
    begin = PRIOR + (1.0 - 2.0 * PRIOR) * expit(logit(PRIOR) + others * whole)
    probability = expit(logit(begin) + odds)
    metalness.set(torch.from_numpy(probability).float())
    metals = np.unique(meshes[probability > EVEN])
    undecided = np.setdiff1d(meshes[(probability <= EVEN) & (probability > DOUBT)], metals)
    return Decision(*([assembly.scene.meshes[i].name for i in which] for which in (metals, undecided)))


def _each(found: Mapping[int, float], count: int) -> Float64Array:
    """Values of so many [count]; 0 of those of which nothing was found."""
    values = np.zeros(count)
    values[list(found)] = list(found.values())
    return values
