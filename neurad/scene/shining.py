"""Lamps: which meshes of a scene shine, or patches of them, where its file does not say so, and the parts of one mesh,
such as the bulbs of a chandelier, that shine each by itself.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.scene_records import Constant, Mesh
from neurad.runtime.numbers import RADIANCE
from neurad.scene.connected import connected_parts
from neurad.scene.description import Scene

MAX_PARTS = 256
"""Most parts of a mesh: photographs do not separate more lamps."""


@dataclass(frozen=True)
class Shining:
    """A mesh that shines, or a patch of one."""

    mesh: int
    """Index into ``Scene.meshes``."""
    turned: bool = False
    """Whether it shines to the side of its triangles' backs."""
    triangles: tuple[int, ...] | None = None
    """Those of the mesh that shine; None where all do."""
    albedo: float | None = None
    """What it reflects besides; None where that is what its mesh does."""
    radiance: tuple[float, ...] | None = None
    """What it sends by what it lights, where photographs clip it [3]; None where that is not known."""


def lamps_in_parts(scene: Scene) -> Scene:
    """The scene, with each connected part of a mesh that shines as a mesh of its own, ``NAME_1``, ``NAME_2`` and so on;
    vertices, triangles and radiance stay as they are.

    Raises:
        InputError: a mesh falls into more than :data:`MAX_PARTS` parts.
    """
    names = {mesh.name for mesh in scene.meshes}
    meshes = list[Mesh]()
    for mesh in scene.meshes:
        shines = mesh.radiance is not None and bool(mesh.radiance.any())
        part = connected_parts(mesh.vertices, mesh.faces) if shines else np.zeros(1, np.int64)
        count = int(part.max()) + 1
        if count == 1:
            meshes.append(mesh)
            continue
        if count > MAX_PARTS:
            raise InputError(
                f"scene {scene.name}: model.lighting.split_lamps is true, but mesh {mesh.name} has {count} parts that "
                f"are not connected, and photographs do not separate more than {MAX_PARTS} lamps; leave the option out"
            )
        for index in range(count):
            name = make_unique(f"{mesh.name}_{index + 1}", names)
            meshes.append(replace(mesh.of_triangles(np.flatnonzero(part == index)), name=name, part_of=mesh.name))
    return replace(scene, meshes=meshes)


def without_lamps(scene: Scene) -> Scene:
    """The scene, of whose meshes none shines."""
    return replace(scene, meshes=[m if m.radiance is None else replace(m, radiance=None) for m in scene.meshes])


def shining_scene(scene: Scene, lamps: Sequence[Shining]) -> Scene:
    """The scene with these lamps and no others, all to the front of their triangles. Patches become meshes of their own
    behind all others, without which theirs goes on; of one that they are all of, the first takes the place.
    """
    meshes, materials = without_lamps(scene).meshes, list(scene.materials)
    left = {lamp.mesh: np.ones(len(meshes[lamp.mesh].faces), bool) for lamp in lamps if lamp.triangles is not None}
    added = []
    for lamp, name in zip(lamps, lamp_names(scene, lamps), strict=True):
        mesh = meshes[lamp.mesh]
        if lamp.triangles is not None:
            left[lamp.mesh][list(lamp.triangles)] = False
            mesh = replace(mesh.of_triangles(np.array(lamp.triangles)), name=name, part_of=mesh.name)
        if lamp.albedo is not None:
            paint = Constant(np.full(3, lamp.albedo, np.float32))
            materials.append(replace(materials[mesh.material], name=name, albedo=paint))
            mesh = replace(mesh, material=len(materials) - 1)
        known = lamp.radiance is not None
        radiance = np.array(lamp.radiance, np.float32) if known else np.ones(3, np.float32)
        mesh = replace(_turned(mesh) if lamp.turned else mesh, radiance=radiance, radiance_known=known)
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
    return replace(scene, meshes=meshes + [mesh for _, mesh in added], materials=materials)


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


def shining_state(lamps: Iterable[Shining]) -> list[dict[str, Any]]:
    """Lamps in plain types, as a checkpoint keeps them."""
    return [asdict(lamp) for lamp in lamps]


def shining_from_state(rows: Any, scene: Scene, source: str) -> list[Shining]:
    """Lamps as a checkpoint keeps them.

    Raises:
        InputError: it is something else, or of another scene.
    """
    lamps = [_from_state(row) for row in rows] if isinstance(rows, list) else [None]
    found = [lamp for lamp in lamps if lamp is not None]
    shining = [(lamp.mesh, face) for lamp in found for face in lamp.triangles or (-1,)]
    if len(found) != len(lamps) or len(set(shining)) != len(shining):
        raise InputError(f"{source}: the checkpoint does not say which meshes shine (model.lighting.emitters is find)")
    count = dict(enumerate(len(mesh.faces) for mesh in scene.meshes))
    if any(mesh not in count or face >= count[mesh] for mesh, face in shining):
        raise InputError(f"{source}: the checkpoint's lamps are not meshes of scene {scene.name}")
    return found


def _from_state(row: Any) -> Shining | None:
    """A lamp by its fields in plain types; None where they are none of a lamp."""
    if not isinstance(row, dict) or set(row) != {field.name for field in fields(Shining)}:
        return None
    triangles, albedo, radiance = row["triangles"], row["albedo"], row["radiance"]
    plain = triangles is None or (
        isinstance(triangles, list | tuple) and all(type(x) is int and x >= 0 for x in triangles)
    )
    known = albedo is None or (isinstance(albedo, float) and 0.0 <= albedo <= 1.0)
    known &= radiance is None or (
        isinstance(radiance, list | tuple)
        and len(radiance) == 3
        and all(isinstance(x, float) and 0.0 < x <= RADIANCE for x in radiance)
    )
    if not plain or not known or type(row["mesh"]) is not int or type(row["turned"]) is not bool:
        return None
    return Shining(
        row["mesh"], row["turned"], None if triangles is None else tuple(triangles), albedo,
        None if radiance is None else tuple(radiance),
    )  # fmt: skip


def _turned(mesh: Mesh) -> Mesh:
    """The mesh inside out."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, faces=mesh.faces[:, [0, 2, 1]], normals=normals)
