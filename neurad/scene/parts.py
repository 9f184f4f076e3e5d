"""Connected parts of surfaces."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import BoolArray, FloatArray, IntArray
from neurad.scene.geometry import Geometry

SAMPLES, NEAR = 1 << 18, 8
"""Points on the triangles by which positions find theirs, and how many of the nearest ones say which are looked at."""
ROUNDING = 1e-6
"""Difference of distances, over the size of what is around, below which the nearest point decides."""
CREASE = 30.0
"""Angle in degrees between triangles from which on an edge is a crease, as where Blender's smooth shading ends."""


def connected_parts(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Which connected part each triangle belongs to [f], counted from 0 as they come. Vertices at the same place are
    the same, since files split them where normals or texture coordinates jump.

    Args:
        vertices: [v, 3].
        faces: indices into them [f, 3].
    """
    corner = welded_corners(vertices, faces)
    label = joined_places(corner)
    _, first, number = np.unique(label[corner[:, 0]], return_index=True, return_inverse=True)
    order: IntArray = np.argsort(np.argsort(first))[number.reshape(-1)]
    return order


def welded_corners(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Numbers of the places where the corners of triangles lie [f, 3]; as of :func:`connected_parts`."""
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    corner: IntArray = same.reshape(-1)[faces]
    return corner


def joined_places(corner: IntArray) -> IntArray:
    """For each place the connected part that it is of, by the numbers of the triangles' corners [f, 3]."""
    from scipy.sparse import coo_matrix  # imported where it is needed: it loads slowly
    from scipy.sparse.csgraph import connected_components

    begin, end = np.concatenate((corner[:, :2], corner[:, 1:])).T
    places = int(corner.max(initial=-1)) + 1
    links = coo_matrix((np.ones(len(begin), np.int8), (begin, end)), (places, places))
    label: IntArray = connected_components(links, directed=False)[1]
    return label


def segments(geometry: Geometry, smallest: float) -> Tensor:
    """Which segment each triangle belongs to [f]: what is connected without a crease in one mesh, so that a box has six
    and a ball has one. Those of a connected part that are too small count as one.

    Args:
        geometry: of the scene.
        smallest: area, in squared scene units, from which on a segment counts.
    """
    from scipy.sparse import coo_matrix  # imported where it is needed: it loads slowly
    from scipy.sparse.csgraph import connected_components

    vertices, faces = geometry.vertices.cpu().numpy(), geometry.faces.cpu().numpy()
    mesh, area = geometry.mesh_index.cpu().numpy(), geometry.face_area.cpu().numpy().astype(np.float64)
    a, b, c = vertices[faces].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a) / np.maximum(2.0 * area, 1e-300)[:, None]
    # ---------------------- Neighbours across each edge, in the order of its triangles ----------------------

    corner = welded_corners(vertices, faces)
    edge = np.sort(np.concatenate((corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]])), 1)
    number = edge[:, 0] * (int(corner.max(initial=-1)) + 1) + edge[:, 1]
    order = np.argsort(number, kind="stable")
    shared = np.flatnonzero(number[order[1:]] == number[order[:-1]])
    one, other = order[shared] % len(faces), order[shared + 1] % len(faces)
    # Files differ in which way they wind the triangles of one surface.
    smooth = np.abs((normal[one] * normal[other]).sum(-1)) > np.cos(np.radians(CREASE))
    smooth &= mesh[one] == mesh[other]
    links = coo_matrix((np.ones(int(smooth.sum()), np.int8), (one[smooth], other[smooth])), (len(faces), len(faces)))
    segment: IntArray = connected_components(links, directed=False)[1].astype(np.int64)
    small = np.bincount(segment, area)[segment] < smallest
    whole = np.unique(np.stack((connected_parts(vertices, faces), mesh), -1), axis=0, return_inverse=True)[1]
    return torch.from_numpy(np.where(small, len(faces) + whole.reshape(-1), segment))


