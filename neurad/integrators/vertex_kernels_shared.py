"""What the kernels of a vertex share: the records of arrays that they read and fill, and the steps that are compiled
into each of them.

All arithmetic is float32, in the order of the reference's formulas: the offsets of spawned rays are bounds on its
rounding. A record costs about 2 microseconds a call more than its arrays one by one, 0.1 % of a training step.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from neurad.core.records import BoolArray, FloatArray, IntArray, SurfaceInteraction
from neurad.emitters.area import AreaLights
from neurad.integrators.world import World
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.jit import inlined
from neurad.scene.geometry import EPS, SHADOW_MARGIN

ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
INV_PI = np.float32(1.0 / math.pi)
TINY = np.finfo(np.float32).tiny
_EPS, _SHORT = np.float32(EPS), np.float32(1.0 - SHADOW_MARGIN)


# ------------------------------------------------------------------ records


class Vertices(NamedTuple):
    """Surface points [m, ...], those that rays leave or those where they end."""

    p: FloatArray
    """[m, 3]."""
    ng: FloatArray
    """[m, 3]."""
    n: FloatArray
    """[m, 3]."""
    wo: FloatArray
    """[m, 3]."""
    prim: IntArray
    """[m]."""
    valid: BoolArray
    """[m]."""

    @classmethod
    def of(cls, si: SurfaceInteraction) -> Vertices:
        """The arrays of a surface interaction, without copies where they lie in a row."""
        return cls(*(x.contiguous().numpy() for x in (si.p, si.ng, si.n, si.wo, si.prim, si.valid)))


class Triangles(NamedTuple):
    """Emitting triangles: the tables of :class:`neurad.emitters.area.AreaLights`."""

    cdf: FloatArray
    """Inner steps of the distribution over k emitting triangles [k - 1]."""
    table: FloatArray
    """Corner, two edges and normal of each [k, 12]."""
    face: IntArray
    """Their triangles [k]."""
    pdf_area: FloatArray
    """Density by area of every triangle of the scene [F]."""
    emission: FloatArray
    """Radiance of every triangle of the scene [F, 3]."""

    @classmethod
    def of(cls, lights: AreaLights) -> Triangles:
        """The arrays of area lights."""
        given = lights.cdf, lights.table, lights.face, lights.pdf_area, lights.emission
        return cls(*(x.numpy() for x in given))


class ShadowRays(NamedTuple):
    """Rays from vertices to lights, of those vertices that a light could reach."""

    lane: IntArray
    """Their vertices, ascending [k]."""
    o: FloatArray
    """[k, 3]."""
    d: FloatArray
    """[k, 3]."""
    t_max: FloatArray
    """Distance below which a hit means shadow [k]."""
    radiance: FloatArray
    """Emitted radiance times MIS weight over pdf: what an unoccluded ray carries for a BSDF of 1 [k, 3]."""


# ------------------------------------------------------------------ steps


@inlined
def dot(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any) -> Any:  # pragma: no cover - compiled
    """Inner product of two vectors."""
    return ax * bx + ay * by + az * bz


@inlined
def ray_offset(px: Any, py: Any, pz: Any, across: Any, radius: Any) -> Any:  # pragma: no cover - compiled
    """How far off the surface a ray starts; ``across`` bounds the error across the triangle's plane."""
    return across + _EPS * max(max(max(abs(px), abs(py)), abs(pz)), radius / np.float32(1024.0))


@inlined
def pick_triangle(cdf: FloatArray, u: Any) -> Any:  # pragma: no cover - compiled
    """Row of the emitting triangle that the uniform number ``u`` picks: how many steps of ``cdf`` are at most ``u``."""
    low, high = 0, cdf.shape[0]
    while low < high:
        middle = (low + high) // 2
        if cdf[middle] <= u:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def sample_triangle(px: Any, py: Any, pz: Any, row: FloatArray, area: Any, u0: Any, u1: Any) -> tuple[Any, ...]:
    """Direction and distance of a uniform point of an emitting triangle, seen from ``p``, and its density by solid
    angle, 0 where no light comes from.
    """
    root = np.float32(math.sqrt(ONE - u0))  # pragma: no cover - compiled
    b0, b1 = ONE - root, root * u1
    x = row[0] + b0 * row[3] + b1 * row[6] - px
    y = row[1] + b0 * row[4] + b1 * row[7] - py
    z = row[2] + b0 * row[5] + b1 * row[8] - pz
    squared = dot(x, y, z, x, y, z)
    distance = np.float32(math.sqrt(squared))
    length = max(distance, TINY)
    x, y, z = x / length, y / length, z / length
    cos = -dot(row[9], row[10], row[11], x, y, z)
    pdf = area * squared / cos if cos > ZERO and squared > ZERO else ZERO
    return x, y, z, distance, pdf


