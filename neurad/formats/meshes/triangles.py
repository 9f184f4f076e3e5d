"""What a mesh file has, and its triangles as meshes."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, Float64Array, FloatArray, IntArray
from neurad.core.scene_records import EnvironmentMap, Material, Mesh, PunctualLight
from neurad.formats.cameras.intrinsics import SceneCamera
from neurad.runtime.numbers import unit
from neurad.runtime.reading import shown


@dataclass(frozen=True)
class MeshFile:
    """What a file of meshes has, be it a scene or triangles alone."""

    path: Path
    meshes: list[Mesh]
    """In the frame of the file, with the radiance that they emit; one for each material of what is no scene."""
    materials: tuple[Material, ...] = ()
    """What the file says its meshes are made of, by ``Mesh.material``; none where it says nothing."""
    notes: tuple[str, ...] = ()
    """What was decided for the user, a sentence each."""
    lights: tuple[PunctualLight, ...] = ()
    cameras: tuple[SceneCamera, ...] = ()
    environment: EnvironmentMap | None = None
    up: str | None = None
    """The axis that points up, if the file says it."""
    linkable: bool = False
    """Whether the file can take part in a scene as it is: a PLY file of triangles."""
    paints: tuple[dict[str, Any], ...] = ()
    """What MTL says of each mesh of an OBJ, PLY or STL file, by its keys in lower case; empty where it says nothing."""
    own: dict[str, Any] = field(default_factory=dict)
    """What neurad's own export says of the scene besides."""


def mesh_of(
    name: str,
    vertices: Float64Array,
    faces: IntArray,
    normals: Float64Array | None = None,
    uvs: Float64Array | None = None,
    radiance: FloatArray | None = None,
) -> Mesh:
    """A mesh of the vertices that triangles use, in their order; positions stay float64, see ``scene.origin``.

    Args:
        vertices: [v, 3].
        faces: indices of the vertices [f, 3], which exist.
        normals: of the vertices [v, 3]; left out where one has no length or is no number.
        uvs: texture coordinates of the vertices [v, 2]; left out where one is no number.
        radiance: [3].
    """
    used, corner = np.unique(faces, return_inverse=True)
    if normals is not None:
        normals = normals[used]
        usable = np.isfinite(normals).all() and (np.linalg.norm(normals, axis=1) >= 1e-6).all()
        normals = unit(normals) if usable else None
    if uvs is not None:
        uvs = uvs[used] if np.isfinite(uvs[used]).all() else None
    return Mesh(
        name,
        vertices[used],  # type: ignore[arg-type]
        corner.reshape(-1, 3).astype(np.int64),
        0,
        None if normals is None else normals.astype(np.float32),
        None if uvs is None else uvs.astype(np.float32),
        radiance=radiance,
    )


def check_corners(path: Path, corners: Array, counts: IntArray | int, vertices: int, first: int = 0) -> None:
    """Check that there are the vertices that faces name.

    Args:
        corners: of all faces, their vertices counted from 0 [c].
        counts: corners of each face [f], or of every one.
        first: number of the first face and vertex in the sentence.
    """
    if len(corners) == 0 or (corners.min() >= 0 and corners.max() < vertices):
        return
    wrong = int(np.flatnonzero(~((corners >= 0) & (corners < vertices)))[0])
    face = wrong // counts if isinstance(counts, int) else int(np.searchsorted(np.cumsum(counts), wrong, "right"))
    raise InputError(
        f"{shown(path)}: face {face + first} names vertex {float(corners[wrong]) + first:.0f}, of {vertices} (numbered "
        f"{first} to {vertices - 1 + first})"
    )


def crossing_note(path: Path, crossing: IntArray) -> list[str]:
    """What is to be said of polygons whose edges cross: a sentence, or nothing."""
    if len(crossing) == 0:
        return []
    return [
        f"{shown(path)}: the edges of {len(crossing)} polygons cross (the first of them is face {crossing[0] + 1}), so "
        "that their surface is a guess; triangulate them in the program that the file comes from"
    ]


def moved_mesh(mesh: Mesh, similarity: Array) -> Mesh:
    """A mesh in another frame, to which ``similarity`` takes its own [4, 4]."""
    vertices, normals, faces = in_world(similarity, mesh.vertices, mesh.normals, mesh.faces)
    return replace(mesh, vertices=vertices, normals=normals, faces=faces)


def in_world(
    to_world: Array, places: Array, normals: Array | None, faces: IntArray
) -> tuple[FloatArray, FloatArray | None, IntArray]:
    """Vertices (float64 where they move), unit normals and triangles, wound the other way round by a mirror."""
    turned = None if normals is None else normals.astype(np.float32)
    if turned is not None:
        turned = np.where(np.isfinite(turned), turned, np.float32(0.0))
    if np.array_equal(to_world, np.eye(4)):
        return places, turned, faces
    linear = to_world[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        vertices: Any = places.astype(np.float64) @ linear.T + to_world[:3, 3]
    if turned is not None:
        turned = unit(turned.astype(np.float64) @ np.linalg.inv(linear)).astype(np.float32)
    return vertices, turned, faces[:, [0, 2, 1]] if np.linalg.det(linear) < 0 else faces
