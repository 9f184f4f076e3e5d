"""The triangles of several meshes as arrays, and which of them lies nearest to a position."""

from collections.abc import Sequence

import numpy as np

from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.core.scene_records import Mesh

SAMPLES, NEAR = 1 << 18, 8
"""Points on the triangles by which positions find theirs, and how many of the nearest ones say which are looked at."""
ROUNDING = 1e-6
"""Difference of distances, over the size of what is around, below which the nearest point decides."""


def merged(meshes: Sequence[Mesh]) -> tuple[Float64Array, IntArray, IntArray]:
    """Vertices [v, 3] and triangles [f, 3] of all meshes, one mesh after the other, and the number of the first vertex
    of each [meshes + 1].
    """
    points = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in meshes)])
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    shifted = (mesh.faces + k for mesh, k in zip(meshes, first[:-1], strict=True))
    return points, np.concatenate([np.zeros((0, 3), np.int64), *shifted]), first


def normals_and_areas(p: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Unit normals [f, 3] (+Z where degenerate) and areas [f] of triangles [f, 3 corners, 3]."""
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.linalg.norm(cross, axis=-1)
    flat = length == 0
    normal = np.where(flat[:, None], np.array([0.0, 0.0, 1.0]), cross / np.where(flat, 1.0, length)[:, None])
    return normal, 0.5 * length


class NearestTriangles:
    """A tree of points spread evenly over triangles, one in each at least.

    Args:
        vertices: [v, 3].
        faces: the triangles' indices into them [f, 3].
        area: of each [f].
    """

    def __init__(self, vertices: FloatArray, faces: IntArray, area: FloatArray) -> None:
        from scipy.spatial import KDTree  # imported where it is needed: it loads slowly

        area = area.astype(np.float64)
        edges = np.cumsum(area) / max(float(area.sum()), 1e-300)
        spread = np.searchsorted(edges, (np.arange(SAMPLES) + 0.5) / SAMPLES).clip(0, len(area) - 1)
        self._vertices, self._faces, self._prim = vertices, faces, np.concatenate((np.arange(len(area)), spread))
        u, v = np.random.default_rng(0).random((2, len(self._prim)))
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        u[: len(area)] = v[: len(area)] = 1.0 / 3.0
        weight = np.stack((1.0 - u - v, u, v), -1)
        self._tree = KDTree((weight[..., None] * vertices[faces[self._prim]]).sum(1))

    def __call__(self, p: FloatArray) -> IntArray:
        """Triangle nearest to each position [n, 3] among those with the :data:`NEAR` nearest of all samples."""
        from trimesh.triangles import closest_point  # imported where it is needed: it loads slowly

        at = p.astype(np.float64)
        near = self._prim[np.asarray(self._tree.query(at, k=NEAR)[1]).clip(max=len(self._prim) - 1)]  # [n, NEAR]
        corners, repeated = self._vertices[self._faces[near]].reshape(-1, 3, 3), np.repeat(at, NEAR, 0)
        closest = closest_point(corners, repeated)  # type: ignore[no-untyped-call]
        away = np.linalg.norm(closest - repeated, axis=1).reshape(-1, NEAR)
        away[np.isnan(away)] = np.inf  # of triangles without area
        size = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
        touching = away <= away.min(1, keepdims=True) + ROUNDING * size
        found: IntArray = near[np.arange(len(near)), touching.argmax(1)]
        return found
