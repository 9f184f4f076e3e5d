"""Lamps that the scene's file or the user tells of."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.lamps.candidates import Candidate, candidate_of
from neurad.lamps.lit_surfaces import LitSurfaces
from neurad.lamps.patches import Patches
from neurad.scene.hints import PlaceHint

Named = tuple[int, Tensor, tuple[float, ...], str]


def named_lamps(lit: LitSurfaces, hints: Sequence[PlaceHint], declared: Sequence[int]) -> list[Named]:
    """What the scene's file and the user say shines: meshes, triangles of them [f], bool, the point where it is all
    that is said, and who says it.
    """
    vertices, faces = (x.cpu().numpy() for x in (lit.geometry.vertices, lit.geometry.faces))
    mesh = torch.tensor(lit.mesh_of).to(lit.geometry.mesh_index)[lit.geometry.mesh_index]
    named: list[Named]
    named = [(index, mesh == index, (), "the scene's file") for index in declared]
    for hint in hints:
        inside = torch.from_numpy(hint.triangles(vertices, faces, lit.scene.origin)).to(mesh.device)
        point, meshes = () if hint.is_box else hint.place, torch.unique(mesh[inside]).tolist()
        named += [(index, inside & (mesh == index), point, hint.source) for index in meshes]
    return named


def dim_lamps(lit: LitSurfaces, named: Sequence[Named], clipped: Tensor) -> list[tuple[Tensor, bool]]:
    """Triangles [f], bool, of each lamp that somebody tells of and that no photograph shows as bright as it is, and
    whether their backs shine.

    Args:
        clipped: surface of each triangle that all views clip [f], -1 for none.
    """
    found = []
    for _, inside, point, _ in named:
        if point:
            inside = (clipped >= 0) & (clipped == clipped[inside])
        turned, shown, _ = lit.shining_side(inside)
        if bool(inside.any()) and (len(shown) == 0 or candidate_of(0, shown).clipped):
            found.append((inside, turned))
    return found


def take_named(lit: LitSurfaces, named: Sequence[Named], patches: Patches) -> None:
    """Take what the scene's file and the user say."""
    for mesh, inside, point, source in named:
        if point:
            piece = int(lit.geometry.mesh_index[inside])
            inside = lit.geometry.mesh_index == piece
            if piece < len(lit.scene.meshes) and all(lamp.piece != piece for lamp in lit.lamps):
                raise InputError(
                    f"{source}: {', '.join(f'{x:g}' for x in point)}: photographs show no patch of like brightness "
                    "there; give a box around it"
                )
        _add(lit, patches, inside, mesh, bool(point), source)


def _add(lit: LitSurfaces, patches: Patches, inside: Tensor, mesh: int, refine: bool, source: str) -> None:
    """Take triangles [f], bool, of a mesh for a lamp, to the side from which they are brighter."""
    of = lit.geometry.mesh_index
    taken = torch.tensor([lamp.piece for lamp in lit.lamps]).to(of)
    free = (torch.tensor(lit.mesh_of).to(of)[of] == mesh) & ~torch.isin(of, taken)
    inside = inside & free
    if not bool(inside.any()):  # found already
        return
    turned, shown, light = lit.shining_side(inside)
    if refine:
        inside = patches.refined(inside, free, turned, light)
    radiance = lit.needed[inside].amax(0)
    side = 2 * len(lit.mesh_of) + turned
    lit.mesh_of.append(mesh)
    lit.geometry.mesh_index = torch.where(inside, side // 2, of)
    hidden = Candidate(side, shown, radiance, bool(radiance.any()))
    lit.lamps.append(replace(candidate_of(side, shown) if len(shown) else hidden, named_by=source))
    lit.relabel()
