"""Solids with texture coordinates in metres, and cameras that look at a point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurad.core.camera import facing
from neurad.core.records import Camera, Float64Array, FloatArray, IntArray, Mesh

Point = tuple[float, float, float]

SMOOTH = math.cos(math.radians(40.0))
"""Neighbouring bands of a solid of revolution have one normal where they meet at less than 40 degrees."""


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


def turned(profile: Sequence[tuple[float, float]], centre: Point, tile: float, segments: int = 28) -> Solid:
    """A solid of revolution about the vertical axis through ``centre``.

    Args:
        profile: (radius, height) from the bottom's centre along the outside; going up, the outside lies to the right.
        centre: what radius 0 and height 0 stand for.
        tile: length after which the texture repeats, so that its seam closes.
        segments: bands around.
    """
    points = np.array(profile, np.float64)
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    normal = np.stack((step[:, 1], -step[:, 0]), axis=1) / length[:, None]
    along = np.concatenate(([0.0], np.cumsum(length)))
    angle = 2 * np.pi * np.arange(segments + 1) / segments
    angle[-1] = 0.0  # the seam closes exactly
    around = max(1, round(2 * np.pi * points[:, 0].max() / tile)) * tile * np.arange(segments + 1) / segments
    bands = []
    for i in range(len(step)):
        ends = [_end_normal(points, normal, i, i - 1), _end_normal(points, normal, i, i + 1)]
        vertices, normals, uvs = [], [], []
        for k in (0, 1):
            r, y = points[i + k]
            vertices.append(np.stack((r * np.cos(angle), np.full_like(angle, y), -r * np.sin(angle)), axis=1))
            n = ends[k]
            normals.append(np.stack((n[0] * np.cos(angle), np.full_like(angle, n[1]), -n[0] * np.sin(angle)), axis=1))
            uvs.append(np.stack((around, np.full_like(angle, along[i + k])), axis=1))
        bands.append(
            Solid(
                np.concatenate(vertices) + np.array(centre),
                _band(segments, bool(points[i, 0] > 0), bool(points[i + 1, 0] > 0)),
                np.concatenate(uvs),
                np.concatenate(normals),
            )
        )
    return join(*bands)


def _band(segments: int, lower: bool, upper: bool) -> IntArray:
    """Triangles between two rings; a ring that is a point (False) gives one triangle a segment."""
    j = np.arange(segments, dtype=np.int64)
    top = j + segments + 1
    parts = []
    if lower:
        parts.append(np.stack((j, j + 1, top + 1 if upper else top), axis=1))
    if upper:
        parts.append(np.stack((j, top + 1, top), axis=1))
    return np.concatenate(parts)


def _end_normal(points: Float64Array, normal: Float64Array, band: int, other: int) -> Float64Array:
    """Normal of a band at the end where it meets band ``other``: shared with it where the bend is slight."""
    radius = points[max(band, other), 0]
    own = np.asarray(normal[band])
    if radius == 0.0:
        return np.array([0.0, math.copysign(1.0, own[1])]) if abs(own[1]) > SMOOTH else own
    if 0 <= other < len(normal) and float(own @ normal[other]) > SMOOTH:
        mean: Float64Array = own + normal[other]
        return np.asarray(mean / np.linalg.norm(mean))
    return own


def ball(centre: Point, radius: float, tile: float, rings: int = 12, segments: int = 24) -> Solid:
    """A sphere."""
    angle = np.pi * np.arange(rings + 1) / rings
    profile = [(radius * math.sin(a), -radius * math.cos(a)) for a in angle]
    profile[0], profile[-1] = (0.0, -radius), (0.0, radius)
    return turned(profile, centre, tile, segments)


def look_at(eye: Point, target: Point, fov: float, size: int) -> Camera:
    """A square camera at ``eye`` that looks at ``target`` with +Y up; ``fov`` in degrees."""
    pose: Any = facing(eye, np.subtract(eye, target), (0.0, 1.0, 0.0))
    return Camera(to_world=pose, fov_x=math.radians(fov), width=size, height=size)
