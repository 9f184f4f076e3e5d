"""Which surfaces are metals, decided once, halfway through a fit: see :mod:`neurad.evidence.metal`.

Until then all are dielectrics, and albedo, roughness and light are known well enough to tell; after it there is time to
find the base colours and roughness of what was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.evidence.metal import ROUGHNESS, MetalTree, log_odds, metal_pixels
from neurad.evidence.pixel_derivatives import SPP
from neurad.evidence.roughness_evidence import patches_of
from neurad.fields.metalness import MIN_METAL
from neurad.optim.polyak_average import averaged
from neurad.runtime.progress import phase
from neurad.runtime.reading import listed
from neurad.scene.connected import linked
from neurad.training.schedule import Counters
from neurad.training.training_views import TrainingViews, training_pixels

DECIDED = 0.5
"""Fraction of the way to the end of the learning rates after which it is decided."""
SHARE = {"auto": 0.06, "fit": 0.24}
"""Samples of the look at the pixels over those that the fit has drawn, by ``model.metallic.recover``. One of them costs
about a fourth of one of a training step."""
DOUBT = 0.25
"""Probability from which on it is said that a group may be a metal."""
MIN_PIXELS, MAX_PIXELS = 256, 1 << 17
"""Fewer say nothing; more would take gigabytes."""
UNDECIDED = "metals were not looked for, as this fit draws too few samples: no surface counts as one"
"""What is said where nothing was decided."""
PATCHES = 64
"""Patches with base colours of their own along the unit cube."""
COLOR = 0.1
"""Difference of cube roots of albedo from which on neighbouring surfaces are taken for others."""


@dataclass(frozen=True)
class Decision:
    """What was found."""

    metals: list[str]
    """Names of the meshes with surfaces that are metals."""
    undecided: list[str]
    """Names of those with surfaces that metal explains better, but not by enough."""

    def __str__(self) -> str:
        metals = f"metal is {listed(self.metals)}" if self.metals else "no surface is a metal"
        doubt = f"; {listed(self.undecided)} may be in part, of which too little is seen, and counts as none"
        return metals + (doubt if self.undecided else "")


def decide_metal(
    assembly: Assembly, views: TrainingViews, photographs: PhotoSource, counters: Counters, processes: int = 1
) -> Decision | None:
    """Decide which surfaces are metals; None where there are too few pixels, and all stay dielectrics.

    Args:
        assembly: of the run; its averaged materials are what is looked at.
        processes: that have drawn these samples; this one decides alone.
    """
    metalness, materials = assembly.metalness, assembly.materials
    assert metalness is not None
    assert isinstance(materials, FittedMaterials)

    samples = SHARE[assembly.settings.metallic.recover] * counters.samples / processes
    count = min(int(samples / (2 * len(ROUGHNESS) * SPP)), views.pixels, MAX_PIXELS)
    pixels = None
    if count >= MIN_PIXELS:
        with torch.no_grad(), averaged(assembly.average), phase("looking for metal"):
            pixels = metal_pixels(training_pixels(assembly, views, photographs), counters.iteration, count)
    if pixels is None:
        metalness.set(torch.zeros_like(metalness.probability))
        return None
    counters.samples += len(pixels) * 2 * len(ROUGHNESS) * SPP
    geometry, count = assembly.world.geometry, metalness.parts.count
    mesh_of = metalness.parts.mesh_of(torch.arange(count)).numpy()
    at = _Places.of(materials, pixels.p, pixels.prim)
    region = at.regions()
    of_region = np.zeros(int(region.max()) + 1, np.int64)
    of_region[region] = at.part
    # ---------------------- What the pixels say ----------------------

    def odds_of(group: IntArray, groups: int) -> Float64Array:
        """Log-odds of metal of each of so many groups, of which the pixels show these [n]; 0 where they say nothing."""
        odds, found = np.zeros(groups), log_odds(pixels, group, patches_of(at.x, group, PATCHES)[0])
        odds[list(found)] = list(found.values())
        return odds

    meshes = len(assembly.scene.meshes)
    odds = odds_of(mesh_of[at.part], meshes), odds_of(at.part, count), odds_of(region, len(of_region))
    by_part, found = MetalTree(odds, mesh_of, of_region, np.bincount(region)).probabilities()
    # ---------------------- Triangles ----------------------

    part = metalness.parts.of(torch.arange(len(geometry.faces))).cpu().numpy()
    probability = by_part[part]
    differs = np.bincount(of_region, (found > MIN_METAL) != (by_part > MIN_METAL)[of_region], count) > 0
    mixed = np.flatnonzero(differs[part])
    if len(mixed):
        middle = geometry.vertices[geometry.faces[torch.from_numpy(mixed)]].mean(1).cpu().numpy()
        probability[mixed] = found[region[at.nearest(_Places.of(materials, middle, mixed))]]
    own = geometry.mesh_index.cpu().numpy()
    probability[np.isin(own, list(materials.known_meshes))] = 0.0  # lamps, of which the scene's own values hold
    metalness.set(torch.from_numpy(probability).float())
    metals = np.unique(own[probability > MIN_METAL])
    undecided = np.setdiff1d(own[(probability <= MIN_METAL) & (probability > DOUBT)], metals)
    return Decision(*([assembly.scene.meshes[i].name for i in which] for which in (metals, undecided)))


@dataclass(frozen=True)
class _Places:
    """Points on surfaces, and what separates one material from another there."""

    x: Float64Array
    """In the unit cube of the fields [n, 3]."""
    color: Float64Array
    """Cube roots of the recovered albedo, which are about as far apart as they look [n, 3]."""
    part: IntArray
    """Connected part of a mesh [n]."""

    @classmethod
    def of(cls, materials: FittedMaterials, p: FloatArray, prim: IntArray) -> Self:
        """Points ``p`` [n, 3] on triangles ``prim`` [n]."""
        assert materials.metalness is not None
        at, on = torch.from_numpy(p), torch.from_numpy(prim)
        with torch.no_grad():
            x, albedo = (v.cpu().double().numpy() for v in (materials.to_unit_cube(at), materials.albedo_at(at, on)))
        return cls(x, np.cbrt(albedo.clip(0.0, 1.0)), materials.metalness.parts.of(on).cpu().numpy())

    @property
    def _scaled(self) -> Float64Array:
        """So that what lies less than 1 apart belongs together [n, 7]."""
        return np.concatenate((2.0 * self.part[:, None], self.x * PATCHES, self.color / COLOR), 1)

    def regions(self) -> IntArray:
        """Regions of like colour in a part [n]: cells of space and colour that touch one another."""
        from scipy.spatial import KDTree

        cells = np.floor(self._scaled)
        cells, cell = np.unique(cells, axis=0, return_inverse=True)
        one, other = KDTree(cells).query_pairs(1.01, p=np.inf, output_type="ndarray").T
        return linked(one, other, len(cells))[cell.reshape(-1)]

    def nearest(self, places: _Places) -> IntArray:
        """Which of these lies nearest to each of ``places`` [n]."""
        from scipy.spatial import KDTree

        return np.asarray(KDTree(self._scaled).query(places._scaled)[1], np.int64)
