"""Which meshes of a scene shine, where its file does not say so."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Mesh
from neurad.scene.description import Scene


@dataclass(frozen=True)
class Shining:
    """A mesh that shines."""

    mesh: int
    """Index into ``Scene.meshes``."""
    turned: bool = False
    """Whether it shines to the side of its triangles' backs."""


def without_lamps(scene: Scene) -> Scene:
    """The scene, of whose meshes none shines."""
    return replace(scene, meshes=[m if m.radiance is None else replace(m, radiance=None) for m in scene.meshes])


def shining_scene(scene: Scene, lamps: Iterable[Shining]) -> Scene:
    """The scene with these lamps and no others, of radiance 1, all to the front of their triangles."""
    found = {lamp.mesh: lamp for lamp in lamps}
    meshes = without_lamps(scene).meshes
    for index, lamp in found.items():
        mesh = _turned(meshes[index]) if lamp.turned else meshes[index]
        meshes[index] = replace(mesh, radiance=np.ones(3, np.float32))
    return replace(scene, meshes=meshes)


def shining_state(lamps: Iterable[Shining]) -> list[list[int]]:
    """Lamps in plain types, as a checkpoint keeps them."""
    return [[lamp.mesh, int(lamp.turned)] for lamp in lamps]


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
        isinstance(row, list) and len(row) == 2 and all(type(x) is int for x in row) and row[1] in (0, 1)
        for row in rows
    )
    if not whole or len({row[0] for row in rows}) != len(rows):
        raise InputError(f"{source}: the checkpoint does not say which meshes shine (model.lighting.emitters is find)")
    if any(not 0 <= row[0] < len(scene.meshes) for row in rows):
        raise InputError(f"{source}: the checkpoint's lamps are not meshes of scene {scene.name}")
    return [Shining(row[0], bool(row[1])) for row in rows]


def _turned(mesh: Mesh) -> Mesh:
    """The mesh inside out."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, faces=mesh.faces[:, [0, 2, 1]], normals=normals)
