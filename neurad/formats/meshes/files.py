"""Meshes as other programs write them: OBJ, PLY, STL, glTF and USD; to be a room, or things that are put into one."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.scene_records import Bitmap, Constant, Mesh, Texture, constant
from neurad.formats.gltf.read import ENDINGS as GLTF
from neurad.formats.gltf.read import read_gltf
from neurad.formats.meshes.obj import read_obj
from neurad.formats.meshes.ply import Lists, coordinates, corners_of, read_ply
from neurad.formats.meshes.triangles import MeshFile, crossing_note, mesh_of
from neurad.images.image_io import from_srgb
from neurad.runtime.extras import needed
from neurad.runtime.numbers import LENGTH, RADIANCE, within
from neurad.runtime.reading import TEXT_MESH_LIMIT, native, read_bytes, regular_file, shown
from neurad.scene.polygons import triangulate_polygons

KINDS = (".obj", ".ply", ".stl")
"""Files of meshes that are no scenes."""
PLAIN = 0.5
"""Albedo and roughness of a thing that says nothing about its material."""
_NORMALS = ("nx", "ny", "nz")
_UVS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
"""Names that texture coordinates of vertices have in PLY files."""
OBJECTS = (*KINDS, *GLTF)
MESHES = (*OBJECTS, ".usd", ".usdc", ".usda", ".usdz")
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SOLID, _END = re.compile(rb"^\s*solid\b[ \t]*", re.M | re.I), re.compile(rb"\bendsolid\b", re.I)
_BEGUN, _ENDED = re.compile(rb"\bfacet\b", re.I), re.compile(rb"\bendfacet\b", re.I)
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.I)


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
    if kind in GLTF:
        return read_gltf(path)
    if kind not in KINDS:
        with needed("pxr", "usd", f"{shown(path)}: reading it"):
            from neurad.formats.usd.read import read_usd

        return read_usd(path)
    if kind != ".ply" and path.stat().st_size > TEXT_MESH_LIMIT:
        raise InputError(f"{shown(path)}: it has more than {TEXT_MESH_LIMIT >> 20} MB; convert it to binary PLY")
    with native(path, f"it cannot be read as {kind[1:].upper()}"):
        found = {".obj": read_obj, ".ply": _read_ply_mesh, ".stl": _read_stl}[kind](path)
    if not found.meshes:
        raise InputError(f"{shown(path)}: it has no triangle")
    for mesh in found.meshes:
        within(mesh.vertices, f"{shown(path)}: the coordinates of {shown(mesh.name)}", -LENGTH, LENGTH)
        if mesh.radiance is not None:
            within(mesh.radiance, f"{shown(path)}: the radiance (Ke) of material {shown(mesh.name)}", 0.0, RADIANCE)
    return found


def _read_ply_mesh(path: Path) -> MeshFile:
    ply = read_ply(path)
    points = coordinates(path, ply)
    if not ply.get("face"):
        raise InputError(f"{shown(path)}: it has no triangle: it is a cloud of points, or its faces are strips")
    corners = corners_of(path, ply)
    triangles, crossing = triangulate_polygons(points[corners.values], corners.counts)
    vertex, face = ply["vertex"], ply["face"]
    of_corners = isinstance(face.get("texcoord"), Lists)  # vertices cannot have them all
    names = () if of_corners else next((pair for pair in _UVS if set(pair) <= set(vertex)), ())
    mesh = mesh_of(path.stem, points, corners.values[triangles], _stacked(vertex, _NORMALS), _stacked(vertex, names))
    lists = [column for columns in ply.values() for column in columns.values() if isinstance(column, Lists)]
    linkable = all((x.counts == 3).all() for x in lists)
    return _unpainted(path, [mesh], linkable, tuple(crossing_note(path, crossing)))


def _unpainted(path: Path, meshes: list[Mesh], linkable: bool = False, notes: tuple[str, ...] = ()) -> MeshFile:
    """A file without materials; meshes without a triangle are left out."""
    kept = [mesh for mesh in meshes if len(mesh.faces)]
    return MeshFile(path, kept, notes=notes, linkable=linkable, paints=({},) * len(kept))


def _stacked(columns: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """Columns side by side [n, names]; None where one is not there."""
    if not names or not all(isinstance(columns.get(name), np.ndarray) for name in names):
        return None
    return np.stack([np.asarray(columns[name], np.float64) for name in names], -1)


def _read_stl(path: Path) -> MeshFile:
    """The meshes of an STL file, without normals: one, or the solids of a text by their names.

    Raises:
        ValueError: what should be a number is none.
    """
    data = read_bytes(path, TEXT_MESH_LIMIT)
    count = int.from_bytes(data[80:84], "little")
    if data.lstrip()[:5].lower() != b"solid" or len(data) == 84 + 50 * count:
        facets = np.frombuffer(data[84 : 84 + (len(data) - 84) // 50 * 50] if len(data) > 84 else b"", _FACET)
        if len(facets) < count:
            raise InputError(f"{shown(path)}: its header says {count} triangles, but {len(facets)} are there")
        return _unpainted(path, [_soup(path.stem, facets["corners"][:count])])
    found = []
    for solid in _SOLID.split(data)[1:]:
        name, _, body = solid.partition(b"\n")
        corners = [[float(x) for x in match.groups()] for match in _VERTEX.finditer(body)]
        begun, ended = len(_BEGUN.findall(body)), len(_ENDED.findall(body))
        if begun != ended or len(corners) != 3 * begun or not _END.search(body):
            raise InputError(
                f"{shown(path)}: it begins {begun} facets, of which {ended} end, with {len(corners)} corners: it is "
                "cut short or broken; save it again"
            )
        found.append(_soup(name.strip().decode("utf-8", "replace"), np.array(corners).reshape(-1, 3, 3)))
    taken = set[str]()
    names = [make_unique(mesh.name or path.stem, taken) if found[1:] else path.stem for mesh in found]
    return _unpainted(path, [replace(mesh, name=name) for mesh, name in zip(found, names, strict=True)])


def _soup(name: str, corners: Any) -> Mesh:
    """A mesh of triangles [f, 3 corners, 3] that share no vertices."""
    points = np.asarray(corners, np.float64).reshape(-1, 3)
    return mesh_of(name, points, np.arange(len(points)).reshape(-1, 3))


def read_object(path: str | Path, where: str) -> list[tuple[Mesh, Mapping[str, Texture]]]:
    """The meshes of a thing (OBJ, glTF, PLY or STL) in the frame of its file, each with what the file's materials say
    of its surface, as far as they do: textures by the names of surface parameters.

    Raises:
        InputError: the file is missing, of another kind, broken or empty, or a number in it is none to compute with.
    """
    file = regular_file(path, f"there is no such object ({where})")
    kind = file.suffix.lower()
    if kind not in OBJECTS:
        raise InputError(f"{where}: {shown(path)} is not an object that can be read ({', '.join(OBJECTS)})")
    if kind in GLTF:  # whose surfaces do not shine here
        room = read_gltf(file, lamps=False)
        return [(mesh, room.materials[mesh.material].textures) for mesh in room.meshes]
    found = read_meshes(file)
    parts = [_painted(mesh, paint) for mesh, paint in zip(found.meshes, found.paints, strict=True)]
    for mesh, textures in parts:
        for name, texture in textures.items():
            values = texture.value if isinstance(texture, Constant) else texture.pixels  # type: ignore[union-attr]
            within(values, f"{shown(file)}: the {name} of {shown(mesh.name)}", 0.0, 1.0)
    return parts


def _painted(mesh: Mesh, paint: dict[str, Any]) -> tuple[Mesh, Mapping[str, Texture]]:
    """A mesh with the textures of the material of MTL that it has."""
    uvs = mesh.uvs  # in pictures here v runs down, in these files up
    uvs = None if uvs is None else np.stack((uvs[:, 0], 1.0 - uvs[:, 1]), -1).astype(np.float32)
    mesh = replace(mesh, vertices=mesh.vertices.astype(np.float32), uvs=uvs, radiance=None)
    albedo, picture = constant(PLAIN, 3), paint.get("image")
    if (words := paint.get("kd")) is not None:
        albedo = Constant(np.array([float(word) for word in np.atleast_1d(words)][:3], np.float32))
    if picture is None or uvs is None:
        return mesh, {ALBEDO.name: albedo, ROUGHNESS.name: constant(PLAIN)}
    pixels = from_srgb(np.asarray(picture.convert("RGB"), np.float32) / 255.0)
    return mesh, {ALBEDO.name: Bitmap(np.ascontiguousarray(pixels, np.float32)), ROUGHNESS.name: constant(PLAIN)}
