"""Emitting surfaces of scenes that are read: pictures that shine, as triangles of one radiance each, and surfaces that
shine from both sides, as two sheets.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from neurad.core.names import make_unique
from neurad.core.records import Array, FloatArray
from neurad.core.scene_records import Bitmap, Mesh
from neurad.formats.gltf.textures import look_up
from neurad.scene.connected import welded_corners
from neurad.scene.triangles import normals_and_areas

PIECES = 1 << 17
"""Triangles that an emitting picture is cut into, at most, on each mesh."""
RADIANCES = 64
"""Different radiances that the triangles of a mesh have, at most."""
_MAX_DIFFERENCE = 2.0**-9  # difference of radiances, of the largest one, that does not count: half a step of 8 bits
_SAMPLES = 8  # along a side of a piece, at most
_AT_ONCE = 1 << 18  # samples that are looked up at once
_GAP = 1e-4  # distance of two sheets, of the mesh's diagonal


def lit_by(
    picture: Bitmap, mesh: Mesh, uvs: Array, taken: set[str], where: str, say: Callable[[str], None]
) -> list[Mesh]:
    """A mesh that shines by a repeated picture, as meshes of one radiance each and one that does not shine.

    Triangles are cut until no side of a piece is longer than a texel, or as far as :data:`PIECES` allows. A piece has
    the mean radiance of the picture on it. Pieces are grouped so that each group's power is that of its pieces. The
    first part keeps the mesh's name.

    Args:
        mesh: with the radiance that the picture is multiplied by.
        uvs: texture coordinates [v, 2].
        taken: names of meshes, the mesh's own among them; gets those of the other parts.
        say: gets the note that the mesh is cut.
    """
    assert mesh.radiance is not None
    (height, width), to_uv = picture.pixels.shape[:2], picture.to_uv.astype(np.float64)
    texels = np.abs(np.linalg.svd(to_uv[:2, :2] * ((width,), (height,)), compute_uv=False)).max()
    corners = uvs[mesh.faces].astype(np.float64)  # [f, 3, 2]
    sides = (corners - np.roll(corners, 1, 1)) * float(texels)
    longest = float(np.linalg.norm(sides, axis=-1).max())
    parts = max(min(math.ceil(longest), math.isqrt(PIECES // max(len(mesh.faces), 1))), 1)
    pieces = _pieces(parts)  # [k, 3, 3]
    samples = min(max(math.ceil(2.0 * longest / parts), 1), _SAMPLES)
    inside = _pieces(samples).mean(1)  # [s, 3]
    shines = np.empty((len(mesh.faces), len(pieces), 3))
    flat, chunk = shines.reshape(-1, 3), max(_AT_ONCE // len(inside), 1)
    for begin in range(0, len(flat), chunk):
        face, piece = np.divmod(np.arange(begin, min(begin + chunk, len(flat))), len(pieces))
        seen = look_up(picture.pixels, to_uv, inside @ (pieces[piece] @ corners[face]))
        flat[begin : begin + chunk] = seen.mean(1) * mesh.radiance
    most = float(shines.max())
    if most == 0.0:
        return [replace(mesh, radiance=None)]
    even = np.ptp(shines, axis=1).max(-1) <= _MAX_DIFFERENCE * most
    whole, halved = np.flatnonzero(even), np.flatnonzero(~even)
    face = np.concatenate((whole, np.repeat(halved, len(pieces))))
    bary = np.concatenate((np.broadcast_to(np.eye(3), (len(whole), 3, 3)), np.tile(pieces, (len(halved), 1, 1))))
    radiance = np.concatenate((shines[whole].mean(1), shines[halved].reshape(-1, 3)))
    area = areas(mesh)[face] / np.concatenate((np.ones(len(whole)), np.full(len(face) - len(whole), len(pieces))))
    group = _groups(radiance, area, most)
    lit = list[Mesh]()
    for index in np.unique(group):
        mine = group == index
        weight = np.maximum(area[mine], 1e-300)
        mean = None if index < 0 else np.average(radiance[mine], axis=0, weights=weight).astype(np.float32)
        name = make_unique(mesh.name, taken) if lit else mesh.name
        lit.append(_soup(replace(mesh, name=name, radiance=mean), face[mine], bary[mine]))
    if len(lit) > 1:
        count = sum(len(part.faces) for part in lit)
        say(f"{where} shines by a picture: it is cut into {count} triangles of {len(lit)} radiances")
    return lit


def backs_of(mesh: Mesh, lit: Sequence[Mesh], taken: set[str]) -> list[Mesh]:
    """The sheets by which the parts of a mesh shine from its back, too; none where they are dark or nothing sees them.

    Args:
        taken: names of meshes; gets those of the sheets.
    """
    if all(part.radiance is None for part in lit) or _is_closed(mesh):
        return []
    return [replace(_back_of(part), name=make_unique(f"{part.name} (back)", taken)) for part in lit]


def _pieces(parts: int) -> Array:
    """A triangle cut into ``parts`` squared alike: barycentrics of their corners [k, 3 corners, 3]."""
    made = []
    for i in range(parts):
        for j in range(parts - i):
            made.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j + 2 <= parts:
                made.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    ij = np.array(made, np.float64)
    third = parts - ij.sum(-1, keepdims=True)
    return np.concatenate((third, ij), -1) / parts


def areas(mesh: Mesh) -> Array:
    """Areas of a mesh's triangles [f]."""
    return normals_and_areas(mesh.vertices[mesh.faces].astype(np.float64))[1]


