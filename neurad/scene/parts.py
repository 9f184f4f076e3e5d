"""Connected parts of surfaces."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import BoolArray, IntArray
from neurad.scene.connected import joined_places, linked, welded_corners
from neurad.scene.geometry import Geometry

CREASE = 30.0
"""Angle in degrees between triangles from which on an edge is a crease, as where Blender's smooth shading ends."""


def segments(geometry: Geometry, smallest: float) -> Tensor:
    """Which segment each triangle belongs to [f]: what is connected without a crease in one mesh, so that a box has six
    and a ball has one. Those of a connected part that are too small count as one.

    Args:
        smallest: area, in squared scene units, from which on a segment counts.
    """
    vertices, faces = geometry.vertices.cpu().numpy(), geometry.faces.cpu().numpy()
    mesh, area = geometry.mesh_index.cpu().numpy(), geometry.face_area.cpu().numpy().astype(np.float64)
    normal = geometry.face_normal.cpu().numpy()
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
    segment = linked(one[smooth], other[smooth], len(faces))
    small = np.bincount(segment, area)[segment] < smallest
    return torch.from_numpy(np.where(small, len(faces) + _pairs(geometry.connected, mesh), segment))


def _pairs(one: IntArray, other: IntArray) -> IntArray:
    """A number for each pair of numbers [n], none of which is below 0."""
    found: IntArray = np.unique(one * (int(other.max(initial=0)) + 1) + other, return_inverse=True)[1].reshape(-1)
    return found


class SurfaceParts:
    """The connected parts of a scene's surfaces, meshes joined where they have vertices at the same place.

    Args:
        kind: of each triangle [f]; parts of several kinds are several parts. None where all are of one.
        joined: triangles [f], bool, whose parts are one part, in each entry; entries that share a part are one.
    """

    def __init__(self, geometry: Geometry, kind: Tensor | None = None, joined: Sequence[BoolArray] = ()) -> None:
        self.geometry = geometry
        parts = geometry.connected if kind is None else _pairs(geometry.connected, kind.cpu().numpy())
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

    @cached_property
    def _mesh(self) -> Tensor:
        return self.geometry.mesh_index.cpu()[self.triangles]

    def mesh_of(self, part: Tensor) -> Tensor:
        """Mesh that the first triangle of each ``part`` [n] is of."""
        if self._mesh.device != part.device:
            self._mesh = self._mesh.to(part.device)
        return self._mesh[part]

    def of(self, prim: Tensor) -> Tensor:
        """Part of each triangle ``prim`` [n]; that of the first one for -1."""
        if self._of_triangle.device != prim.device:
            self._of_triangle = self._of_triangle.to(prim.device)
        return self._of_triangle[prim.clamp_min(0)]

    def at(self, p: Tensor, prim: Tensor | None = None) -> Tensor:
        """Part at each position [n, 3] on the triangles ``prim`` [n]; None for what lies nearest."""
        return self.of(self.geometry.nearest(p) if prim is None else prim)
