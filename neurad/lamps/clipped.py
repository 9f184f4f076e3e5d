"""How bright surfaces are that photographs clip, by what they light.

A surface that every view clips is at least as bright as the ceiling, and may be a lamp that is a hundred times as
bright. All other surfaces are photographed, so what they reflect to each other is known; what is missing of the light
is that of what is clipped. :mod:`neurad.evidence.light_balance` says by what factor, as what is smooth and connected
has much the same albedo and roughness all over.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.bsdf.diffuse import Diffuse
from neurad.core.protocols import BSDF, Materials, PhotoSource
from neurad.core.records import BoolArray, Float64Array, IntArray, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.emitters.area import AreaLights
from neurad.evidence.light_balance import LitPoints, blocks, brightness, needed, smooth_pieces
from neurad.integrators.method import SceneModel
from neurad.integrators.vertex import shading_frame
from neurad.lamps.candidates import MARGIN, MIN_LAMP_PIXELS, Candidate
from neurad.lamps.lit_surfaces import WHITE, LitSurfaces
from neurad.lamps.named import Named, dim_lamps
from neurad.lamps.patches import Patches, shown_light
from neurad.lamps.surfaces import SurfacePixels
from neurad.scene.connected import joined_places
from neurad.scene.shining import without_lamps
from neurad.scene.textures import ConstantMaterials

POINTS, DIRECTIONS = 4096, 64
"""Photographed points, and shadow rays from each towards each surface that is clipped."""
COATS = [ConstantMaterials(0.0, roughness) for roughness in (0.2, 0.4, 0.6, 0.8, 1.0)]
"""What surfaces reflect besides, as rough as they may be."""
MAX_CLIPPED = 64
"""Surfaces that are looked at, the largest."""
LEAST_LIT = 16
"""Points that a lamp has to light for these to say how bright it is."""
_STREAM = 61


@dataclass(frozen=True)
class Glaring:
    """A surface that every view clips which shows it, or that no view shows."""

    inside: Tensor
    """Its triangles [f], bool."""
    back: bool
    """Whether it is their backs."""
    is_lamp: bool = False
    """Whether it is known to shine."""

    def pixels(self, shown: SurfacePixels) -> Tensor:
        """Which pixels, that show one piece of surface alone, show it [n], bool."""
        return self.inside[shown.si.prim] & (shown.side % 2 == self.back)


@dataclass(frozen=True)
class Brightness:
    """How bright a surface is by what it lights."""

    radiance: Tensor
    """[3]."""
    factor: Tensor
    """That over what photographs show [3], at least 1; of what none shows over a guess."""
    error: float
    """Standard error of the logarithm, of the channel where it is largest; all that surfaces share is not in it."""


def clipped_surfaces(patches: Patches, shown: SurfacePixels, smooth: BoolArray) -> tuple[IntArray, list[int]]:
    """The surface that each triangle is of [f], of those that every view clips; -1 for none. And 1 for surfaces of
    which it is the backs, 0 for others.

    Args:
        shown: pixels that show one mesh alone.
        smooth: triangles that cannot be one [f].
    """
    number, backs = np.full(len(smooth), -1), list[int]()
    for back in (0, 1):
        clipped = patches.spread(shown_light(shown[shown.side % 2 == back], len(smooth))[3]) > 0.5
        blown = clipped & ~smooth & (number < 0)
        if blown.any():
            corner = patches.corner[blown]
            _, part = np.unique(joined_places(corner)[corner[:, 0]], return_inverse=True)
            number[blown] = len(backs) + part
            backs += [back] * (int(part.max()) + 1)
    return number, backs


def brightened(lit: LitSurfaces, surfaces: Sequence[Glaring]) -> dict[int, Brightness]:
    """How bright those of some surfaces are that are lamps, which are clipped or shown by no photograph; those that are
    known to shine come first. What they are among is lit by all light but theirs.
    """
    if not surfaces:
        return {}
    own = torch.stack([one.pixels(lit.pixels) for one in surfaces])
    free = ~lit.pixels.clipped & ~own.any(0)
    if not bool(free.any()):
        return {}
    pixels = lit.pixels[free.nonzero().squeeze(-1)].evenly(POINTS)
    shown, full = [], []
    for one, mine in zip(surfaces, own, strict=True):
        group = lit.pixels[mine.nonzero().squeeze(-1)]
        lit.photographed.left_out[group.side] = True
        shown.append((group if len(group) else pixels).color.mean(0))
        clipped = group.full.float().mean(0) >= 0.5
        full.append(clipped | (one.is_lamp and not bool(clipped.any())))  # where no ceiling is known, or no pixel
    si, coats = pixels.si, [] if lit.bsdf.is_diffuse else COATS
    sheets, glosses = [], []
    for k, (one, is_shown) in enumerate(zip(surfaces, own.any(-1).tolist(), strict=True)):
        sheet, gloss = _reflected(lit, coats, one, shown[k], si, lit.seed + k)
        # what no photograph shows begins so that it lights white sheets as bright as the photographs are
        scale = 1.0 if is_shown else float(pixels.color.mean() / sheet.mean().clamp_min(1e-30))
        shown[k] = shown[k] * scale
        sheets.append(sheet * scale)
        glosses.append(gloss * scale)

    def others(bsdf: BSDF, materials: Materials) -> Tensor:
        return lit.reflected(pixels, SceneModel(lit.world.reflecting_by(bsdf), materials, lit.photographed))

    rest = torch.stack([others(lit.bsdf, coat) for coat in coats] or [torch.zeros_like(si.p)])
    asked = torch.stack(full)

    def in_question(light: Tensor) -> Float64Array:
        """Light of each surface, of all else last [..., k + 1, 3]: what is not clipped is known."""
        own, known = light[..., :-1, :], (light[..., :-1, :] * ~asked).sum(-2, keepdim=True)
        return torch.cat((own * asked, light[..., -1:, :] + known), -2).double().cpu().numpy()

    points = LitPoints(
        pixels.color.double().cpu().numpy(),
        smooth_pieces(lit.geometry, si),
        blocks(si),
        in_question(torch.stack((*sheets, others(Diffuse(), WHITE)), -2)),
        in_question(torch.stack((*glosses, rest), -2)),
    )
    bright = (points.lights[:, :-1] > 0).any(-1).sum(0)
    lamps = [k for k in needed(points, MARGIN, sum(one.is_lamp for one in surfaces)) if bright[k] >= LEAST_LIT]
    logs, errors = brightness(points.of_lights(lamps))
    least = np.where(own.any(-1).cpu().numpy()[lamps], 0.0, -np.inf)[:, None]
    factors = torch.from_numpy(np.exp(np.maximum(logs, least))).to(pixels.color)
    return {
        k: Brightness(shown[k] * factor, factor, float(error.max()))
        for k, factor, error in zip(lamps, factors, errors, strict=True)
    }


def _reflected(
    lit: LitSurfaces, coats: Sequence[Materials], surface: Glaring, shown: Tensor, si: SurfaceInteraction, seed: int
) -> tuple[Tensor, Tensor]:
    """Radiance of points in the light of a surface that is as bright as it is shown [3]: of white sheets [n, 3], and by
    each of the coats alone [m, n, 3]; zeros [1, n, 3] without any.
    """
    light = AreaLights(lit.geometry, surface.inside[:, None] * shown, surface.inside & surface.back)
    frame, given = shading_frame(si), [coat(si) for coat in coats]
    wo, sheet = frame.to_local(si.wo), torch.zeros_like(si.p)
    gloss = sheet.expand(max(len(coats), 1), -1, -1).clone()
    stream = Stream(seed, _STREAM, device=si.p.device)
    for wi, arriving in lit.world.irradiance_samples(light, si, DIRECTIONS, stream):
        sheet += arriving / np.pi
        local = frame.to_local(wi)
        met = ((arriving.amax(-1) > 0) & (local[:, 2] > 0)).nonzero().squeeze(-1)
        for row, coat in zip(gloss, given, strict=False):
            row[met] += lit.bsdf.eval(coat[met], wo[met], local[met]) * (arriving[met] / local[met, 2:])
    return sheet, gloss


def sentence(name: str, radiance: Tensor, error: float, is_shown: bool) -> str:
    """What there is to say of the :class:`Brightness` of a lamp, which pixels of photographs show alone or not."""
    why = "is clipped in every photograph" if is_shown else "fills no pixel of a photograph"
    shown = ", ".join(f"{x:.3g}" for x in radiance.tolist())
    return (
        f"{name} {why}: its radiance {shown} is by what it lights; surfaces differ on it, so its standard error is "
        f"{error:.0%} at least"
    )


def brighten(lit: LitSurfaces, named: Sequence[Named], patches: Patches) -> None:
    """Let surfaces that all views clip, and lamps that somebody tells of, be as bright as what they light says."""
    of, count = lit.geometry.mesh_index, len(lit.mesh_of)
    smooth = np.isin(of.cpu().numpy(), sorted(lit.scene.smooth_meshes))
    number, backs = clipped_surfaces(patches, lit.shown, smooth)
    surface, sure = torch.from_numpy(number).to(of.device), set[int]()
    for inside, turned in dim_lamps(lit, named, surface):
        surface = torch.where(inside, len(backs), surface)
        sure.add(2 * (count + len(backs)) + turned)
        backs.append(int(turned))
    sides = [2 * (count + k) + back for k, back in enumerate(backs)]
    lit.geometry.mesh_index = torch.where(surface >= 0, count + surface, of)
    lit.mesh_of += [0] * len(sides)
    lit.relabel()
    pixels = torch.bincount(lit.pixels.side, minlength=max(sides, default=0) + 1)
    area = torch.bincount(lit.geometry.mesh_index, lit.geometry.face_area, count + len(sides))
    lit.doubt = torch.full_like(lit.doubt, torch.nan)
    taken = [side for side in sides if int(pixels[side]) >= MIN_LAMP_PIXELS or side in sure]
    taken = [side for side in taken if float(area[side // 2]) > 0.0]
    taken = sorted(taken, key=lambda side: (side not in sure, -float(area[side // 2])))[: len(sure) + MAX_CLIPPED]
    of_piece = lit.geometry.mesh_index
    surfaces = [Glaring(of_piece == side // 2, bool(side % 2), side in sure) for side in taken]
    color = lit.shown.color.clone()
    for row, found in brightened(lit, surfaces).items():
        inside, mine = surfaces[row].inside, surfaces[row].pixels(lit.shown)
        color[mine] *= found.factor
        color[mine & lit.shown.clipped] = found.radiance  # ceilings of photographs differ
        lit.doubt[inside], lit.needed[inside] = found.error, found.radiance
    lit.shown = replace(lit.shown, color=color)
    lit.geometry.mesh_index = of
    del lit.mesh_of[count:]
    lit.relabel()


def known_lamps_brightness(
    assembly: Assembly, photographs: PhotoSource, asked: Sequence[int], radiance: Float64Array
) -> dict[int, Brightness]:
    """How bright the ``asked`` lamps are that photographs clip, or do not show, by what they light: those of them that
    light enough of what photographs show. The environment, and the radiance of the other lamps [m, 3], is known.
    """
    lamps, scene = assembly.lamps, without_lamps(assembly.scene)
    assert lamps is not None
    lit = LitSurfaces(scene, assembly.world, photographs, assembly.settings.seed, develop=assembly.development)
    for row, mesh in enumerate(lamps.mesh.tolist()):
        if row not in asked:
            shown = lit.pixels[(lit.pixels.side == 2 * mesh).nonzero().squeeze(-1)]
            known = torch.from_numpy(radiance[row]).to(lit.pixels.color)
            lit.lamps.append(Candidate(2 * mesh, shown, known, clipped=False))
    lit.relight()
    found = brightened(lit, [Glaring(lamps.lamp == row, back=False, is_lamp=True) for row in asked])
    return {asked[k]: brightness for k, brightness in found.items()}
