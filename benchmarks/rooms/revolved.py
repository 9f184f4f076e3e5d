"""Solids of revolution about the vertical axis, with texture coordinates in metres."""

import math
from collections.abc import Sequence

import numpy as np

from neurad.core.records import Float64Array, IntArray
from neurad.scene.builtin.shapes import Point, Solid, join

SMOOTH = math.cos(math.radians(40.0))
"""Neighbouring bands of a solid of revolution have one normal where they meet at less than 40 degrees."""


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
