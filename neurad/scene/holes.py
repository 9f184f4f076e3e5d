"""Holes in the meshes of scans, closed where they are small: what photographs show there has no surface."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.core.scene_records import Mesh
from neurad.scene.connected import welded_corners
from neurad.scene.polygons import triangulate_polygons
from neurad.scene.triangles import merged, normals_and_areas

FLUSH = 0.5
"""Least cosine between what would close a rim and the surface along it: 1 in a wall, 0.58 in a corner of a room, 0 at
the mouth of a cup, -1 around a sheet, which ends there."""


@dataclass(frozen=True)
class Closed:
    """Meshes without small holes."""

    meshes: list[Mesh]
    count: int
    """Holes that were closed."""
    area: float
    """Area of the triangles that close them."""
    open: FloatArray
    """Widths of the holes that stay open, ascending."""


def close_holes(meshes: Sequence[Mesh], width: float) -> Closed:
    """Close the holes that are at most so wide; wider ones may be windows and doors.

    A hole is a rim of edges of one triangle each, meshes joined where they have vertices at the same place, on which a
    polygon lies flush with the surface around: see :data:`FLUSH`. It gets the normals of the rim.

    Args:
        width: largest distance between two vertices of a rim.
    """
    from scipy.spatial import cKDTree  # imported where it is needed: it loads slowly

    points, faces, first = merged(meshes)
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    corner = welded_corners(points, faces)
    a, b = corner.ravel(), np.roll(corner, -1, 1).ravel()
    edge = np.minimum(a, b) * (int(corner.max(initial=0)) + 1) + np.maximum(a, b)
    _, place, times = np.unique(edge, return_inverse=True, return_counts=True)
    rim = np.flatnonzero((times[place.reshape(-1)] == 1) & (a != b))
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    parts: list[list[tuple[IntArray, IntArray]]] = [[] for _ in meshes]
    count, area, wide = 0, 0.0, list[float]()
    vertex = faces.ravel()
    for loop in _loops(rim, a, b):
        p, of = points[vertex[loop]], owner[loop // 3]
        if not _flush(p, across[loop // 3]):
            continue
        far = p[np.linalg.norm(p - p[0], axis=-1).argmax()]
        span = float(np.linalg.norm(p - far, axis=-1).max())  # at least so much
        if span <= width:
            span = max(float(np.linalg.norm(p - q, axis=-1).max()) for q in p)
        if span > width:
            wide.append(span)
            continue
        loop, p, of = loop[::-1], p[::-1], of[::-1]  # what closes it turns the other way
        triangles, crossing = triangulate_polygons(p, [len(p)])
        if len(crossing) or len(triangles) == 0:
            continue
        most = int(np.bincount(of).argmax())
        own = vertex[loop[of == most]]
        near = own[cKDTree(points[own]).query(p)[1]]
        parts[most].append((triangles, np.stack((vertex[loop], near - first[most]))))
        count, area = count + 1, area + float(normals_and_areas(p[triangles])[1].sum())
    made = [_with(mesh, part, points) if part else mesh for mesh, part in zip(meshes, parts, strict=True)]
    return Closed(made, count, area, np.sort(np.array(wide, np.float32)))


def _loops(rim: IntArray, a: IntArray, b: IntArray) -> Iterator[IntArray]:
    """Closed ways along edges ``rim`` from the places ``a`` to ``b``, none through a place twice."""
    begin, end = (dict(zip(rim.tolist(), place[rim].tolist(), strict=True)) for place in (a, b))
    after: dict[int, list[int]] = {}
    for edge, at in begin.items():
        after.setdefault(at, []).append(edge)
    for start in list(after):
        way, step, at = list[int](), {start: 0}, start
        while edges := after.get(at):
            way.append(edges.pop())
            at = end[way[-1]]
            if at in step:
                loop, way = way[step[at] :], way[: step[at]]
                for edge in loop[1:]:
                    del step[begin[edge]]
                if len(loop) > 2:
                    yield np.array(loop)
            else:
                step[at] = len(way)


def _flush(p: Float64Array, normals: Float64Array) -> bool:
    """Whether what closes the rim ``p`` [n, 3] goes on as the triangles along it with these normals [n, 3]."""
    after = np.roll(p, -1, 0)
    middle = p.mean(0)
    newell = -np.cross(p - middle, after - middle).sum(0)
    length = np.linalg.norm(after - p, axis=-1)
    return float(newell @ (length @ normals)) > FLUSH * float(np.linalg.norm(newell) * length.sum())


def _with(mesh: Mesh, parts: list[tuple[IntArray, IntArray]], points: Float64Array) -> Mesh:
    """A mesh with further triangles: of each part the corners [f, 3], and of these the places and the vertices of the
    mesh whose normals and texture coordinates they take [2, n].
    """
    count, sizes = len(mesh.vertices), [rim.shape[1] for _, rim in parts]
    begin = count + np.cumsum([0, *sizes[:-1]])
    places, like = np.concatenate([rim for _, rim in parts], 1)
    more = [triangles + k for (triangles, _), k in zip(parts, begin, strict=True)]
    made = mesh.of_vertices(np.concatenate((np.arange(count), like)), np.concatenate((mesh.faces, *more)))
    made.vertices[count:] = points[places]
    return made
