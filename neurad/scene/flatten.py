"""Walls, floors and tables of a scan, which scanners give waves and noise, made as flat as they are.

A scan is off by millimetres. Where its surface is bent, shading is that of another surface, which a fit takes for
stains of the albedo, and photographs are seen beside the place that they show. So what lies on a plane, see
:mod:`neurad.scene.planes`, is moved onto it. Modelled rooms, whose walls are flat already, stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from neurad.core.records import Float64Array, IntArray
from neurad.core.scene_records import Mesh
from neurad.scene.description import Scene
from neurad.scene.planes import Surface, find_planes, surface_of
from neurad.scene.triangles import normals_and_areas

FLAT, MODELLED = 2.0**-21, 0.05
"""Height of a triangle over its neighbour's plane, in extents of the coordinates, up to which numbers of 32 bits cannot
tell them from one polygon, and fraction of area with such neighbours from which on somebody modelled a mesh: rooms have
0.1 to 0.6, scans hardly any."""
APART = 0.05
"""Least eigenvalue of planes that meet in a vertex for it to be moved along; planes of nearly one normal share one."""


@dataclass(frozen=True)
class Flattened:
    """Meshes whose planes are flat."""

    meshes: list[Mesh]
    """With the triangles of those that were given, in their order."""
    planes: int = 0
    share: float = 0.0
    """Fraction of the area that is on planes."""
    moved: float = 0.0
    """Root mean square of the way of vertices on planes."""
    farthest: float = 0.0
    """Longest one."""


def flattened(scene: Scene) -> Scene:
    """The scene; where its mesh is to be refined, with flat planes, which its notes say."""
    if scene.photography.mesh == "fixed":
        return scene
    found = flatten_planes(scene.meshes)
    if found.planes == 0:
        return scene
    note = (
        f"the mesh is a scan: {found.planes} planes, {100.0 * found.share:.0f} % of its area, are flat now; that moved "
        f"them by {found.moved:.2g} scene units (rms), {found.farthest:.2g} at most"
    )
    return replace(scene, meshes=found.meshes, notes=(*scene.notes, note))


def flatten_planes(meshes: Sequence[Mesh]) -> Flattened:
    """Scans with flat planes; modelled rooms are given back as they are. What shines plays no part: a room keeps its
    geometry under another light.

    Args:
        meshes: of one scene, in one unit.
    """
    if sum(len(mesh.faces) for mesh in meshes) == 0 or are_modelled(meshes):
        return Flattened(list(meshes))
    surface = surface_of(meshes)
    planes, label = find_planes(surface)
    if not (label >= 0).any():
        return Flattened(list(meshes))
    normals = np.stack([plane.normal for plane in planes])
    step = _steps(surface, normals, np.array([plane.offset for plane in planes]), label)
    flat = label >= 0
    way = np.linalg.norm(step[np.unique(surface.place[flat])], axis=-1)
    ends = np.cumsum([len(mesh.faces) for mesh in meshes])[:-1]
    parts = zip(meshes, np.split(surface.place, ends), np.split(label, ends), strict=True)
    found = [_moved(mesh, place, step, planes_of, normals) for mesh, place, planes_of in parts]
    share = float(surface.area[flat].sum() / surface.area.sum())
    return Flattened(found, len(np.unique(label[flat])), share, float(np.sqrt(np.square(way).mean())), float(way.max()))


def are_modelled(meshes: Sequence[Mesh]) -> bool:
    """Whether many triangles are one polygon with the next one of their file, or nothing has an area."""
    total = flat = 0.0
    extent = max(float(np.abs(mesh.vertices).max(initial=0.0)) for mesh in meshes)
    for mesh in meshes:
        one, other = mesh.faces[:-1], mesh.faces[1:]
        same = mesh.vertices[other][:, :, None] == mesh.vertices[one][:, None]  # [pairs, of the other, of one, 3]
        equal = same.all(-1)
        near = np.flatnonzero(equal.any(-1).sum(-1) == 2)  # an edge in common, and a vertex each that is not
        equal = equal[near]
        corners = mesh.vertices[one[near]].astype(np.float64)
        rows = np.arange(len(near))
        own = corners[rows, equal.any(1).argmin(-1)]
        last = mesh.vertices[other[near, equal.any(2).argmin(-1)]].astype(np.float64)
        normal, area = normals_and_areas(corners)
        height = np.abs(((last - own) * normal).sum(-1))
        # halves of a triangle whose side was cut say nothing of the next one
        sides = np.linalg.norm(np.cross(corners - own[:, None], (last - own)[:, None]), axis=-1)
        sides[rows, equal.any(1).argmin(-1)] = np.inf
        counts = sides.min(-1) > 0.01 * area
        total += float(normals_and_areas(mesh.vertices[mesh.faces].astype(np.float64))[1].sum())
        flat += float(area[counts & (height <= FLAT * extent)].sum())
    return flat >= MODELLED * total


def _steps(surface: Surface, normals: Float64Array, offsets: Float64Array, label: IntArray) -> Float64Array:
    """How far each place is moved [places, 3]: onto all planes of its triangles, the shortest way. What lies near goes
    along, less with the distance, so that small triangles at the border do not fold.
    """
    from scipy.spatial import cKDTree  # imported where it is needed: it loads slowly

    points, count = surface.points, len(surface.points)
    place, plane = surface.on_planes(label)
    normal = normals[plane]
    height = (points[place] * normal).sum(-1) - offsets[plane]
    square, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(square, place, normal[:, :, None] * normal[:, None])
    np.add.at(right, place, -height[:, None] * normal)
    on = np.unique(place)
    size, axis = np.linalg.eigh(square[on])
    inverse = np.where(size > APART, 1.0 / np.maximum(size, APART), 0.0)
    step = np.zeros((count, 3))
    step[on] = np.einsum("nij,nj,nkj,nk->ni", axis, inverse, axis, right[on])
    # ---- what lies near goes along
    free = np.ones(count, bool)
    free[on] = False
    way = np.linalg.norm(step[on], axis=-1)
    reach = 4.0 * float(way.max())
    distance, nearest = cKDTree(points[on]).query(points[free], distance_upper_bound=max(reach, 1e-30))
    found = np.isfinite(distance)
    rows = np.flatnonzero(free)[found]
    step[rows] = step[on[nearest[found]]] * (1.0 - distance[found] / max(reach, 1e-30))[:, None]
    return step


def _moved(mesh: Mesh, place: IntArray, step: Float64Array, label: IntArray, normals: Float64Array) -> Mesh:
    """A mesh with its vertices moved, and the normals of planes; vertices at their borders are there twice then.

    Args:
        mesh: with triangles [f, 3].
        place: of their corners [f, 3], by which ``step`` [places, 3] is numbered.
        label: the plane of each triangle [f], -1 for none.
        normals: of planes [p, 3].
    """
    of_vertex = np.zeros(len(mesh.vertices), np.int64)
    used = np.zeros(len(mesh.vertices), bool)
    of_vertex[mesh.faces], used[mesh.faces] = place, True
    shift, has_planes = np.where(used[:, None], step[of_vertex], 0.0), (label >= 0).any()
    if not shift.any() and not has_planes:
        return mesh
    mesh = replace(mesh, vertices=(mesh.vertices + shift).astype(mesh.vertices.dtype), as_read=mesh.vertices)
    if mesh.normals is None or not has_planes:
        return mesh
    # ---- a vertex for each side of a plane that it is on, whose normal faces as those of the triangle did
    facing = (mesh.normals[mesh.faces].sum(1) * normals[label]).sum(-1) < 0.0
    sides = 2 * len(normals) + 1
    side = np.where(label >= 0, 2 * label + facing + 1, 0)
    key, corner = np.unique(mesh.faces.astype(np.int64) * sides + side[:, None], return_inverse=True)
    vertex, side = key // sides, key % sides
    first = np.concatenate(([True], vertex[1:] != vertex[:-1]))
    number = np.where(first, vertex, len(mesh.vertices) - 1 + np.cumsum(~first))
    chosen = np.concatenate((np.arange(len(mesh.vertices)), vertex[~first]))
    made = mesh.of_vertices(chosen, number[corner.reshape(-1)].reshape(-1, 3).astype(mesh.faces.dtype))
    assert made.normals is not None
    of_side = np.stack((normals, -normals), 1).reshape(-1, 3).astype(made.normals.dtype)
    turned = made.normals.copy()
    turned[number[side > 0]] = of_side[side[side > 0] - 1]
    return replace(made, normals=turned)
