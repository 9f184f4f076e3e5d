"""Lamps whose connected parts shine each by itself: the bulbs of a chandelier that is one mesh."""

from dataclasses import replace

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.scene_records import Mesh
from neurad.scene.connected import connected_parts
from neurad.scene.description import Scene

MAX_PARTS = 256
"""Most parts of a mesh: photographs do not separate more lamps."""


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
