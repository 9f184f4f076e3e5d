"""Patches of a mesh that may shine: connected triangles that photographs show alike, and brighter than all around.

They are maximally stable extremal regions (Matas et al. 2002) of the triangles: where the level falls that a triangle
has to be as bright as, a lamp stays the same patch from just below its own radiance down to the brightest thing beside
it, while what merely reflects goes on growing. A triangle counts as bright as the darkest view shows it, since a lamp
looks alike from everywhere, and a highlight does not.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.core.colour import luminance
from neurad.core.records import BoolArray, Float64Array, IntArray
from neurad.lamps.surfaces import SurfacePixels
from neurad.scene.connected import joined_places, welded_corners
from neurad.scene.geometry import Geometry

DROP = 1.3
"""By what factor the level may fall without a patch growing."""
MAX_GROWTH = 0.5
"""How much of what shows it a patch may grow by then."""
MAX_BRIGHTER, BRIGHTER = 0.1, 1.5
"""How much of what shows it may be so many times as bright as the level."""
_DIM = 0.25  # quantile of what triangles show below which nothing is a patch
_STEPS = 2  # levels within DROP
_AROUND = 0.1  # quantile of what is around a patch that is not of it
_ROUNDS = 32  # rings of triangles that no photograph shows, around those that one does


@dataclass
class Patches:
    """The triangles of a scene as photographs show them, from which patches are taken."""

    geometry: Geometry
    pixels: SurfacePixels

    def __post_init__(self) -> None:
        """Find which triangles touch."""
        self.corner = welded_corners(self.geometry.vertices.cpu().numpy(), self.geometry.faces.cpu().numpy())
        self._mean: dict[bool, Float64Array] = {}
        self.parts = joined_places(self.corner)[self.corner[:, 0]]

    def find(self, allowed: Tensor, least: int) -> Tensor:
        """Number of the patch of each triangle [f], -1 where there is none or where it is not ``allowed`` [f], bool; by
        so many pixels at least.
        """
        free, patch = allowed.cpu().numpy(), np.full(len(self.corner), -1)
        for back in (0, 1):
            pixels = self.pixels[self.pixels.side % 2 == back]
            if len(pixels):
                light, _, shown, _ = shown_light(pixels, len(free))
                light = self.spread(np.where(free, light, np.nan))
                found = stable_patches(self.corner, np.where(free, light, np.nan), shown, least)
                patch = np.where(found >= 0, found + patch.max() + 1, patch)
                free &= patch < 0
        mesh = self.geometry.mesh_index.cpu().numpy()
        inside = np.flatnonzero(patch >= 0)  # no patch is of two meshes
        _, patch[inside] = np.unique(np.stack((patch[inside], mesh[inside])), axis=1, return_inverse=True)
        return torch.from_numpy(patch).to(allowed.device)

    def is_whole(self, patch: Tensor) -> bool:
        """Whether a patch [f], bool, is all of the connected parts that it is of: it ends where the surface does."""
        inside = patch.cpu().numpy()
        return bool(inside[np.isin(self.parts, np.unique(self.parts[inside]))].all())

    def refined(self, patch: Tensor, allowed: Tensor, back: bool, radiance: float) -> Tensor:
        """A patch [f], bool, whose edge lies halfway between its own luminance and what is around it, by the mean of
        all views of its triangles or their backs; of those that are ``allowed`` [f], bool. Where nearly all of the
        connected parts that it is of is brighter than half of it, no edge lies there: it is all of them, though
        triangles at borders, which pixels show with what is beside them, are dimmer.
        """
        light = self._light(back)
        inside, free = patch.cpu().numpy(), allowed.cpu().numpy()
        parts = np.isin(self.parts, np.unique(self.parts[inside])) & free & ~np.isnan(light)
        if parts.any() and np.quantile(light[parts], _AROUND) >= 0.5 * radiance:
            return torch.from_numpy(parts).to(patch.device)
        beside = light[self._around(self._around(inside) & free) & free & ~inside & (light < radiance / DROP)]
        least = 0.5 * (radiance + (float(np.quantile(beside, _AROUND)) if len(beside) else 0.0))
        free = free & (light >= least)
        inside, size = inside & free, -1
        while inside.sum() > size:
            size = int(inside.sum())
            inside = self._around(inside) & free
        return torch.from_numpy(inside).to(patch.device) if inside.any() else patch

    def _light(self, back: bool) -> Float64Array:
        """How bright triangles are from the front or the back on average [f]; NaN far from what photographs show."""
        if back not in self._mean:
            pixels = self.pixels[self.pixels.side % 2 == int(back)]
            self._mean[back] = self.spread(shown_light(pixels, len(self.corner))[1])
        return self._mean[back]

    def _around(self, inside: BoolArray) -> BoolArray:
        """Triangles that touch some of those ``inside`` [f], and these."""
        place = np.zeros(int(self.corner.max(initial=-1)) + 1, bool)
        place[self.corner[inside].ravel()] = True
        return np.asarray(place[self.corner].any(1))

    def spread(self, light: Float64Array) -> Float64Array:
        """What triangles show [f], of those that no photograph shows what the triangles around them do."""
        places = int(self.corner.max(initial=-1)) + 1
        count, total = np.zeros(places), np.zeros(places)
        fresh, unknown = np.flatnonzero(~np.isnan(light)), np.flatnonzero(np.isnan(light))
        for _ in range(_ROUNDS):
            for corner in self.corner[fresh].T:
                count += np.bincount(corner, minlength=places)
                total += np.bincount(corner, light[fresh], minlength=places)
            weight, sums = (sum(x[corner] for corner in self.corner[unknown].T) for x in (count, total))
            near = weight > 0
            fresh, unknown = unknown[near], unknown[~near]
            if len(fresh) == 0:
                break
            light[fresh] = sums[near] / weight[near]
        return light


def shown_light(pixels: SurfacePixels, triangles: int) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Luminance of each triangle in the view that shows it darkest and on average, how many pixels show it, and 1 where
    all views that do clip half of its pixels or more, else 0; all [f], NaN but for the third where no view shows it.
    Views that clip it count as darkest where there are no others. Of a triangle that fills some pixel these alone
    count.
    """
    prims = pixels.prims.cpu().numpy()
    of, alone = prims.ravel(), (prims == prims[:, :1]).all(1)
    filled = np.zeros(triangles, bool)
    filled[prims[alone, 0]] = True
    counted = (alone[:, None] | ~filled[prims]).ravel()
    shown = np.bincount(of, minlength=triangles) / prims.shape[1]
    light, clipped, view = (
        np.repeat(x.cpu().numpy(), prims.shape[1])[counted]
        for x in (luminance(pixels.color.double()), pixels.clipped, pixels.view)
    )
    group, row, count = np.unique(view * triangles + of[counted], return_inverse=True, return_counts=True)
    mean, full = np.bincount(row, light) / count, 2 * np.bincount(row, clipped) >= count
    least, most = np.full(triangles, np.inf), np.full(triangles, -np.inf)
    np.minimum.at(least, group[~full] % triangles, mean[~full])
    np.maximum.at(most, group[full] % triangles, mean[full])
    clipped_in_all = ~np.isfinite(least)
    total, number = (np.bincount(group % triangles, x, triangles) for x in (mean * count, count))
    columns = np.where(clipped_in_all, most, least), total / np.maximum(number, 1), clipped_in_all.astype(np.float64)
    darkest, average, clips = (np.where(number > 0, column, np.nan) for column in columns)
    return darkest, average, shown, clips


