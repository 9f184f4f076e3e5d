"""Lamps that the scene's file or the user tells of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.lamps.candidates import Candidate, candidate_of
from neurad.lamps.lit_surfaces import LitSurfaces
from neurad.lamps.patches import Patches
from neurad.scene.hints import PlaceHint


@dataclass(frozen=True)
class Named:
    """A mesh, or a place of one, that somebody says shines."""

    mesh: int
    """Index into ``Scene.meshes``."""
    inside: Tensor
    """Its triangles that are meant [f], bool."""
    point: tuple[float, ...]
    """The point that is all that is said; empty where all of the triangles are meant."""
    source: str
    """Who says it."""


def named_lamps(lit: LitSurfaces, hints: Sequence[PlaceHint], declared: Sequence[int]) -> list[Named]:
    """What the user says shines, and the ``declared`` meshes of the scene's file."""
    vertices, faces = (x.cpu().numpy() for x in (lit.geometry.vertices, lit.geometry.faces))
    mesh = torch.tensor(lit.mesh_of).to(lit.geometry.mesh_index)[lit.geometry.mesh_index]
    named = [Named(index, mesh == index, (), "the scene's file") for index in declared]
    for hint in hints:
        inside = torch.from_numpy(hint.triangles(vertices, faces, lit.scene.origin)).to(mesh.device)
        point, meshes = () if hint.is_box else hint.place, torch.unique(mesh[inside]).tolist()
        named += [Named(index, inside & (mesh == index), point, hint.source) for index in meshes]
    return named


def dim_lamps(lit: LitSurfaces, named: Sequence[Named], clipped: Tensor) -> list[tuple[Tensor, bool]]:
    """Triangles [f], bool, of each lamp that somebody tells of and that no photograph shows as bright as it is, and
    whether their backs shine; by the surface of each triangle that all views clip [f], -1 for none.
    """
    found = []
    for one in named:
        inside = one.inside
        if one.point:
            inside = (clipped >= 0) & (clipped == clipped[inside])
        turned, shown, _ = lit.shining_side(inside)
        if bool(inside.any()) and (len(shown) == 0 or candidate_of(0, shown).clipped):
            found.append((inside, turned))
    return found


def take_named(lit: LitSurfaces, named: Sequence[Named], patches: Patches) -> None:
    """Take what the scene's file and the user say."""
    for one in named:
        if one.point:
            piece = int(lit.geometry.mesh_index[one.inside])
            if piece < len(lit.scene.meshes) and all(lamp.piece != piece for lamp in lit.lamps):
                raise InputError(
                    f"{one.source}: {', '.join(f'{x:g}' for x in one.point)}: photographs show no patch of like "
                    "brightness there; give a box around it"
                )
            one = replace(one, inside=lit.geometry.mesh_index == piece)
        _add(lit, one, patches)


def _add(lit: LitSurfaces, one: Named, patches: Patches) -> None:
    """Take triangles of a mesh for a lamp, to the side from which they are brighter."""
    of = lit.geometry.mesh_index
    taken = torch.tensor([lamp.piece for lamp in lit.lamps]).to(of)
    free = (torch.tensor(lit.mesh_of).to(of)[of] == one.mesh) & ~torch.isin(of, taken)
    inside = one.inside & free
    if not bool(inside.any()):  # found already
        return
    turned, shown, light = lit.shining_side(inside)
    if one.point:
        inside = patches.refined(inside, free, turned, light)
    radiance = lit.needed[inside].amax(0)
    side = 2 * len(lit.mesh_of) + turned
    lit.mesh_of.append(one.mesh)
    lit.geometry.mesh_index = torch.where(inside, side // 2, of)
    hidden = Candidate(side, shown, radiance, bool(radiance.any()))
    lit.lamps.append(replace(candidate_of(side, shown) if len(shown) else hidden, named_by=one.source))
    lit.relabel()
