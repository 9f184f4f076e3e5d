"""What the pixels of one surface say of whether it shines, see :mod:`neurad.lamps.find`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.colour import luminance
from neurad.lamps.photographed import saturated
from neurad.lamps.surfaces import SurfacePixels

MIN_RATIO_ALONE, MAX_SPREAD = 2.0, 0.25
"""Below so many times a white sheet a lamp's pixels have to be alike, too: largest difference, relative to their
median, between the tenth and the ninetieth per cent."""
NOISE = 0.15
"""How much more than the darkest pixels those that least can be reflected in may say that a lamp sends, relatively."""

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
        return self.turned == other.turned and near


def candidate_of(side: int, pixels: SurfacePixels) -> Candidate:
    """A candidate with what its pixels show."""
    blown = saturated(pixels.view, torch.zeros_like(pixels.view), pixels.clipped)
    clipped = bool(blown.all())
    counted = _brightest(pixels) if clipped else pixels[~blown]
    return Candidate(side, counted, counted.color.double().quantile(0.5, 0).float(), clipped)


def _brightest(pixels: SurfacePixels) -> SurfacePixels:
    """Those of the photographs that show it brightest: where all are clipped, the highest ceiling says most."""
    light = luminance(pixels.color)
    middle = torch.stack([light[pixels.view == view].median() for view in torch.unique(pixels.view)])
    chosen = torch.unique(pixels.view)[middle >= _AS_BRIGHT * middle.max()]
    return pixels[torch.isin(pixels.view, chosen)]


def over(shown: Tensor, sheet: Tensor) -> float:
    """Photographed radiance [k, 3] over that of white sheets [k, 3]: of the channel where it is largest."""
    light, white = shown.sum(0), sheet.sum(0)
    return float(torch.where(light > 0, light / white.clamp_min(1e-30), 0.0).max())


def one_radiance(shown: Tensor, sheet: Tensor, ratio: float) -> bool:
    """Whether a lamp of one radiance shows so: nowhere less than it sends, nor more than that and a white sheet.

    Args:
        shown: photographed luminance [k].
        sheet: that of white sheets [k].
        ratio: of both.
    """
    low, middle, high = (float(shown.quantile(q)) for q in (0.1, 0.5, 0.9))
    sent = float((shown - sheet).quantile(0.9))
    return sent <= (1.0 + NOISE) * low and (ratio > MIN_RATIO_ALONE or high - low <= MAX_SPREAD * middle)


def evenly(pixels: SurfacePixels, most: int) -> SurfacePixels:
    """At most so many of the pixels, evenly over all."""
    if len(pixels) <= most:
        return pixels
    return pixels[torch.arange(most, device=pixels.view.device) * len(pixels) // most]
