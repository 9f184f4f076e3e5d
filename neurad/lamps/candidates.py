"""What the pixels of one surface say of whether it shines, see :mod:`neurad.lamps.find`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.colour import luminance
from neurad.lamps.photographed import saturated
from neurad.lamps.surfaces import SurfacePixels

MARGIN = 1.3
"""How much brighter than a white sheet in its place a mesh has to be to be taken for a lamp."""
MIN_LAMP_PIXELS = 3
"""Pixels that have to show nothing but a lamp: fewer do not tell whether it is alike all over."""
MIN_RATIO_ALONE, MAX_SPREAD = 2.0, 0.25
"""Below so many times a white sheet a lamp's pixels have to be alike, too: largest difference, relative to their
median, between the tenth and the ninetieth per cent."""
NOISE = 0.15
"""Relative noise of radiance: so much brighter than a lamp's darkest pixels may be what its brightest leave for it."""

BLOCKS = 8
"""Blocks of pixels of a jackknife, and the fewest pixels in each: they tell a lamp's reflection from its emission."""
POSSIBLE = 1.0 / 12.0
"""Variance of an albedo of which nothing is known."""

_AS_BRIGHT = 0.95  # of the brightest photograph's ceiling


@dataclass
class Candidate:
    """A side of a mesh, or of a patch of one, that may shine."""

    side: int
    """Twice the index of the mesh or patch, and 1 more for its back."""
    pixels: SurfacePixels
    """That show nothing but it, in photographs where it is not clipped; where it is in all, in the brightest."""
    radiance: Tensor
    """Median of those in views where it is not clipped; where it is in all, of all [3]."""
    clipped: bool
    """Whether it is clipped in every view, so that it may be brighter."""
    ratio: float = 0.0
    """Photographed radiance over that of a white sheet in its place, at the last time it was measured."""
    albedo: float | None = None
    """What it reflects besides; None where that is what its mesh does."""
    named_by: str = ""
    """Who says that it shines, where it is not the photographs."""
    even: bool = False
    """Whether one radiance all over explains its pixels then."""

    @property
    def brightness(self) -> float:
        """Luminance of the radiance."""
        return float(luminance(self.radiance))

    @property
    def piece(self) -> int:
        """Index of the mesh or patch."""
        return self.side // 2

    @property
    def turned(self) -> bool:
        """Whether it shines to its triangles' backs."""
        return bool(self.side % 2)

    def is_like(self, other: Candidate) -> bool:
        """Whether it may be a part of the other lamp, or that of it."""
        near = torch.allclose(self.radiance, other.radiance, rtol=NOISE, atol=NOISE * self.brightness)
        return near and self.turned == other.turned and not (self.named_by or other.named_by)


def candidate_of(side: int, pixels: SurfacePixels) -> Candidate:
    """A candidate with what its pixels show."""
    counts = ~saturated(pixels.view, torch.zeros_like(pixels.view), pixels.clipped)
    clipped = not bool(counts.any())
    if clipped:  # the photographs that show it brightest: the highest ceiling says most
        light, views = luminance(pixels.color), torch.unique(pixels.view)
        middle = torch.stack([light[pixels.view == view].median() for view in views])
        counts = torch.isin(pixels.view, views[middle >= _AS_BRIGHT * middle.max()])
    counted = pixels[counts]
    return Candidate(side, counted, counted.color.double().quantile(0.5, 0).float(), clipped)


def over(shown: Tensor, sheet: Tensor) -> float:
    """Photographed radiance [k, 3] over that of white sheets [k, 3]: of the channel where it is largest."""
    light, white = shown.sum(0), sheet.sum(0)
    return float(torch.where(light > 0, light / white.clamp_min(1e-30), 0.0).max())


def one_radiance(shown: Tensor, sheet: Tensor, ratio: float) -> bool:
    """Whether a lamp of one radiance shows so, nowhere less than it sends, nor more than that and a white sheet: by the
    photographed luminance [k], that of white sheets [k] and the ratio of both.
    """
    low, middle, high = (float(shown.quantile(q)) for q in (0.1, 0.5, 0.9))
    sent = max(float((shown - sheet).quantile(0.9)), float((shown - sheet).mean()))
    return sent <= (1.0 + NOISE) * low and (ratio > MIN_RATIO_ALONE or high - low <= MAX_SPREAD * middle)


def reflectance(shown: Tensor, sheets: Tensor, albedo: float) -> float:
    """Albedo of a lamp of one radiance, by how much brighter it is where more arrives; the nearer to the ``albedo``
    that was thought the less the photographs say, by a jackknife over blocks of pixels, which share errors.

    Args:
        shown: photographed luminance of pixels, view by view [k].
        sheets: that of white sheets in its place, in two independent halves [2, k].
    """
    if len(shown) < BLOCKS * BLOCKS:
        return albedo

    def slope(kept: Tensor) -> Tensor:
        light, first, second = (x[kept] - x[kept].mean() for x in (shown, *sheets))
        tilt: Tensor = (light * (first + second)).mean() / (2.0 * (first * second).mean())
        return tilt

    block = torch.arange(len(shown), device=shown.device) * BLOCKS // len(shown)
    without = torch.stack([slope(block != k) for k in range(BLOCKS)])
    variance = float((without - without.mean()).square().sum() * (BLOCKS - 1) / BLOCKS)
    found = float(slope(block >= 0))
    if not math.isfinite(found + variance):
        return albedo
    weight = POSSIBLE / (POSSIBLE + variance)
    return min(max(weight * found + (1.0 - weight) * albedo, 0.0), 1.0)
