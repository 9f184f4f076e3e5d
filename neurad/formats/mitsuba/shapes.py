"""Mitsuba's spheres, disks and cylinders as triangles, with their exact normals at the vertices."""

import math
from typing import NamedTuple

import numpy as np

from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.scene.triangles import normals_and_areas

CURVED = ("sphere", "disk", "cylinder")
SEGMENTS = 128
"""Sides of a full circle."""
_RINGS = 8  # of a disk
ERROR = {
    "sphere": 1.0 - math.cos(math.sqrt(2.0) * math.pi / SEGMENTS),
    "disk": 1.0 - math.cos(math.pi / SEGMENTS),
    "cylinder": 1.0 - math.cos(math.pi / SEGMENTS),
}
"""Largest distance of the triangles from the true surface, in radii."""
_ROUND = 1e-3  # largest relative deviation of axes from orthogonal ones of one length


class Triangles(NamedTuple):
    """A mesh in world space."""

    vertices: FloatArray
    """[v, 3]."""
    faces: IntArray
    """[f, 3], wound like the normals."""
    normals: FloatArray
    """[v, 3], unit."""
    uvs: FloatArray
    """[v, 2], as Mitsuba has them."""


def is_round(plugin: str, to_world: Float64Array) -> bool:
    """Whether the transform [4, 4] of the unit shape leaves it what it is: a sphere in all directions, a cylinder
    around its axis; a disk may become an ellipse.
    """
    if plugin == "disk":
        return True
    axes = to_world[:3, :3] if plugin == "sphere" else to_world[:3, :2]
    length = float(np.linalg.norm(axes, axis=0).mean())
    product = axes.T @ axes / max(length**2, 1e-300)
    if plugin == "cylinder":  # its axis has any length, but stands upright
        along = to_world[:3, 2] / max(float(np.linalg.norm(to_world[:3, 2])), 1e-300)
        if np.abs(axes.T @ along).max() > _ROUND * length:
            return False
    return bool(np.abs(product - np.eye(len(product))).max() <= _ROUND)


def triangulated(plugin: str, to_world: Float64Array) -> Triangles:
    """A shape, its normals outwards, along +Z of a disk.

    Args:
        plugin: one of :data:`CURVED`.
        to_world: where Mitsuba has the unit shape: a sphere or disk of radius 1 around the origin, a cylinder of
            radius 1 from z = 0 to 1 [4, 4].
    """
    turns = np.arange(SEGMENTS + 1) / SEGMENTS
    phi = 2.0 * math.pi * turns
    circle = np.stack((np.cos(phi), np.sin(phi)), -1)  # [s, 2]
    circle[-1] = circle[0]
    if plugin == "sphere":
        down = np.arange(SEGMENTS // 2 + 1) / (SEGMENTS // 2)
        theta = math.pi * down
        sin = np.sin(theta)
        sin[-1] = 0.0
        height = np.broadcast_to(np.cos(theta)[:, None, None], (len(down), len(turns), 1))
        points = np.concatenate((sin[:, None, None] * circle, height), -1)
        normals, uv = points, (turns[None, :], down[:, None])
    elif plugin == "disk":
        radius = np.arange(_RINGS + 1) / _RINGS
        points = np.concatenate((radius[:, None, None] * circle, np.zeros((len(radius), len(turns), 1))), -1)
        normals, uv = np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape), (radius[:, None], turns[None, :])
    else:
        ends = np.array([1.0, 0.0])  # from the upper end, so that rows run as a sphere's do
        around = np.broadcast_to(circle, (2, *circle.shape))
        points = np.concatenate((around, np.broadcast_to(ends[:, None, None], (2, len(turns), 1))), -1)
        normals = np.concatenate((around, np.zeros((2, len(turns), 1))), -1)
        uv = turns[None, :], ends[:, None]
    uvs = np.stack(np.broadcast_arrays(*uv), -1).reshape(-1, 2)
    rows, columns = points.shape[:2]
    points, normals = points.reshape(-1, 3), np.asarray(normals, np.float64).reshape(-1, 3)
    turned = np.linalg.inv(to_world[:3, :3])
    normals = normals @ turned
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    vertices = points @ to_world[:3, :3].T + to_world[:3, 3]
    faces = _grid(rows, columns)
    faces = faces[normals_and_areas(points[faces])[1] > 0.5e-12]  # none at poles, nor at the middle of a disk
    if np.linalg.det(to_world[:3, :3]) < 0:
        faces = faces[:, [0, 2, 1]]
    return Triangles(vertices.astype(np.float32), faces, normals.astype(np.float32), uvs.astype(np.float32))


def _grid(rows: int, columns: int) -> IntArray:
    """Triangles between the points of a grid: its rows from top to bottom, its columns from left to right, as seen from
    the side to which normals point.
    """
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).reshape(-1)
    b, c, d = a + columns, a + columns + 1, a + 1
    return np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1))).astype(np.int64)
