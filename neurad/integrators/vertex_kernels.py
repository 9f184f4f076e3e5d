"""Compiled parts of a bounce under area lights: all of it at Lambertian surfaces, and what is not the BSDF's own at
principled ones; see :mod:`neurad.integrators.vertex_diffuse` and :mod:`neurad.integrators.vertex_principled`.

All arithmetic is float32, in the order of the plain formulas: the offsets of spawned rays are bounds on its rounding.
What they share is compiled into each of them, so they stay in one file: numba's cache looks at the file of the caller
alone. Compiled at first use and cached on disk; the kernels release the interpreter lock and run on the calling thread.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neurad.core.records import FloatArray, IntArray
from neurad.runtime.jit import inlined, kernel
from neurad.scene.geometry import EPS, SHADOW_MARGIN

_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_INV_PI = np.float32(1.0 / math.pi)
_QUARTER_PI, _HALF_PI = np.float32(math.pi / 4), np.float32(math.pi / 2)
_TINY = np.finfo(np.float32).tiny
_EPS, _SHORT = np.float32(EPS), np.float32(1.0 - SHADOW_MARGIN)


@inlined
def _dot(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any) -> Any:  # pragma: no cover - compiled
    return ax * bx + ay * by + az * bz


@inlined
def _offset(px: Any, py: Any, pz: Any, across: Any, radius: Any) -> Any:  # pragma: no cover - compiled
    """How far off the surface a ray starts; ``across`` bounds the error across the triangle's plane."""
    return across + _EPS * max(max(max(abs(px), abs(py)), abs(pz)), radius / np.float32(1024.0))


@inlined
def _chosen(cdf: FloatArray, u: Any) -> Any:  # pragma: no cover - compiled
    """The number of steps of ``cdf`` that are at most ``u``."""
    low, high = 0, cdf.shape[0]
    while low < high:
        middle = (low + high) // 2
        if cdf[middle] <= u:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _to_light(px: Any, py: Any, pz: Any, row: FloatArray, area: Any, u0: Any, u1: Any) -> tuple[Any, ...]:
    """Direction and distance of a point of a light, and its density by solid angle, 0 where no light comes from."""
    root = np.float32(math.sqrt(_ONE - u0))  # pragma: no cover - compiled
    b0, b1 = _ONE - root, root * u1
    x = row[0] + b0 * row[3] + b1 * row[6] - px
    y = row[1] + b0 * row[4] + b1 * row[7] - py
    z = row[2] + b0 * row[5] + b1 * row[8] - pz
    squared = _dot(x, y, z, x, y, z)
    distance = np.float32(math.sqrt(squared))
    length = max(distance, _TINY)
    x, y, z = x / length, y / length, z / length
    cos = -_dot(row[9], row[10], row[11], x, y, z)
    pdf = area * squared / cos if cos > _ZERO and squared > _ZERO else _ZERO
    return x, y, z, distance, pdf


@inlined
def _shadow_ray(
    p: FloatArray, ng: FloatArray, wx: Any, wy: Any, wz: Any, distance: Any, offset: Any, o: FloatArray, d: FloatArray
) -> Any:  # pragma: no cover - compiled
    """Fill ``o, d`` [3] with a ray from ``p``, moved off its surface, to the point ``distance`` along ``w``; returns
    the distance below which a hit means shadow.
    """
    side = math.copysign(offset, _dot(wx, wy, wz, ng[0], ng[1], ng[2]))
    for k in range(3):
        o[k] = p[k] + side * ng[k]
    x, y, z = p[0] - o[0] + wx * distance, p[1] - o[1] + wy * distance, p[2] - o[2] + wz * distance
    reach = np.float32(math.sqrt(_dot(x, y, z, x, y, z)))
    inverse = max(reach, _TINY)
    d[0], d[1], d[2] = x / inverse, y / inverse, z / inverse
    return max(reach * _SHORT - _TWO * offset, _ZERO)


