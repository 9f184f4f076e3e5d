"""Surfaces that photographs clip, as bright as what they light says: before it is asked which of all surfaces shine."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neurad.core.protocols import BSDF, Materials
from neurad.integrators.method import SceneModel
from neurad.lamps.candidates import MARGIN, MIN_LAMP_PIXELS, evenly
from neurad.lamps.clipped import MAX_CLIPPED, POINTS, Glaring, brightened, clipped_surfaces
from neurad.lamps.lit_surfaces import LitSurfaces
from neurad.lamps.named import Named, dim_lamps
from neurad.lamps.patches import Patches


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
    own = torch.tensor(taken, dtype=torch.int64, device=of.device)
    open_ = lit.pixels[(~lit.pixels.clipped & ~torch.isin(lit.pixels.side, own)).nonzero().squeeze(-1)]
    if taken and len(open_):
        lit.photographed.left_out[own] = True
        points = evenly(open_, POINTS)
        surfaces = []
        for side in taken:
            shown = lit.pixels[(lit.pixels.side == side).nonzero().squeeze(-1)]
            color = (shown if len(shown) else points).color.mean(0)
            full = torch.ones_like(color, dtype=torch.bool) if side in sure else shown.full.float().mean(0) >= 0.5
            inside = lit.geometry.mesh_index == side // 2
            surfaces.append(Glaring(inside, bool(side % 2), color, full, side in sure))
        color = lit.shown.color.clone()

        def others(bsdf: BSDF, materials: Materials) -> Tensor:
            return lit.reflected(points, SceneModel(lit.world.reflecting_by(bsdf), materials, lit.photographed))

        found = brightened(lit.world, lit.bsdf, surfaces, points, others, MARGIN, lit.seed)
        for row, (factor, errors) in found.items():
            one, times = surfaces[row], torch.from_numpy(factor).to(color)
            mine = one.inside[lit.shown.prim] & (lit.shown.side % 2 == one.back)
            color[mine] *= times
            color[mine & lit.shown.clipped] = one.shown * times  # ceilings of photographs differ
            lit.doubt[one.inside], lit.needed[one.inside] = float(errors.max()), one.shown * times
        lit.shown = replace(lit.shown, color=color)
    lit.geometry.mesh_index = of
    del lit.mesh_of[count:]
    lit.relabel()
