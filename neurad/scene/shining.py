"""Which meshes of a scene shine, or patches of them, where its file does not say so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Mesh
from neurad.scene.description import Scene


@dataclass(frozen=True)
class Shining:
    """A mesh that shines, or a patch of one."""

    mesh: int
    """Index into ``Scene.meshes``."""
    turned: bool = False
    """Whether it shines to the side of its triangles' backs."""
    triangles: tuple[int, ...] | None = None
    """Those of the mesh that shine; None where all do."""


def without_lamps(scene: Scene) -> Scene:
    """The scene, of whose meshes none shines."""
    return replace(scene, meshes=[m if m.radiance is None else replace(m, radiance=None) for m in scene.meshes])


def shining_scene(scene: Scene, lamps: Sequence[Shining]) -> Scene:
    """The scene with these lamps and no others, of radiance 1, all to the front of their triangles. Patches become
    meshes of their own behind all others, without which theirs goes on; of one that they are all of, the first takes
    the place.
    """
    meshes = without_lamps(scene).meshes
    left = {lamp.mesh: np.ones(len(meshes[lamp.mesh].faces), bool) for lamp in lamps if lamp.triangles is not None}
    added = []
    for lamp, name in zip(lamps, lamp_names(scene, lamps), strict=True):
        mesh = meshes[lamp.mesh]
        if lamp.triangles is not None:
            left[lamp.mesh][list(lamp.triangles)] = False
            mesh = replace(mesh.of_triangles(np.array(lamp.triangles)), name=name, part_of=mesh.name)
        mesh = replace(_turned(mesh) if lamp.turned else mesh, radiance=np.ones(3, np.float32))
        if lamp.triangles is None:
            meshes[lamp.mesh] = mesh
        else:
            added.append((lamp.mesh, mesh))
    for index, kept in left.items():
        if kept.any():
            meshes[index] = meshes[index].of_triangles(np.flatnonzero(kept))
        else:
            place = next(i for i, (of, _) in enumerate(added) if of == index)
            meshes[index] = added.pop(place)[1]
    return replace(scene, meshes=meshes + [mesh for _, mesh in added])


def lamp_names(scene: Scene, lamps: Iterable[Shining]) -> list[str]:
    """Names of the meshes of lamps in :func:`shining_scene`: of patches ``NAME_lamp_1`` and so on."""
    names, count = {mesh.name for mesh in scene.meshes}, Counter[int]()
    found = []
    for lamp in lamps:
        name = scene.meshes[lamp.mesh].name
        if lamp.triangles is not None:
            count[lamp.mesh] += 1
            name = make_unique(f"{name}_lamp_{count[lamp.mesh]}", names)
        found.append(name)
    return found


def shining_state(lamps: Iterable[Shining]) -> list[list[int]]:
    """Lamps in plain types, as a checkpoint keeps them: mesh, side, and the triangles of a patch."""
    return [[lamp.mesh, int(lamp.turned), *(lamp.triangles or ())] for lamp in lamps]


def shining_from_state(rows: Any, scene: Scene, source: str) -> list[Shining]:
    """Lamps as a checkpoint keeps them.

    Args:
        rows: what :func:`shining_state` gave.
        scene: that they are of.
        source: begins the error message.

    Raises:
        InputError: it is something else, or of another scene.
    """
    whole = isinstance(rows, list) and all(
        isinstance(row, list) and len(row) >= 2 and all(type(x) is int for x in row) and row[1] in (0, 1)
        for row in rows
    )
    shining = [(row[0], face) for row in rows for face in row[2:] or (-1,)] if whole else []
    if not whole or len(set(shining)) != len(shining):
        raise InputError(f"{source}: the checkpoint does not say which meshes shine (model.lighting.emitters is find)")
    count = dict(enumerate(len(mesh.faces) for mesh in scene.meshes))
    if any(face >= count.get(mesh, -1) for mesh, face in shining):
        raise InputError(f"{source}: the checkpoint's lamps are not meshes of scene {scene.name}")
    return [Shining(row[0], bool(row[1]), tuple(row[2:]) or None) for row in rows]


def _turned(mesh: Mesh) -> Mesh:
    """The mesh inside out."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, faces=mesh.faces[:, [0, 2, 1]], normals=normals)