@inlined
def _tangents(x: Any, y: Any, z: Any) -> tuple[Any, ...]:  # pragma: no cover - compiled
    """Tangents of the frame around a normal, as ``Frame.around`` has them."""
    sign = _ONE if z >= _ZERO else -_ONE
    a = -_ONE / (sign + z)
    b = x * y * a
    return _ONE + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@inlined
def _seen_light(
    f: Any, ng: FloatArray, wo: FloatArray, end: FloatArray, p: FloatArray, pdf_area: FloatArray, emission: FloatArray
) -> Any:
    """Density by solid angle with which light sampling finds the end of a ray at ``p``; negative where it is dark."""
    cos = _dot(ng[0], ng[1], ng[2], wo[0], wo[1], wo[2])  # pragma: no cover - compiled
    found = -_ONE
    if cos > _ZERO and (emission[f, 0] != _ZERO or emission[f, 1] != _ZERO or emission[f, 2] != _ZERO):
        x, y, z = end[0] - p[0], end[1] - p[1], end[2] - p[2]
        found = pdf_area[f] * _dot(x, y, z, x, y, z) / cos
    return found


@inlined
def _ray(
    p: FloatArray, ng: FloatArray, x: Any, y: Any, z: Any, c0: Any, c1: Any, c2: Any, offset: Any, o: FloatArray,
    d: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Fill ``o, d`` [3] with a ray from ``p``, moved off its surface, along ``c`` in the frame around (x, y, z)."""
    s0, s1, s2, t0, t1, t2 = _tangents(x, y, z)
    d[0], d[1], d[2] = c0 * s0 + c1 * t0 + c2 * x, c0 * s1 + c1 * t1 + c2 * y, c0 * s2 + c1 * t2 + c2 * z
    side = math.copysign(offset, _dot(d[0], d[1], d[2], ng[0], ng[1], ng[2]))
    for k in range(3):
        o[k] = p[k] + side * ng[k]


# ---- Lambertian surfaces


@kernel
def spawn_rays_diffuse(
    low: int, high: int,
    p: FloatArray, ng: FloatArray, n: FloatArray, wo: FloatArray, prim: IntArray, reflects: Any, u: FloatArray,
    face_offset: FloatArray, radius: np.float32, cdf: FloatArray, table: FloatArray, face: IntArray,
    pdf_area: FloatArray, emission: FloatArray, o: FloatArray, d: FloatArray, pdf: FloatArray, lane: IntArray,
    shadow_o: FloatArray, shadow_d: FloatArray, t_max: FloatArray, light: FloatArray,
) -> int:  # fmt: skip  # pragma: no cover - compiled
    """Rays that leave Lambertian vertices: one by the cosine from each, and one to a light where light could come.

    Vertices ``low .. high - 1`` of [m, ...], which come as ``p, ng, n, wo, prim`` with ``reflects`` (towards ``wo``,
    bool) and the uniform numbers ``u`` [m, 7]; ``face_offset`` [F] and ``radius`` are the geometry's, ``cdf, table,
    face, pdf_area, emission`` those of ``AreaLights``. Filled are the rays of the BSDF samples ``o, d`` [m, 3] with
    their ``pdf`` [m], 0 where nothing is reflected, and from ``low`` on the shadow rays ``shadow_o, shadow_d, t_max``
    [m, ...] with their vertices ``lane``, ascending [m], and what they carry for albedo 1, ``light`` [m, 3].

    Returns:
        The number of shadow rays.
    """
    count = low
    for i in range(low, high):
        px, py, pz = p[i, 0], p[i, 1], p[i, 2]
        x, y, z = n[i, 0], n[i, 1], n[i, 2]
        toward = _dot(x, y, z, wo[i, 0], wo[i, 1], wo[i, 2])
        if toward < _ZERO:
            x, y, z = -x, -y, -z
        use = reflects[i] and toward != _ZERO
        offset = _offset(px, py, pz, face_offset[max(prim[i], 0)], radius)

        if use:  # emitter sampling
            chosen = _chosen(cdf, u[i, 2])
            f = face[chosen]
            wx, wy, wz, distance, of_light = _to_light(px, py, pz, table[chosen], pdf_area[f], u[i, 0], u[i, 1])
            density = _dot(wx, wy, wz, x, y, z) * _INV_PI
            if density > _ZERO and of_light > _ZERO:
                lane[count] = i
                t_max[count] = _shadow_ray(
                    p[i], ng[i], wx, wy, wz, distance, offset, shadow_o[count], shadow_d[count]
                )  # fmt: skip
                scale = density / (of_light + density)  # value * MIS weight / pdf
                for k in range(3):
                    light[count, k] = emission[f, k] * scale
                count += 1

        a, b = _TWO * u[i, 4] - _ONE, _TWO * u[i, 5] - _ONE  # BSDF sampling by the cosine
        if abs(a) > abs(b):
            r, phi = a, _QUARTER_PI * (b / a)
        else:
            r, phi = b, _HALF_PI - _QUARTER_PI * (a / (b if b != _ZERO else _ONE))
        c0, c1 = r * np.float32(math.cos(phi)), r * np.float32(math.sin(phi))
        c2 = np.float32(math.sqrt(max(_ONE - (c0 * c0 + c1 * c1), _ZERO)))
        _ray(p[i], ng[i], x, y, z, c0, c1, c2, offset, o[i], d[i])
        pdf[i] = c2 * _INV_PI if use else _ZERO
    return count - low


@kernel
def resolve_hits_diffuse(
    low: int, high: int,
    lane: IntArray, light: FloatArray, blocked: Any, p: FloatArray, pdf: FloatArray, end_p: FloatArray,
    end_ng: FloatArray, end_wo: FloatArray, end_prim: IntArray, end_valid: Any, pdf_area: FloatArray,
    emission: FloatArray, direct: FloatArray, through: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """What both techniques found at vertices ``low .. high - 1``.

    ``lane`` [k] and ``light`` [k, 3] are those of the shadow rays, ``blocked`` [k] whether they met something, bool;
    ``p, pdf`` the vertices [m, ...], ``end_...`` where their BSDF samples ended [m, ...]. Filled are ``direct``, the
    light of both joined by MIS, for albedo 1 [m, 3], and ``through``, the weight of the BSDF sample for it [m, 3].
    """
    for i in range(low, high):
        direct[i, 0], direct[i, 1], direct[i, 2] = _ZERO, _ZERO, _ZERO
        weight = _ONE if pdf[i] > _ZERO else _ZERO
        through[i, 0], through[i, 1], through[i, 2] = weight, weight, weight
        if pdf[i] > _ZERO and end_valid[i]:
            f = end_prim[i]
            of_light = _seen_light(f, end_ng[i], end_wo[i], end_p[i], p[i], pdf_area, emission)
            if of_light >= _ZERO:
                mis = pdf[i] / (pdf[i] + of_light)
                for k in range(3):
                    direct[i, k] = emission[f, k] * mis
    for j in range(np.searchsorted(lane, low), np.searchsorted(lane, high)):
        if not blocked[j]:
            for k in range(3):
                direct[lane[j], k] += light[j, k]


# ---- principled surfaces


@kernel
def sample_emitter(
    p: FloatArray, n: FloatArray, wo: FloatArray, u: FloatArray, cdf: FloatArray, table: FloatArray, face: IntArray,
    pdf_area: FloatArray, normal: FloatArray, view: FloatArray, towards: FloatArray, ds_d: FloatArray,
    ds_dist_pdf: FloatArray,
    ds_prim: IntArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """What the BSDF has to be asked for: directions in the shading frames of vertices [m, ...].

    Filled are the normal on the viewer's side, ``normal`` [m, 3], the viewer and a point of a light in its frame,
    ``view`` and ``towards`` [m, 3], that light's direction in the world ``way`` [m, 3], its distance and density by
    solid angle ``sent`` [m, 2], and its triangle ``source`` [m].
    """
    for i in range(p.shape[0]):
        x, y, z = n[i, 0], n[i, 1], n[i, 2]
        vx, vy, vz = wo[i, 0], wo[i, 1], wo[i, 2]
        if _dot(x, y, z, vx, vy, vz) < _ZERO:
            x, y, z = -x, -y, -z
        s0, s1, s2, t0, t1, t2 = _tangents(x, y, z)
        normal[i, 0], normal[i, 1], normal[i, 2] = x, y, z
        view[i, 0], view[i, 1] = _dot(vx, vy, vz, s0, s1, s2), _dot(vx, vy, vz, t0, t1, t2)
        view[i, 2] = _dot(vx, vy, vz, x, y, z)
        chosen = _chosen(cdf, u[i, 2])
        f = face[chosen]
        wx, wy, wz, distance, pdf = _to_light(
            p[i, 0], p[i, 1], p[i, 2], table[chosen], pdf_area[f], u[i, 0], u[i, 1]
        )  # fmt: skip
        ds_d[i, 0], ds_d[i, 1], ds_d[i, 2] = wx, wy, wz
        towards[i, 0], towards[i, 1] = _dot(wx, wy, wz, s0, s1, s2), _dot(wx, wy, wz, t0, t1, t2)
        towards[i, 2] = _dot(wx, wy, wz, x, y, z)
        ds_dist_pdf[i, 0], ds_dist_pdf[i, 1], ds_prim[i] = distance, pdf, f


@kernel
def add_guide_pdf(
    share: np.float32, wi: FloatArray, density: FloatArray, lobes: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add to the density of directions, row 2 of ``lobes`` [5, m], what a guide adds; ``density`` [m] is its own."""
    for i in range(wi.shape[0]):
        if lobes[2, i] > _ZERO:
            excess = share * (max(wi[i, 2], _ZERO) * _INV_PI) * (density[i] - _ONE)
            lobes[2, i] = max(lobes[2, i] + excess, _ZERO)


@kernel
def spawn_rays_principled(
    p: FloatArray, ng: FloatArray, prim: IntArray, reflects: Any, face_offset: FloatArray, radius: np.float32,
    normal: FloatArray, ds_d: FloatArray, ds_dist_pdf: FloatArray, ds_prim: IntArray, bsdf_em: FloatArray,
    wi: FloatArray,
    emission: FloatArray, o: FloatArray, d: FloatArray, lane: IntArray, shadow_o: FloatArray, shadow_d: FloatArray,
    t_max: FloatArray, light: FloatArray,
) -> int:  # fmt: skip  # pragma: no cover - compiled
    """Rays that leave principled vertices: one along ``wi`` from each, and one to a light where light could come.

    ``normal, way, sent, source`` are those of :func:`look`, ``asked`` the rows [5, m] of the BSDF towards the lights.
    Filled are the same as by :func:`leave`; ``light`` is for a BSDF of 1.

    Returns:
        The number of shadow rays.
    """
    count = 0
    for i in range(p.shape[0]):
        offset = _offset(p[i, 0], p[i, 1], p[i, 2], face_offset[max(prim[i], 0)], radius)
        if reflects[i] and ds_dist_pdf[i, 1] > _ZERO and (bsdf_em[0, i] > _ZERO or bsdf_em[1, i] > _ZERO):
            lane[count] = i
            t_max[count] = _shadow_ray(
                p[i], ng[i], ds_d[i, 0], ds_d[i, 1], ds_d[i, 2], ds_dist_pdf[i, 0], offset,
                shadow_o[count], shadow_d[count],
            )  # fmt: skip
            scale = _ONE / (ds_dist_pdf[i, 1] + bsdf_em[2, i])  # MIS weight / pdf
            for k in range(3):
                light[count, k] = emission[ds_prim[i], k] * scale
            count += 1
        _ray(
            p[i], ng[i], normal[i, 0], normal[i, 1], normal[i, 2], wi[i, 0], wi[i, 1], wi[i, 2], offset, o[i], d[i]
        )  # fmt: skip
    return count


@kernel
def resolve_hits_principled(
    lane: IntArray, light: FloatArray, blocked: Any, bsdf_em: FloatArray, p: FloatArray, reflects: Any,
    albedo: FloatArray, bsdf_wi: FloatArray, mean: FloatArray, end_p: FloatArray, end_ng: FloatArray,
    end_wo: FloatArray, end_prim: IntArray, end_valid: Any, via_delta: Any, throughput: FloatArray,
    pdf_area: FloatArray, emission: FloatArray, value: FloatArray, by_albedo: FloatArray, by_roughness: FloatArray,
    relative: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """What both techniques found, and its derivatives.

    ``lane, light, blocked`` are those of the shadow rays [k, ...], ``asked`` and ``drawn`` [5, m] the rows of the BSDF
    towards the lights and along the samples (d, s, pdf, slopes by roughness), ``mean`` [4, m] the mean of their d, s
    and slopes over the pdf, ``end_...`` where the samples ended, after smooth surfaces if ``passed`` [m], whose
    ``throughput`` is [m, 3]. Without a control variate ``mean`` is [4, 0], without smooth surfaces ``passed`` is [0].

    Filled are ``value`` [2 or 3, m, 3]: direct light, weight and, with ``mean``, the weight's deviation from its mean;
    their derivatives by the albedo's same channel and by the roughness, ``by_albedo, by_roughness`` alike; and
    ``relative`` [m, 3], the weight over its mean.
    """
    for i in range(p.shape[0]):
        inverse = _ONE / bsdf_wi[2, i] if reflects[i] and bsdf_wi[2, i] > _ZERO else _ZERO
        d, s, d_slope, s_slope = (
            bsdf_wi[0, i] * inverse, bsdf_wi[1, i] * inverse, bsdf_wi[3, i] * inverse, bsdf_wi[4, i] * inverse
        )  # fmt: skip
        f, mis = 0, _ZERO
        if inverse > _ZERO and end_valid[i]:
            f = end_prim[i]
            of_light = _seen_light(f, end_ng[i], end_wo[i], end_p[i], p[i], pdf_area, emission)
            if of_light >= _ZERO:  # emitter sampling cannot look through smooth surfaces
                seen = via_delta.shape[0] > 0 and via_delta[i]
                mis = _ONE if seen else bsdf_wi[2, i] / (bsdf_wi[2, i] + of_light)
        for k in range(3):
            a = albedo[i, k]
            w, slope = a * d + s, a * d_slope + s_slope
            if mean.shape[1] > 0:
                on = _ONE if reflects[i] else _ZERO
                md, ms = mean[0, i] * on, mean[1, i] * on
                fixed = a * md + ms
                value[2, i, k] = w - fixed
                by_albedo[2, i, k] = d - md
                by_roughness[2, i, k] = slope - on * (a * mean[2, i] + mean[3, i])
                relative[i, k] = w / fixed if fixed > _ZERO else _ZERO
            ds_d = throughput[i, k] if via_delta.shape[0] > 0 else _ONE
            e = emission[f, k] * mis
            value[1, i, k], by_albedo[1, i, k], by_roughness[1, i, k] = w * ds_d, d * ds_d, slope * ds_d
            value[0, i, k], by_albedo[0, i, k], by_roughness[0, i, k] = w * ds_d * e, d * ds_d * e, slope * ds_d * e
    for j in range(lane.shape[0]):
        if not blocked[j]:
            i = lane[j]
            for k in range(3):
                a, e = albedo[i, k], light[j, k]
                value[0, i, k] += (a * bsdf_em[0, i] + bsdf_em[1, i]) * e
                by_albedo[0, i, k] += bsdf_em[0, i] * e
                by_roughness[0, i, k] += (a * bsdf_em[3, i] + bsdf_em[4, i]) * e


@kernel
def vjp(
    gradient: FloatArray, by_albedo: FloatArray, by_roughness: FloatArray, albedo: FloatArray, roughness: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add a gradient times derivatives, all [m, 3], to the gradients of albedo [m, 3] and roughness [m, 1]."""
    for i in range(gradient.shape[0]):
        for k in range(3):
            albedo[i, k] += gradient[i, k] * by_albedo[i, k]
            roughness[i, 0] += gradient[i, k] * by_roughness[i, k]