class SurfaceParts:
    """The connected parts of a scene's surfaces, meshes joined where they have vertices at the same place.

    Args:
        geometry: of the scene.
        kind: of each triangle [f]; parts of several kinds are several parts. None where all are of one.
        joined: triangles [f], bool, whose parts are one part, in each entry; entries that share a part are one.
    """

    def __init__(self, geometry: Geometry, kind: Tensor | None = None, joined: Sequence[BoolArray] = ()) -> None:
        self._geometry = geometry
        parts = connected_parts(geometry.vertices.cpu().numpy(), geometry.faces.cpu().numpy())
        if kind is not None:
            pairs = np.stack((parts, kind.cpu().numpy()), -1)
            parts = np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)
        if joined:
            rows = [np.unique(parts[inside]) for inside in joined]
            links = np.concatenate([np.stack((row, np.full(len(row), row[0]), row), -1) for row in rows])
            every = np.arange(int(parts.max()) + 1)
            label = joined_places(np.concatenate((links, np.stack((every, every, every), -1))))
            parts = np.unique(label[parts], return_inverse=True)[1].reshape(-1)
        self.count = int(parts.max(initial=-1)) + 1
        self._of_triangle = torch.from_numpy(parts)

    @cached_property
    def triangles(self) -> Tensor:
        """A triangle of each part [parts]."""
        return torch.from_numpy(np.unique(self._of_triangle.cpu().numpy(), return_index=True)[1])

    def of(self, prim: Tensor) -> Tensor:
        """Part of each triangle ``prim`` [n]; that of the first one for -1."""
        if self._of_triangle.device != prim.device:
            self._of_triangle = self._of_triangle.to(prim.device)
        return self._of_triangle[prim.clamp_min(0)]

    def at(self, p: Tensor) -> Tensor:
        """Part that lies nearest to each position [n, 3], see :meth:`nearest`."""
        return self.of(self.nearest(p))

    def nearest(self, p: Tensor) -> Tensor:
        """Triangle nearest to each position [n, 3] among those with the :data:`NEAR` nearest of all samples."""
        from trimesh.triangles import closest_point  # imported where it is needed: it loads slowly

        points, prim = self._samples
        at = p.detach().cpu().numpy().astype(np.float64)
        near = prim.numpy()[np.asarray(points.query(at, k=NEAR)[1]).clip(max=len(prim) - 1)]  # [n, NEAR]
        corners = self._geometry.vertices.cpu().numpy()[self._geometry.faces.cpu().numpy()[near]]
        repeated = np.repeat(at, NEAR, 0)
        closest = closest_point(corners.reshape(-1, 3, 3), repeated)  # type: ignore[no-untyped-call]
        away = np.linalg.norm(closest - repeated, axis=1).reshape(-1, NEAR)
        away[np.isnan(away)] = np.inf  # of triangles without area
        touching = away <= away.min(1, keepdims=True) + ROUNDING * np.linalg.norm(
            np.ptp(corners.reshape(-1, 3), axis=0)
        )
        found = near[np.arange(len(near)), touching.argmax(1)]
        return torch.from_numpy(found).to(p.device)

    @cached_property
    def _samples(self) -> tuple[Any, Tensor]:
        """A tree of points spread evenly over the triangles, one in each at least, and the triangle of each point."""
        from scipy.spatial import KDTree

        area = self._geometry.face_area.cpu().numpy().astype(np.float64)
        edges = np.cumsum(area) / max(float(area.sum()), 1e-300)
        spread = np.searchsorted(edges, (np.arange(SAMPLES) + 0.5) / SAMPLES).clip(0, len(area) - 1)
        prim = np.concatenate((np.arange(len(area)), spread))
        u, v = np.random.default_rng(0).random((2, len(prim)))
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        u[: len(area)] = v[: len(area)] = 1.0 / 3.0
        corners = self._geometry.vertices.cpu().numpy()[self._geometry.faces.cpu().numpy()[prim]]  # [n, 3, 3]
        weight = np.stack((1.0 - u - v, u, v), -1)
        return KDTree((weight[..., None] * corners).sum(1)), torch.from_numpy(prim)
