"""Solids of revolution, and solids with soft edges, as made things have: bevelled boxes, bent tubes, hanging cloth.

Texture coordinates are in metres.
"""

import math
from collections.abc import Sequence

import numpy as np

from neurad.core.records import Float64Array, IntArray
from neurad.scene.builtin.shapes import Point, Solid, join

SMOOTH = math.cos(math.radians(40.0))
"""Neighbouring bands of a solid of revolution have one normal where they meet at less than 40 degrees."""
BEVEL = 0.004
"""Radius of an edge in metres, unless one is given."""


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


def bevelled(low: Point, high: Point, radius: float = BEVEL, segments: int = 1) -> Solid:
    """An axis-aligned box whose edges and corners are rounded, with box-mapped texture coordinates in metres.

    Args:
        low: smallest corner.
        high: largest corner.
        radius: of the edges, at most half of the shortest side.
        segments: bands of a quarter round on either side of its middle.
    """
    corner, far = np.array(low, np.float64), np.array(high, np.float64)
    r = min(radius, 0.499 * float((far - corner).min()))
    return join(*(_side(corner, far, r, segments, axis, sign) for axis in range(3) for sign in (-1.0, 1.0)))


def _side(low: Float64Array, high: Float64Array, r: float, segments: int, axis: int, sign: float) -> Solid:
    """One side of a bevelled box with its halves of the rounded edges around it."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    tangent = np.tan(np.pi / 4 * np.arange(segments, -1, -1) / segments)

    def stops(k: int) -> tuple[Float64Array, Float64Array]:
        """Places along axis ``k`` before rounding, and how far the normal leans there, as a tangent."""
        lean = np.concatenate((-tangent, tangent[::-1]))
        inner = np.concatenate((np.full(segments + 1, low[k] + r), np.full(segments + 1, high[k] - r)))
        return inner, lean

    (at_a, lean_a), (at_b, lean_b) = stops(a), stops(b)
    count = len(at_a)
    normal = np.zeros((count, count, 3))
    normal[..., axis], normal[..., a], normal[..., b] = sign, lean_a[:, None], lean_b[None, :]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    centre = np.zeros((count, count, 3))
    centre[..., axis] = high[axis] - r if sign > 0 else low[axis] + r
    centre[..., a], centre[..., b] = at_a[:, None], at_b[None, :]
    vertices = (centre + r * normal).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(count - 1), np.arange(count - 1), indexing="ij"))
    at = i * count + j
    quads = np.stack((at, at + count, at + count + 1, at + 1), axis=1)
    faces = np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])).astype(np.int64)
    axes = [(2, 1), (0, 2), (0, 1)][axis]
    return Solid(vertices, faces if sign > 0 else faces[:, ::-1].copy(), vertices[:, list(axes)], normal.reshape(-1, 3))


def tube(path: Sequence[Point], radius: float | Sequence[float], sides: int = 10) -> Solid:
    """A round bar along a path, closed by flat ends; texture coordinates run around and along.

    Args:
        path: points of its middle line.
        radius: of the bar in metres, one for all points or one each.
        sides: of its cross-section.
    """
    points = np.array(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(points))
    step = np.diff(points, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    along = np.concatenate((step[:1], step[:-1] + step[1:], step[-1:]))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.eye(3)[int(np.argmin(np.abs(along[0])))]
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    angle[-1] = 0.0  # the seam closes exactly
    rings, normals, uvs, length = [], [], [], 0.0
    across = across - along[0] * float(across @ along[0])
    for k, (p, t) in enumerate(zip(points, along, strict=True)):
        across = _carried(across, along[max(k - 1, 0)], t)
        across /= np.linalg.norm(across)
        other = np.cross(t, across)
        outward = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other
        length += float(np.linalg.norm(p - points[max(k - 1, 0)]))
        rings.append(p + radii[k] * outward)
        normals.append(outward)
        around = 2 * np.pi * float(radii.max()) * np.arange(sides + 1) / sides
        uvs.append(np.stack((around, np.full(sides + 1, length)), axis=1))
    hull = _loft(rings, normals, uvs)
    return join(hull, _cap(rings[0][:-1], -along[0]), _cap(rings[-1][:-1], along[-1]))


def _carried(vector: Float64Array, before: Float64Array, after: Float64Array) -> Float64Array:
    """``vector`` turned as unit direction ``before`` turns into ``after``, which is not its opposite."""
    axis, cosine = np.cross(before, after), float(before @ after)
    carried: Float64Array = vector * cosine + np.cross(axis, vector) + axis * float(axis @ vector) / (1.0 + cosine)
    return carried


def _loft(rings: Sequence[Float64Array], normals: Sequence[Float64Array], uvs: Sequence[Float64Array]) -> Solid:
    """Bands between rings of equally many points; the outside is where the rings turn from one to the next."""
    count, per = len(rings), len(rings[0])
    i, j = (x.ravel() for x in np.meshgrid(np.arange(count - 1), np.arange(per - 1), indexing="ij"))
    at = i * per + j
    quads = np.stack((at, at + 1, at + per + 1, at + per), axis=1)
    faces = np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])).astype(np.int64)
    return Solid(np.concatenate(rings), faces, np.concatenate(uvs), np.concatenate(normals))


def _cap(ring: Float64Array, normal: Float64Array) -> Solid:
    """A flat lid over a ring, facing along ``normal``."""
    count = len(ring)
    fan = np.stack((np.zeros(count - 2), np.arange(1, count - 1), np.arange(2, count)), axis=1).astype(np.int64)
    facing = float(np.cross(ring[1] - ring[0], ring[2] - ring[0]) @ normal) > 0
    return Solid(ring, fan if facing else fan[:, ::-1].copy(), ring[:, [0, 1]], np.tile(normal, (count, 1)))


def draped(lines: Sequence[Sequence[Point]], thickness: float = 0.006) -> Solid:
    """A piece of cloth: a grid of points, thick on both sides and closed all around.

    Args:
        lines: points of the front [rows][columns]; the front is where ``columns x rows`` points.
        thickness: of the cloth in metres, behind the front.
    """
    front = np.array(lines, np.float64)
    rows, columns = front.shape[:2]
    down, right = np.gradient(front, axis=0), np.gradient(front, axis=1)
    normal = np.cross(right, down)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    wide = np.linalg.norm(np.diff(front, axis=1), axis=-1)
    u = np.concatenate((np.zeros((rows, 1)), np.cumsum(wide, axis=1)), axis=1).mean(0)
    tall = np.linalg.norm(np.diff(front, axis=0), axis=-1)
    v = np.concatenate((np.zeros((1, columns)), np.cumsum(tall, axis=0)), axis=0).mean(1)
    uv = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)
    back = front - thickness * normal
    parts = [_loft(list(front), list(normal), list(uv)), _loft(list(back[::-1]), list(-normal[::-1]), list(uv[::-1]))]
    edges = [
        (back[0], front[0], uv[0]), (front[-1], back[-1], uv[-1]),
        (front[:, 0], back[:, 0], uv[:, 0]), (back[:, -1], front[:, -1], uv[:, -1]),
    ]  # fmt: skip
    for one, other, at in edges:
        out = np.cross(np.gradient(one, axis=0), other - one)
        out /= np.linalg.norm(out, axis=-1, keepdims=True)
        parts.append(_loft([one, other], [out, out], [at, at]))
    return join(*parts)


def curtain(x: tuple[float, float], y: tuple[float, float], z: float, folds: int, depth: float) -> Solid:
    """A curtain across ``x`` that hangs in folds, from ``y[1]`` down to ``y[0]``, its front towards +z.

    Args:
        x: left and right side.
        y: lower hem and top.
        z: of its middle.
        folds: waves across.
        depth: of a wave at the hem; at the top they are two thirds as deep.
    """
    lines = []
    for k, height in enumerate(np.linspace(y[0], y[1], 7)):
        t = np.linspace(0.0, 1.0, 12 * folds + 1)
        sway = 0.12 * math.sin(1.7 * k)
        wave = np.sin(2 * np.pi * (folds * t + sway * t * (1 - t))) + 0.15 * np.sin(
            4 * np.pi * folds * t + 1.0 + 0.3 * k
        )
        swing = depth * (1.0 - k / 18.0)
        lines.append(
            [
                (float(x[0] + (x[1] - x[0]) * s), float(height), float(z + swing * w))
                for s, w in zip(t, wave, strict=True)
            ]
        )
    return draped(lines, 0.002)


def swapped(solid: Solid) -> Solid:
    """A copy of a solid with the two axes of its texture exchanged: grain that ran up runs across."""
    return Solid(solid.vertices, solid.faces, solid.uvs[:, ::-1].copy(), solid.normals)


def moved(solid: Solid, by: Point) -> Solid:
    """A copy of a solid, moved by a vector."""
    return Solid(solid.vertices + np.array(by), solid.faces, solid.uvs, solid.normals)


def tilted(solid: Solid, degrees: float, axis: int, centre: Point) -> Solid:
    """The solid turned about the x (0), y (1) or z (2) axis through ``centre``, by the right hand."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[a, a], turn[a, b], turn[b, a], turn[b, b] = c, -s, s, c
    at = np.array(centre)
    return Solid((solid.vertices - at) @ turn.T + at, solid.faces, solid.uvs, solid.normals @ turn.T)


def cup(centre: Point, foot: float, rim: float, height: float, wall: float, tile: float, segments: int = 28) -> Solid:
    """An open vessel standing on ``centre``: bowls, pots, plates and mugs differ in their four lengths."""
    middle = (0.45 * foot + 0.55 * rim, 0.45 * height)
    profile = [
        (0.0, 0.0),
        (foot, 0.0),
        middle,
        (rim, height),
        (rim - wall, height),
        (middle[0] - wall, middle[1] + 0.5 * wall),
        (max(foot - wall, 0.01), wall),
        (0.0, wall),
    ]
    return turned(profile, centre, tile, segments)


def jar(centre: Point, radius: float, height: float, tile: float) -> Solid:
    """A closed cylinder with a rounded shoulder and a knob, standing on ``centre``."""
    r, h = radius, height
    profile = [
        (0.0, 0.0),
        (0.9 * r, 0.0),
        (r, 0.06 * h),
        (r, 0.72 * h),
        (0.82 * r, 0.82 * h),
        (0.82 * r, 0.9 * h),
        (0.25 * r, 0.92 * h),
        (0.25 * r, h),
        (0.0, h),
    ]
    return turned(profile, centre, tile, 24)
