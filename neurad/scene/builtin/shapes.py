"""Solids with texture coordinates in metres, and cameras that look at a point."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurad.core.camera import facing
from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.core.scene_records import Camera, Mesh

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Solid:
    """Triangles wound so that their normals point outwards."""

    vertices: Float64Array
    """[v, 3]."""
    faces: IntArray
    """[f, 3]."""
    uvs: Float64Array
    """Texture coordinates in metres [v, 2]."""
    normals: Float64Array
    """Unit normals [v, 3]."""

    def mesh(
        self,
        name: str,
        material: int,
        tile: float = 1.0,
        smooth_shading: bool = True,
        radiance: FloatArray | None = None,
    ) -> Mesh:
        """This solid as a mesh whose texture repeats every ``tile`` metres; ``smooth`` keeps the vertex normals.

        Coordinates are rounded to a micrometre first: sines differ in their last digit between processors.
        """
        normals = self.normals / np.linalg.norm(self.normals, axis=1, keepdims=True)
        return Mesh(
            name=name,
            vertices=_rounded(self.vertices),
            faces=self.faces,
            material=material,
            normals=_rounded(normals) if smooth_shading else None,
            uvs=_rounded(self.uvs / tile),
            radiance=radiance,
        )


def _rounded(values: Float64Array) -> FloatArray:
    """To six decimals; what is nearly zero has no sign then, which would be that of the error."""
    return (np.round(values, 6) + 0.0).astype(np.float32)


def join(*solids: Solid) -> Solid:
    """All solids as one."""
    start = np.cumsum([0, *(len(s.vertices) for s in solids)])
    return Solid(
        vertices=np.concatenate([s.vertices for s in solids]),
        faces=np.concatenate([s.faces + start[i] for i, s in enumerate(solids)]),
        uvs=np.concatenate([s.uvs for s in solids]),
        normals=np.concatenate([s.normals for s in solids]),
    )


def quad(origin: Point, edge_u: Point, edge_v: Point) -> Solid:
    """A parallelogram that faces along ``edge_u x edge_v``; uv are the world coordinates across its main axis."""
    o, a, b = np.array(origin), np.array(edge_u), np.array(edge_v)
    vertices = np.stack((o, o + a, o + a + b, o + b))
    normal = np.cross(a, b)
    axes = [(2, 1), (0, 2), (0, 1)][int(np.argmax(np.abs(normal)))]
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int64)
    unit = normal / np.linalg.norm(normal)
    return Solid(vertices, faces, vertices[:, list(axes)], np.tile(unit, (4, 1)))


def box(low: Point, high: Point) -> Solid:
    """An axis-aligned box with box-mapped texture coordinates."""
    (x, y, z), (w, h, d) = low, np.subtract(high, low).tolist()
    return join(
        quad((x, y, z), (0, 0, d), (0, h, 0)),
        quad((x + w, y, z), (0, h, 0), (0, 0, d)),
        quad((x, y, z), (w, 0, 0), (0, 0, d)),
        quad((x, y + h, z), (0, 0, d), (w, 0, 0)),
        quad((x, y, z), (0, h, 0), (w, 0, 0)),
        quad((x, y, z + d), (w, 0, 0), (0, h, 0)),
    )


def rotated(solid: Solid, degrees: float, centre: Point) -> Solid:
    """``solid`` turned about the vertical axis through ``centre``."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    at = np.array(centre)
    return Solid((solid.vertices - at) @ turn.T + at, solid.faces, solid.uvs, solid.normals @ turn.T)


def look_at(eye: Point, target: Point, fov: float, size: int) -> Camera:
    """A square camera at ``eye`` that looks at ``target`` with +Y up; ``fov`` in degrees."""
    pose: Any = facing(eye, np.subtract(eye, target), (0.0, 1.0, 0.0))
    return Camera(to_world=pose, fov_x=math.radians(fov), width=size, height=size)
