"""How bright surfaces are that photographs clip, by what they light.

A surface that every view clips is at least as bright as the ceiling, and may be a lamp that is a hundred times as
bright. All other surfaces are photographed, so what they reflect to each other is known; what is missing of the light
is that of what is clipped. :mod:`neurad.evidence.light_balance` says by what factor, as what is smooth and connected
has much the same albedo and roughness all over.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.bsdf.diffuse import Diffuse
from neurad.core.protocols import BSDF, Materials
from neurad.core.records import BoolArray, Float64Array, IntArray, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.emitters.area import AreaLights
from neurad.evidence.light_balance import LitPoints, blocks, brightness, needed
from neurad.evidence.shading import parts_of_scan
from neurad.integrators.irradiance import irradiance_samples
from neurad.integrators.vertex import shading_frame
from neurad.integrators.world import World
from neurad.lamps.patches import Patches, counted_triangles
from neurad.lamps.surfaces import SurfacePixels
from neurad.scene.connected import joined_places
from neurad.scene.parts import SurfaceParts, segments
from neurad.scene.textures import ConstantMaterials

POINTS, DIRECTIONS = 4096, 64
"""Photographed points, and shadow rays from each towards each surface that is clipped."""
WHITE, COATS = ConstantMaterials(1.0), [ConstantMaterials(0.0, roughness) for roughness in (0.2, 0.4, 0.6, 0.8, 1.0)]
"""A white sheet, and what surfaces reflect besides, as rough as they may be."""
MAX_CLIPPED = 64
"""Surfaces that are looked at, the largest."""
LEAST_LIT = 16
"""Points that a lamp has to light for these to say how bright it is."""
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
    is_lamp: bool = False
    """Whether it is known to shine."""


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
    world: World,
    bsdf: BSDF,
    surfaces: Sequence[Glaring],
    pixels: SurfacePixels,
    others: Callable[[BSDF, Materials], Tensor],
    margin: float,
    seed: int,
) -> dict[int, tuple[Float64Array, Float64Array]]:
    """By what factors [3], at least 1, those of some surfaces that are lamps are brighter than photographs show them,
    and the standard errors of their logarithms [3].

    Args:
        world: the scene.
        bsdf: how its surfaces reflect.
        surfaces: that are clipped, or shown by no photograph; those that are known to shine come first.
        pixels: points of other surfaces, not clipped.
        others: what surfaces of a material show in their place in all other light [n, 3].
        margin: a factor, by which a lamp has to be brighter.
        seed: of the draws.
    """
    si, coats = pixels.points(world.geometry), [] if bsdf.is_diffuse else COATS
    sheets, glosses = zip(
        *(_reflected(world, bsdf, coats, one, si, seed + k) for k, one in enumerate(surfaces)), strict=True
    )
    rest = torch.stack([others(bsdf, coat) for coat in coats] or [torch.zeros_like(si.p)])
    full = torch.stack([one.full for one in surfaces])

    def in_question(light: Tensor) -> Float64Array:
        """Light of each surface, of all else last [..., k + 1, 3]: what is not clipped is known."""
        own, known = light[..., :-1, :], (light[..., :-1, :] * ~full).sum(-2, keepdim=True)
        found: Float64Array = torch.cat((own * full, light[..., -1:, :] + known), -2).double().cpu().numpy()
        return found

    # what has no point on average is one with what it is connected to
    parts = SurfaceParts(world.geometry, segments(world.geometry, float(world.geometry.face_area.sum()) / len(si)))
    points = LitPoints(
        pixels.color.double().cpu().numpy(),
        parts_of_scan(parts.of(si.prim), si, len(si)).cpu().numpy(),
        blocks(si),
        in_question(torch.stack((*sheets, others(Diffuse(), WHITE)), -2)),
        in_question(torch.stack((*glosses, rest), -2)),
    )
    lit = (points.lights[:, :-1] > 0).any(-1).sum(0)
    lamps = [k for k in needed(points, margin, sum(one.is_lamp for one in surfaces)) if lit[k] >= LEAST_LIT]
    logs, errors = brightness(points.of_lights(lamps))
    return dict(zip(lamps, zip(np.exp(np.maximum(logs, 0.0)), errors, strict=True), strict=True))


def _reflected(
    world: World, bsdf: BSDF, coats: Sequence[Materials], surface: Glaring, si: SurfaceInteraction, seed: int
) -> tuple[Tensor, Tensor]:
    """Radiance of points in the light of a surface that is as bright as it is shown: of white sheets [n, 3], and by
    each of the coats alone [m, n, 3]; zeros [1, n, 3] without any.
    """
    light = AreaLights(world.geometry, surface.inside[:, None] * surface.shown, surface.inside & surface.back)
    frame, given = shading_frame(si), [coat(si) for coat in coats]
    wo, sheet = frame.to_local(si.wo), torch.zeros_like(si.p)
    gloss = sheet.expand(max(len(coats), 1), -1, -1).clone()
    for wi, arriving in irradiance_samples(world, light, si, DIRECTIONS, Stream(seed, _STREAM, device=si.p.device)):
        sheet += arriving / np.pi
        local = frame.to_local(wi)
        lit = ((arriving.amax(-1) > 0) & (local[:, 2] > 0)).nonzero().squeeze(-1)
        for row, coat in zip(gloss, given, strict=False):
            row[lit] += bsdf.eval(coat[lit], wo[lit], local[lit]) * (arriving[lit] / local[lit, 2:])
    return sheet, gloss
