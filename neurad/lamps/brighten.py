"""Surfaces that photographs clip, as bright as what they light says: before it is asked which of all surfaces shine,
and where it is known which do.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from neurad.assembly.build import Assembly
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array
from neurad.lamps.candidates import MIN_LAMP_PIXELS, Candidate
from neurad.lamps.clipped import MAX_CLIPPED, Brightness, Glaring, brightened, clipped_surfaces
from neurad.lamps.lit_surfaces import LitSurfaces
from neurad.lamps.named import Named, dim_lamps
from neurad.lamps.patches import Patches
from neurad.scene.shining import without_lamps


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
    """How bright lamps are that photographs clip, or do not show, by what they light: those of them that light enough
    of what photographs show.

    Args:
        assembly: with lamps that are recovered, in an environment that is known.
        photographs: of the training views.
        asked: the lamps in question.
        radiance: of all lamps [m, 3]; that of the others is known.
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
