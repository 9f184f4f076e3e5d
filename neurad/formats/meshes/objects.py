"""A thing to be put into a scene: its meshes with the materials that the file gives them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.scene_records import Bitmap, Constant, Mesh, Texture, constant
from neurad.formats.gltf.read import ENDINGS as GLTF
from neurad.formats.gltf.read import read_gltf
from neurad.formats.meshes.files import KINDS, read_meshes
from neurad.images.image_io import from_srgb
from neurad.runtime.numbers import within
from neurad.runtime.reading import regular_file, shown

OBJECTS = (*KINDS, *GLTF)
PLAIN = 0.5
"""Albedo and roughness of what says nothing about its material."""


@dataclass(frozen=True)
class Part:
    """One mesh of a thing."""

    mesh: Mesh
    textures: Mapping[str, Texture]
    """By the name of the surface parameter."""


def read_object(path: str | Path, where: str) -> list[Part]:
    """The meshes of a thing (OBJ, glTF, PLY or STL) in the frame of its file, with what the file's materials say of
    their surface, as far as they do.

    Raises:
        InputError: the file is missing, of another kind, broken or empty, or a number in it is none to compute with.
    """
    file = regular_file(path, f"there is no such object ({where})")
    kind = file.suffix.lower()
    if kind not in OBJECTS:
        raise InputError(f"{where}: {shown(path)} is not an object that can be read ({', '.join(OBJECTS)})")
    if kind in GLTF:  # whose surfaces do not shine here
        room = read_gltf(file, lamps=False)
        return [Part(mesh, room.materials[mesh.material].textures) for mesh in room.meshes]
    found = read_meshes(file)
    parts = [_part(mesh, paint) for mesh, paint in zip(found.meshes, found.paints, strict=True)]
    for part in parts:
        for name, texture in part.textures.items():
            values = texture.value if isinstance(texture, Constant) else texture.pixels  # type: ignore[union-attr]
            within(values, f"{shown(file)}: the {name} of {shown(part.mesh.name)}", 0.0, 1.0)
    return parts


def _part(mesh: Mesh, paint: dict[str, Any]) -> Part:
    """A mesh with the material of MTL that it has."""
    uvs = mesh.uvs  # in pictures here v runs down, in these files up
    uvs = None if uvs is None else np.stack((uvs[:, 0], 1.0 - uvs[:, 1]), -1).astype(np.float32)
    mesh = replace(mesh, vertices=mesh.vertices.astype(np.float32), uvs=uvs, radiance=None)
    return Part(mesh, {ALBEDO.name: _colour(paint, uvs is not None), ROUGHNESS.name: constant(PLAIN)})


def _colour(paint: dict[str, Any], mapped: bool) -> Texture:
    factor = np.full(3, PLAIN, np.float32)
    if (words := paint.get("kd")) is not None:
        factor = np.array([float(word) for word in np.atleast_1d(words)][:3], np.float32)
    picture = paint.get("image")
    if picture is None or not mapped:
        return Constant(factor)
    pixels = from_srgb(np.asarray(picture.convert("RGB"), np.float32) / 255.0)
    return Bitmap(np.ascontiguousarray(pixels, np.float32))