def stable_patches(corner: IntArray, light: Float64Array, shown: Float64Array, least: int) -> IntArray:
    """Number of the patch of each triangle [f], -1 where there is none, the brightest first.

    Args:
        corner: numbers of the places where the corners lie [f, 3].
        light: how bright triangles are [f]; NaN of those that are of no patch.
        shown: how many pixels show each [f].
        least: pixels that have to show a patch.
    """
    patch: IntArray = np.full(len(light), -1)
    bright = np.sort(light[(light > 0) & (shown > 0)])
    if len(bright) == 0:
        return patch
    factor = DROP ** (1.0 / _STEPS)
    dim = bright[int(_DIM * len(bright))]
    count = int(np.ceil(np.log(bright[-1] / dim) / np.log(factor))) + 1 + _STEPS
    sets: list[IntArray] = []
    for step in range(count):
        level = bright[-1] / factor ** (step + 0.5)
        part, above = np.full(len(light), -1), light >= level
        part[above] = joined_places(corner[above])[corner[above, 0]]
        sets.append(part)
        if len(sets) <= _STEPS:
            continue
        before = sets.pop(0)
        inside = (before >= 0) & (patch < 0)
        mass = np.bincount(before[inside], shown[inside])
        brighter = inside & (light > BRIGHTER * DROP * level)
        over = np.bincount(before[brighter], shown[brighter], minlength=len(mass))
        free = (part >= 0) & (patch < 0)
        grown = np.bincount(part[free], shown[free])
        into = np.zeros(len(mass), np.int64)
        into[before[inside]] = part[inside]  # each set lies within one of the next ones
        stable = (mass >= least) & (over <= MAX_BRIGHTER * mass) & (grown[into] <= (1.0 + MAX_GROWTH) * mass)
        taken = np.full(int(part.max()) + 1, -1)
        taken[into[stable]] = patch.max() + 1 + np.arange(int(stable.sum()))
        patch[free] = taken[part[free]]
    return patch