def _groups(radiance: Array, area: Array, most: float) -> Array:
    """Which of at most :data:`RADIANCES` groups each piece belongs to [p]; -1 for what does not shine.

    The group with the most light off its mean is cut in two, at the mean of the colour that differs most.
    """
    group = np.where(radiance.max(-1) > 0.5 * _MAX_DIFFERENCE * most, 0, -1)
    weight = area + 1e-9 * area.sum() + 1e-300
    count, errors = 1, {0: math.inf}
    while count < RADIANCES and (worst := max(errors, key=errors.__getitem__)) >= 0 and errors[worst] > 0.0:
        mine = np.flatnonzero(group == worst)
        if len(mine) == 0 or np.ptp(radiance[mine], axis=0).max() <= _MAX_DIFFERENCE * most:
            errors[worst] = 0.0
            continue
        axis = int(np.ptp(radiance[mine], axis=0).argmax())
        values = radiance[mine, axis]
        threshold = min(float(np.average(values, weights=weight[mine])), float(np.nextafter(values.max(), -1.0)))
        group[mine[values > threshold]] = count
        for index in (worst, count):
            part = group == index
            mean = np.average(radiance[part], axis=0, weights=weight[part])
            errors[index] = float((weight[part] * np.abs(radiance[part] - mean).sum(-1)).sum())
        count += 1
    return group


def _soup(mesh: Mesh, face: Array, bary: Array) -> Mesh:
    """Pieces of triangles, none of which share vertices."""

    def at(values: FloatArray) -> FloatArray:
        corners = values[mesh.faces[face]].astype(np.float64)  # [p, 3, c]
        return np.asarray((bary @ corners).reshape(-1, values.shape[1]), values.dtype)

    return replace(
        mesh,
        vertices=at(mesh.vertices),
        faces=np.arange(3 * len(face), dtype=np.int64).reshape(-1, 3),
        normals=None if mesh.normals is None else at(mesh.normals),
        uvs=None if mesh.uvs is None else at(mesh.uvs),
        attributes={name: at(values) for name, values in mesh.attributes.items()},
    )


def _is_closed(mesh: Mesh) -> bool:
    """Whether a surface has no border and its front faces outwards: what leaves its back stays inside."""
    begin = welded_corners(mesh.vertices, mesh.faces)
    end, count = np.roll(begin, -1, 1), len(mesh.vertices)
    if not np.array_equal(np.sort(begin * count + end, axis=None), np.sort(end * count + begin, axis=None)):
        return False
    p = mesh.vertices[mesh.faces].astype(np.float64) - mesh.vertices.mean(0)
    return float(np.einsum("fx,fx->", p[:, 0], np.cross(p[:, 1], p[:, 2]))) > 0


def _back_of(mesh: Mesh) -> Mesh:
    """The other side of a sheet, a hair behind it: light leaves a triangle to one side."""
    p = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        np.add.at(normal, mesh.faces[:, corner], across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices.astype(np.float64), axis=0)))
    far = 8e-6 * float(np.abs(mesh.vertices).max(initial=0.0))  # what float32 needs, where the room stays so far away
    gap = max(_GAP * diagonal, min(far, 0.01 * diagonal))
    vertices: Any = mesh.vertices - gap * normal
    return replace(
        mesh,
        vertices=vertices,
        faces=mesh.faces[:, [0, 2, 1]],
        normals=None if mesh.normals is None else -mesh.normals,
    )
