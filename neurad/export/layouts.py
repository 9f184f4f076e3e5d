"""Texture coordinates for surfaces as their own file has them: polygons of any number of corners, one texture for each
part of a mesh or for everything of one material.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, FloatArray, IntArray
from neurad.core.scene_records import Mesh
from neurad.export.texels import wanted_size
from neurad.export.unwrap import unwrap

Group = Literal["mesh", "material"]
"""What shares a texture: each mesh's part of one material, or all that has one material."""
SIDES = {"mesh": (64, 2048), "material": (512, 2048)}
"""Smallest and largest side of a texture, powers of two, that is chosen."""
TRIES = 3
"""Times that polygons which an atlas tears apart are laid out anew, each by itself."""


@dataclass(frozen=True)
class Polygons:
    """A part of a mesh in the coordinates of its file, without its modifiers."""

    points: FloatArray
    """Places of all corners [c, 3], as large as in the room."""
    corners: IntArray
    """Corners of the triangles [t, 3]: one polygon's share theirs."""
    polygon: IntArray
    """That each triangle belongs to [t]."""
    uvs: FloatArray | None
    """Coordinates of all corners [c, 2], if there are any."""


@dataclass(frozen=True)
class Layout:
    """Where parts of meshes lie in a texture."""

    side: int
    """0 where no coordinates were found: one value has to do."""
    uvs: list[FloatArray | None]
    """Coordinates [c, 2] of all corners for each part, NaN of those of other parts; None where its own serve."""


def lay_out(
    groups: Sequence[Sequence[Polygons]], density: float, budget: int, side: int | None, group: Group
) -> list[Layout]:
    """A layout for each group of parts, which share a texture.

    Args:
        density: texels per unit of length.
        budget: texels of all textures.
        side: of every texture, instead of what each needs.

    Raises:
        InputError: even the smallest textures are more than the budget.
    """
    meshes = [_joined(parts) for parts in groups]
    sides = _sides(meshes, density, budget, group) if side is None else [side] * len(meshes)
    made: dict[int, Layout] = {}
    for one in sorted(set(sides)):
        chosen = [index for index, found in enumerate(sides) if found == one]
        uvs = _unwrapped([meshes[i] for i in chosen], [groups[i] for i in chosen], density, budget, one)
        for index, found in zip(chosen, uvs, strict=True):
            made[index] = Layout(one, found) if found else Layout(0, [])
    return [made[index] for index in range(len(meshes))]


def _sides(meshes: list[Mesh], density: float, budget: int, group: Group) -> list[int]:
    """Powers of two that have at most ``budget`` texels together."""
    low, high = (int(math.log2(side)) for side in SIDES[group])
    wanted = [wanted_size(mesh, density) for mesh in meshes]
    power = np.array([math.log2(max(size.width * size.height, size.least**2, 1.0)) / 2.0 for size in wanted])
    for step in np.arange(0.0, high - low + 1.0, 0.125):
        sides = 2 ** np.clip(np.round(power - step), low, high).astype(np.int64)
        if (sides**2).sum() <= budget:
            return [int(side) for side in sides]
    raise InputError(
        f"--texels {budget}: {len(meshes)} textures have {len(meshes) * 4**low} texels at least; allow more"
        + ("" if group == "material" else ", or share them by --group material")
    )


def _joined(parts: Sequence[Polygons], apart: Sequence[IntArray] | None = None) -> Mesh:
    """The parts as one mesh, beside each other, so that nothing of two parts touches."""
    points, faces, shift = [], [], 0.0
    begin = 0
    for index, part in enumerate(parts):
        used: Array = part.points.astype(np.float64)
        if apart is not None and len(apart[index]):
            used = _flat(used, part, apart[index])
        low, high = used[part.corners].min((0, 1)), used[part.corners].max((0, 1))
        points.append(used - low + [shift, 0.0, 0.0])
        shift += 1.5 * float((high - low).max()) + 1e-6
        faces.append(part.corners + begin)
        begin += len(used)
    uvs = parts[0].uvs if len(parts) == 1 and apart is None else None
    return Mesh("part", np.concatenate(points), np.concatenate(faces).astype(np.int64), 0, None, uvs)


def _flat(points: Array, part: Polygons, torn: IntArray) -> Array:
    """Corners of torn polygons in the planes of these, each polygon far from everything else."""
    points = points.copy()
    step = 4.0 * float(np.ptp(points, 0).max()) + 1e-6
    for number, polygon in enumerate(np.unique(part.polygon[torn])):
        faces = part.corners[part.polygon == polygon]
        a, b, c = (points[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a).sum(0)
        normal /= max(float(np.linalg.norm(normal)), 1e-300)
        corners = np.unique(faces)
        there = points[corners]
        points[corners] = there - ((there - there[0]) @ normal)[:, None] * normal + [0.0, 0.0, (number + 1) * step]
    return points


def _unwrapped(
    meshes: list[Mesh], groups: list[Sequence[Polygons]], density: float, budget: int, side: int
) -> list[list[FloatArray | None]]:
    """The coordinates of textures of one size; corners of a polygon lie together in each."""
    found: list[list[FloatArray | None]] = [[] for _ in meshes]
    torn: list[list[IntArray]] = [[np.zeros(0, np.int64) for _ in parts] for parts in groups]
    waiting = list(range(len(meshes)))
    for _ in range(TRIES):
        charts = unwrap([meshes[i] for i in waiting], np.full(len(waiting), density), budget, side)
        again = []
        for index, chart in zip(waiting, charts, strict=True):
            assert chart.mesh.uvs is not None
            placed = chart.mesh.uvs[chart.mesh.faces]  # [t, 3, 2]
            ends = np.cumsum([len(part.corners) for part in groups[index]])[:-1]
            found[index] = []
            for number, (part, at) in enumerate(zip(groups[index], np.split(placed, ends), strict=True)):
                uvs = np.full((len(part.points), 2), np.nan, np.float32)
                uvs[part.corners] = at
                bad = (np.abs(uvs[part.corners] - at) > 1e-6).any((1, 2))
                torn[index][number] = np.union1d(torn[index][number], np.flatnonzero(bad))
                own = chart.kind == "own" and part.uvs is not None and np.array_equal(
                    uvs[part.corners], part.uvs[part.corners])  # fmt: skip
                found[index].append(None if own else uvs)
                if bad.any() and index not in again:
                    again.append(index)
        for index in again:
            meshes[index] = replace(_joined(groups[index], torn[index]), name=meshes[index].name)
        waiting = again
        if not waiting:
            return found
    return [[] if index in waiting else uvs for index, uvs in enumerate(found)]
