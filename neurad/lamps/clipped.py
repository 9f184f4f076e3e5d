"""How bright surfaces are that photographs clip, by what they light.

A surface that every view clips is at least as bright as the ceiling, and may be a lamp that is a hundred times as
bright. All other surfaces are photographed, so what they reflect to each other is known; what is missing of the light
is that of what is clipped. :mod:`neurad.evidence.light_balance` says by what factor, as the albedo of a surface is much
the same all over.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import BoolArray, Float64Array, IntArray, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.emitters.area import AreaLights
from neurad.evidence.light_balance import LitPoints, blocks, factors, needed
from neurad.evidence.shading import parts_of_scan
from neurad.integrators.irradiance import irradiance_samples
from neurad.integrators.world import World
from neurad.lamps.patches import Patches, counted_triangles
from neurad.lamps.surfaces import SurfacePixels
from neurad.scene.connected import joined_places
from neurad.scene.parts import SurfaceParts

POINTS, DIRECTIONS = 4096, 16
"""Photographed points, and shadow rays from each towards each surface that is clipped."""
MAX_CLIPPED = 64
"""Surfaces that are looked at, the largest."""
_STREAM = 61


@dataclass(frozen=True)
class Glaring:
    """A surface that every view clips which shows it."""

    inside: Tensor
    """Its triangles [f], bool."""
    back: bool
    """Whether it is their backs."""
    shown: Tensor
    """Mean radiance that photographs show [3]."""
    full: Tensor
    """Channels that are clipped [3], bool."""


def clipped_surfaces(patches: Patches, shown: SurfacePixels, smooth: BoolArray) -> tuple[IntArray, list[int]]:
    """The surface that each triangle is of [f], of those that every view clips; -1 for none. And 1 for surfaces of
    which it is the backs, 0 for others.

    Args:
        patches: of the scene.
        shown: pixels that show one mesh alone.
        smooth: triangles that cannot be one [f].
    """
    number, backs = np.full(len(smooth), -1), list[int]()
    for back in (0, 1):
        clipped = patches.spread(_clipped_triangles(shown[shown.side % 2 == back], len(smooth))) > 0.5
        blown = clipped & ~smooth & (number < 0)
        if blown.any():
            corner = patches.corner[blown]
            _, part = np.unique(joined_places(corner)[corner[:, 0]], return_inverse=True)
            number[blown] = len(backs) + part
            backs += [back] * (int(part.max()) + 1)
    return number, backs


def _clipped_triangles(pixels: SurfacePixels, triangles: int) -> Float64Array:
    """1 for triangles that every view clips which shows them, 0 for those that some view does not; NaN where none does.

    A view clips a triangle if it does half of its pixels there.
    """
    count = pixels.prims.shape[1]
    counted = counted_triangles(pixels.prims, triangles)
    of = pixels.prims.reshape(-1)[counted]
    view, full = (x.repeat_interleave(count)[counted] for x in (pixels.view, pixels.clipped))
    group, row = torch.unique(view * triangles + of, return_inverse=True)
    blown = 2.0 * torch.bincount(row, full.double()) >= torch.bincount(row)
    shown, open_ = (torch.bincount(g % triangles, minlength=triangles) for g in (group, group[~blown]))
    found: Float64Array = torch.where(shown > 0, (open_ == 0).double(), torch.nan).cpu().numpy()
    return found


def brightened(
    world: World, surfaces: Sequence[Glaring], pixels: SurfacePixels, rest: Tensor, seed: int
) -> dict[int, Float64Array]:
    """By what factors [3] those of some surfaces that are lamps are brighter than photographs show them, at least 1.

    Args:
        world: the scene.
        surfaces: that are clipped.
        pixels: points of other surfaces, not clipped.
        rest: radiance of a white sheet in their place by all other light [n, 3].
        seed: of the draws.
    """
    si = pixels.points(world.geometry)
    sent = [_arriving(world, one, si, seed + k) for k, one in enumerate(surfaces)]
    lights, full = torch.stack(sent, 1), torch.stack([one.full for one in surfaces])
    rest = rest + (lights * ~full).sum(1)
    lights = lights * full
    albedo = pixels.color / (rest + lights.sum(1)).clamp_min(1e-30)
    part = parts_of_scan(SurfaceParts(world.geometry).of(si.prim), si, len(si)).cpu().numpy()
    values = (x.double().cpu().numpy() for x in (albedo, lights, rest))
    points = LitPoints(next(values), part, blocks(si), *values)
    lamps = needed(points)
    if not lamps:
        return {}
    logs = np.stack([factors(points.of_lights(lamps), channel)[0] for channel in range(3)], -1)
    return dict(zip(lamps, np.exp(np.maximum(logs, 0.0)), strict=True))


def _arriving(world: World, surface: Glaring, si: SurfaceInteraction, seed: int) -> Tensor:
    """Radiance of a white sheet at points in the light of a surface that is as bright as it is shown [n, 3]."""
    emission = surface.inside[:, None] * surface.shown
    light = AreaLights(world.geometry, emission, surface.inside & surface.back)
    samples = irradiance_samples(world, light, si, DIRECTIONS, Stream(seed, _STREAM, device=si.p.device))
    return sum((arriving for _, arriving in samples), torch.zeros_like(si.p)) / np.pi
