"""The triangles of several meshes as arrays."""

from collections.abc import Sequence

import numpy as np

from neurad.core.records import Float64Array, IntArray
from neurad.core.scene_records import Mesh


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
