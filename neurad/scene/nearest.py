"""The triangle that lies nearest to a position."""

import numpy as np
from scipy.spatial import KDTree

from neurad.core.records import FloatArray, IntArray

SAMPLES, NEAR = 1 << 18, 8
"""Points on the triangles by which positions find theirs, and how many of the nearest ones say which are looked at."""
ROUNDING = 1e-6
"""Difference of distances, over the size of what is around, below which the nearest point decides."""


class NearestTriangles:
    """A tree of points spread evenly over triangles, one in each at least.

    Args:
        vertices: [v, 3].
        faces: the triangles' indices into them [f, 3].
        area: of each [f].
    """

    def __init__(self, vertices: FloatArray, faces: IntArray, area: FloatArray) -> None:
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