@inlined
def spawn_shadow_ray(
    p: FloatArray, ng: FloatArray, wx: Any, wy: Any, wz: Any, distance: Any, offset: Any, o: FloatArray, d: FloatArray
) -> Any:  # pragma: no cover - compiled
    """Fill ``o, d`` [3] with a ray from ``p``, moved off its surface, to the point ``distance`` along ``w``; returns
    the distance below which a hit means shadow.
    """
    side = math.copysign(offset, dot(wx, wy, wz, ng[0], ng[1], ng[2]))
    for k in range(3):
        o[k] = p[k] + side * ng[k]
    x, y, z = p[0] - o[0] + wx * distance, p[1] - o[1] + wy * distance, p[2] - o[2] + wz * distance
    reach = np.float32(math.sqrt(dot(x, y, z, x, y, z)))
    inverse = max(reach, TINY)
    d[0], d[1], d[2] = x / inverse, y / inverse, z / inverse
    return max(reach * _SHORT - TWO * offset, ZERO)


@inlined
def tangents(x: Any, y: Any, z: Any) -> tuple[Any, ...]:  # pragma: no cover - compiled
    """Tangents of the frame around a normal, as ``Frame.around`` has them."""
    sign = ONE if z >= ZERO else -ONE
    a = -ONE / (sign + z)
    b = x * y * a
    return ONE + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@inlined
def emitter_pdf(
    f: Any, ng: FloatArray, wo: FloatArray, end: FloatArray, p: FloatArray, pdf_area: FloatArray, emission: FloatArray
) -> Any:
    """Density by solid angle with which emitter sampling at ``p`` finds the ``end`` of a ray on triangle ``f``;
    negative where it is dark.
    """
    cos = dot(ng[0], ng[1], ng[2], wo[0], wo[1], wo[2])  # pragma: no cover - compiled
    found = -ONE
    if cos > ZERO and (emission[f, 0] != ZERO or emission[f, 1] != ZERO or emission[f, 2] != ZERO):
        x, y, z = end[0] - p[0], end[1] - p[1], end[2] - p[2]
        found = pdf_area[f] * dot(x, y, z, x, y, z) / cos
    return found


@inlined
def spawn_ray(
    p: FloatArray, ng: FloatArray, x: Any, y: Any, z: Any, c0: Any, c1: Any, c2: Any, offset: Any, o: FloatArray,
    d: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill ``o, d`` [3] with a ray from ``p``, moved off its surface, along ``c`` in the frame around (x, y, z)."""
    s0, s1, s2, t0, t1, t2 = tangents(x, y, z)
    d[0], d[1], d[2] = c0 * s0 + c1 * t0 + c2 * x, c0 * s1 + c1 * t1 + c2 * y, c0 * s2 + c1 * t2 + c2 * z
    side = math.copysign(offset, dot(d[0], d[1], d[2], ng[0], ng[1], ng[2]))
    for k in range(3):
        o[k] = p[k] + side * ng[k]


# ------------------------------------------------------------------ dispatch


def reads(enabled: bool, world: World, si: SurfaceInteraction) -> bool:
    """Whether kernels can make bounces at ``si``, as far as lights and vertices go: area lights alone, none of them
    turned, and plain vertices (what carries more has to hand it on).
    """
    lights = world.lights
    return (
        enabled
        and type(si) is SurfaceInteraction
        and isinstance(lights, AreaLights)
        and lights.turned is None
        and use_kernel(True, si.p, lights.emission)
    )
