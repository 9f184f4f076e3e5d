"""Meshes as other programs write them: OBJ, PLY and STL, read by trimesh, glTF and USD by readers of their own."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, IntArray, Material, Mesh
from neurad.runtime.reading import TEXT_MESH_LIMIT, native, regular_file, shown
from neurad.scene.numbers import LENGTH, RADIANCE, unit, within

KINDS = (".obj", ".ply", ".stl")
"""What trimesh reads."""
MESHES = (*KINDS, ".glb", ".gltf", ".usd", ".usdc", ".usda")


@dataclass(frozen=True)
class MeshFile:
    """The triangles of a file."""

    path: Path
    meshes: list[Mesh]
    """One for each material of the file, by its name; with the radiance that the material emits (``Ke`` in MTL)."""
    linkable: bool
    """Whether the file can take part in a scene as it is: a PLY file of triangles."""
    materials: tuple[Material, ...] = ()
    """What the file says its meshes are made of, by ``Mesh.material``; none where it says nothing."""
    notes: tuple[str, ...] = ()
    """What was decided for the user, a sentence each."""


def read_meshes(path: str | Path) -> MeshFile:
    """The triangles of a mesh file; polygons are cut into triangles.

    Raises:
        InputError: the file is missing, of another kind, broken or empty, or a number in it is none to compute with.
    """
    path = regular_file(path, "there is no such mesh file")
    kind = path.suffix.lower()
    if kind not in MESHES:
        raise InputError(
            f"{shown(path)}: it is no mesh that can be read; export it as one of {', '.join(MESHES)} from the program "
            "that made it, or from Blender"
        )
    if kind not in KINDS:
        return _with_materials(path, kind)
    if kind != ".ply" and path.stat().st_size > TEXT_MESH_LIMIT:
        raise InputError(f"{shown(path)}: it has more than {TEXT_MESH_LIMIT >> 20} MB; convert it to PLY")
    with native(path, f"it cannot be read as {kind[1:].upper()}"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of numbers that are none: they are looked at below
        loaded = loaded_by_trimesh(path)
        parts = [(name, part) for name, part in loaded.geometry.items() if hasattr(part, "faces")]
        if kind == ".obj":
            parts.reverse()  # trimesh takes the file from its end; ids and order of meshes are the file's
        meshes = [mesh_of(name if len(parts) > 1 else path.stem, part, kind == ".stl") for name, part in parts]
    meshes = [mesh for mesh in meshes if len(mesh.faces)]
    if not meshes:
        raise InputError(f"{shown(path)}: it has no triangle")
    for mesh in meshes:
        within(mesh.vertices, f"{shown(path)}: the coordinates of {shown(mesh.name)}", -LENGTH, LENGTH)
        if mesh.radiance is not None:
            within(mesh.radiance, f"{shown(path)}: the radiance (Ke) of material {shown(mesh.name)}", 0.0, RADIANCE)
    return MeshFile(path, meshes, kind == ".ply" and _ply_faces(path) == len(meshes[0].faces))


def loaded_by_trimesh(path: Path) -> Any:
    """The ``trimesh.Scene`` of an OBJ, PLY or STL file, its vertices as the file has them.

    Of PLY files trimesh makes a vertex for each texture coordinate unless it is told otherwise, and loses normals and
    colours where that gives another number of vertices: where one is not used, for example.
    """
    import trimesh

    options: dict[str, Any] = {"fix_texture": False} if path.suffix.lower() == ".ply" else {}
    loaded: Any = trimesh.load_scene(path, process=False, **options)
    if options and b" texcoord" in _header(path):  # of corners: vertices cannot have them all
        for part in loaded.geometry.values():
            part.visual = trimesh.visual.ColorVisuals()
    return loaded


def _with_materials(path: Path, kind: str) -> MeshFile:
    """The triangles of a glTF or USD file."""
    if kind in (".glb", ".gltf"):
        from neurad.scene.readers.gltf import read_gltf

        room = read_gltf(path)
        if room.lights:
            raise InputError(
                f"{shown(path)}: {shown(room.lights[0].name)} is a {room.lights[0].kind} light, and --mesh brings "
                "surfaces alone: `neurad data gltf` takes the whole scene"
            )
        return MeshFile(path, room.meshes, False, tuple(room.materials), room.notes)
    from neurad.scene.readers.usd import read_usd

    return MeshFile(path, read_usd(path), False)


def mesh_of(name: str, part: Any, flat: bool) -> Mesh:
    """One of trimesh's meshes without the vertices that it does not use; without normals if it is ``flat``."""
    faces: IntArray = np.asarray(part.faces, np.int64).reshape(-1, 3)
    vertices = np.asarray(part.vertices, np.float64)
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise ValueError("a face names a vertex that there is not")
    # trimesh computes normals where a file has none; those that a file has are in its cache.
    given = None if flat else part._cache.cache.get("vertex_normals")
    normals = _usable(given, len(vertices), 3)
    uvs = _usable(getattr(part.visual, "uv", None), len(vertices), 2)
    used, corner = np.unique(faces, return_inverse=True)
    if normals is not None:
        normals = normals[used]
        normals = None if (np.linalg.norm(normals, axis=1) < 1e-6).any() else unit(normals)
    return Mesh(
        name,
        vertices[used].astype(np.float32),
        corner.reshape(-1, 3).astype(np.int64),
        0,
        None if normals is None else normals.astype(np.float32),
        None if uvs is None else uvs[used].astype(np.float32),
        radiance=_emitted(part),
    )


def _usable(values: Any, count: int, channels: int) -> FloatArray | None:
    """Values of the vertices, if there are any and all are numbers."""
    if values is None:
        return None
    array: FloatArray = np.asarray(values, np.float64)
    return array if array.shape == (count, channels) and np.isfinite(array).all() else None


def _emitted(part: Any) -> FloatArray | None:
    """What the material of an MTL file emits."""
    material = getattr(part.visual, "material", None)
    words = (getattr(material, "kwargs", None) or {}).get("ke")
    if words is None:
        return None
    radiance: FloatArray = np.array([float(word) for word in np.atleast_1d(words)], np.float32)
    if radiance.shape != (3,):
        raise ValueError("Ke is not three numbers")
    return radiance if radiance.any() else None


def _ply_faces(path: Path) -> int:
    """Number of faces that the header of a PLY file announces; -1 without one."""
    for line in _header(path).splitlines():
        words = line.split()
        if words[:2] == [b"element", b"face"] and len(words) == 3 and words[2].isdigit():
            return int(words[2])
    return -1


def _header(path: Path) -> bytes:
    """The header of a PLY file."""
    with path.open("rb") as file:
        return file.read(1 << 16).partition(b"end_header")[0]
