"""Lamps whose connected parts shine each by itself: the bulbs of a chandelier that is one mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, IntArray, Mesh
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
    meshes = []
    for mesh in scene.meshes:
        shines = mesh.radiance is not None and bool(mesh.radiance.any())
        meshes += list(_parts(mesh, parts_of(mesh), names, scene.name)) if shines else [mesh]
    return replace(scene, meshes=meshes)


def parts_of(mesh: Mesh) -> IntArray:
    """Which connected part each triangle belongs to [f], counted from 0 as they come. Vertices at the same place are
    the same, since files split them where normals or texture coordinates jump.
    """
    places, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]  # [f, 3]
    part = np.arange(len(places))  # of each place: the lowest place that it is known to be connected with
    while True:
        lower = part.copy()
        of_corners = part[faces]
        np.minimum.at(lower, of_corners, of_corners.min(1, keepdims=True))  # what they hang on, so that chains halve
        while not np.array_equal(lower, lower[lower]):
            lower = lower[lower]
        if np.array_equal(lower, part):
            break
        part = lower
    _, first, number = np.unique(part[faces[:, 0]], return_index=True, return_inverse=True)
    order: IntArray = np.argsort(np.argsort(first))[number.reshape(-1)]
    return order


def _parts(mesh: Mesh, part: IntArray, names: set[str], scene: str) -> Iterator[Mesh]:
    """The parts of a mesh as meshes; the mesh itself where there is one. ``names`` are taken, and get theirs."""
    count = int(part.max()) + 1
    if count == 1:
        yield mesh
        return
    if count > MAX_PARTS:
        raise InputError(
            f"scene {scene}: model.lighting.split_lamps is true, but mesh {mesh.name} has {count} parts that are not "
            f"connected, and photographs do not separate more than {MAX_PARTS} lamps; leave the option out"
        )
    for index in range(count):
        used, corners = np.unique(mesh.faces[part == index], return_inverse=True)

        def of_used(values: FloatArray | None, used: IntArray = used) -> FloatArray | None:
            return None if values is None else values[used]

        name = f"{mesh.name}_{index + 1}"
        while name in names:
            name += "_"
        names.add(name)
        yield replace(
            mesh,
            name=name,
            vertices=mesh.vertices[used],
            faces=corners.reshape(-1, 3).astype(mesh.faces.dtype),
            normals=of_used(mesh.normals),
            uvs=of_used(mesh.uvs),
            attributes={key: values[used] for key, values in mesh.attributes.items()},
            part_of=mesh.name,
        )
