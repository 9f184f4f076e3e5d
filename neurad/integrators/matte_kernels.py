"""Compiled halves of a bounce at Lambertian surfaces under area lights; see :mod:`neurad.integrators.matte`.

All arithmetic is float32, in the order of the plain formulas: the offsets of spawned rays are bounds on its rounding.
Compiled at first use and cached on disk; the kernels release the interpreter lock and run on the calling thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

from neurad.core.records import FloatArray, IntArray
from neurad.scene.geometry import EPS, SHADOW_MARGIN

Function = TypeVar("Function", bound=Callable[..., Any])
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_INV_PI = np.float32(1.0 / math.pi)
_QUARTER_PI, _HALF_PI = np.float32(math.pi / 4), np.float32(math.pi / 2)
_TINY = np.finfo(np.float32).tiny
_EPS, _SHORT = np.float32(EPS), np.float32(1.0 - SHADOW_MARGIN)


def _compiled(function: Function) -> Function:
    """Compile at first use, cache on disk, release the interpreter lock, let divisions by zero be infinite."""
    return cast(Function, numba.njit(nogil=True, cache=True, error_model="numpy")(function))


@numba.njit(inline="always")
def _dot(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any) -> Any:  # pragma: no cover - compiled
    return ax * bx + ay * by + az * bz


@_compiled
def leave(
    p: FloatArray, ng: FloatArray, n: FloatArray, wo: FloatArray, prim: IntArray, reflects: Any, u: FloatArray,
    face_offset: FloatArray, radius: np.float32, cdf: FloatArray, table: FloatArray, face: IntArray,
    pdf_area: FloatArray, emission: FloatArray, o: FloatArray, d: FloatArray, pdf: FloatArray, lane: IntArray,
    shadow_o: FloatArray, shadow_d: FloatArray, t_max: FloatArray, light: FloatArray,
) -> int:  # fmt: skip  # pragma: no cover - compiled
    """Rays that leave Lambertian vertices: one by the cosine from each, and one to a light where light could come.

    The vertices [m, ...] come as ``p, ng, n, wo, prim`` with ``reflects`` (towards ``wo``, bool) and the uniform
    numbers ``u`` [m, 7]; ``face_offset`` [F] and ``radius`` are the geometry's, ``cdf, table, face, pdf_area,
    emission`` those of ``AreaLights``. Filled are the rays of the BSDF samples ``o, d`` [m, 3] with their ``pdf`` [m],
    0 where nothing is reflected, and the shadow rays ``shadow_o, shadow_d, t_max`` [m, ...] with their vertices
    ``lane``, ascending [m], and what they carry for albedo 1, ``light`` [m, 3].

    Returns:
        The number of shadow rays.
    """
    count = 0
    for i in range(p.shape[0]):
        px, py, pz = p[i, 0], p[i, 1], p[i, 2]
        gx, gy, gz = ng[i, 0], ng[i, 1], ng[i, 2]
        x, y, z = n[i, 0], n[i, 1], n[i, 2]
        toward = _dot(x, y, z, wo[i, 0], wo[i, 1], wo[i, 2])
        if toward < _ZERO:
            x, y, z = -x, -y, -z
        use = reflects[i] and toward != _ZERO
        largest = max(max(abs(px), abs(py)), abs(pz))
        offset = face_offset[max(prim[i], 0)] + _EPS * max(largest, radius / np.float32(1024.0))

        if use:  # emitter sampling
            low, high = 0, cdf.shape[0]
            while low < high:  # the number of steps of the cdf that are at most u
                middle = (low + high) // 2
                if cdf[middle] <= u[i, 2]:
                    low = middle + 1
                else:
                    high = middle
            row, f = table[low], face[low]
            root = np.float32(math.sqrt(_ONE - u[i, 0]))
            b0, b1 = _ONE - root, root * u[i, 1]
            lx = row[0] + b0 * row[3] + b1 * row[6] - px
            ly = row[1] + b0 * row[4] + b1 * row[7] - py
            lz = row[2] + b0 * row[5] + b1 * row[8] - pz
            squared = _dot(lx, ly, lz, lx, ly, lz)
            distance = np.float32(math.sqrt(squared))
            length = max(distance, _TINY)
            wx, wy, wz = lx / length, ly / length, lz / length
            cos_light = -_dot(row[9], row[10], row[11], wx, wy, wz)
            density = _dot(wx, wy, wz, x, y, z) * _INV_PI
            if cos_light > _ZERO and squared > _ZERO and density > _ZERO:
                of_light = pdf_area[f] * squared / cos_light
                if of_light > _ZERO:
                    side = math.copysign(offset, _dot(wx, wy, wz, gx, gy, gz))
                    ox, oy, oz = px + side * gx, py + side * gy, pz + side * gz
                    ax, ay, az = px - ox + wx * distance, py - oy + wy * distance, pz - oz + wz * distance
                    reach = np.float32(math.sqrt(_dot(ax, ay, az, ax, ay, az)))
                    inverse = max(reach, _TINY)
                    lane[count] = i
                    shadow_o[count, 0], shadow_o[count, 1], shadow_o[count, 2] = ox, oy, oz
                    shadow_d[count, 0], shadow_d[count, 1] = ax / inverse, ay / inverse
                    shadow_d[count, 2] = az / inverse
                    t_max[count] = max(reach * _SHORT - _TWO * offset, _ZERO)
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
        sign = _ONE if z >= _ZERO else -_ONE
        k0 = -_ONE / (sign + z)
        k1 = x * y * k0
        wx = c0 * (_ONE + sign * x * x * k0) + c1 * k1 + c2 * x
        wy = c0 * (sign * k1) + c1 * (sign + y * y * k0) + c2 * y
        wz = c0 * (-sign * x) - c1 * y + c2 * z
        side = math.copysign(offset, _dot(wx, wy, wz, gx, gy, gz))
        o[i, 0], o[i, 1], o[i, 2] = px + side * gx, py + side * gy, pz + side * gz
        d[i, 0], d[i, 1], d[i, 2] = wx, wy, wz
        pdf[i] = c2 * _INV_PI if use else _ZERO
    return count


@_compiled
def arrive(
    lane: IntArray, light: FloatArray, blocked: Any, p: FloatArray, pdf: FloatArray, end_p: FloatArray,
    end_ng: FloatArray, end_wo: FloatArray, end_prim: IntArray, end_valid: Any, pdf_area: FloatArray,
    emission: FloatArray, direct: FloatArray, through: FloatArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """What both techniques found.

    ``lane`` [k] and ``light`` [k, 3] are those of the shadow rays, ``blocked`` [k] whether they met something, bool;
    ``p, pdf`` the vertices [m, ...], ``end_...`` where their BSDF samples ended [m, ...]. Filled are ``direct``, the
    light of both joined by MIS, for albedo 1 [m, 3], and ``through``, the weight of the BSDF sample for it [m, 1].
    """
    for i in range(p.shape[0]):
        direct[i, 0], direct[i, 1], direct[i, 2] = _ZERO, _ZERO, _ZERO
        through[i, 0] = _ONE if pdf[i] > _ZERO else _ZERO
        if pdf[i] > _ZERO and end_valid[i]:
            f = end_prim[i]
            cos = _dot(end_ng[i, 0], end_ng[i, 1], end_ng[i, 2], end_wo[i, 0], end_wo[i, 1], end_wo[i, 2])
            bright = emission[f, 0] != _ZERO or emission[f, 1] != _ZERO or emission[f, 2] != _ZERO
            if cos > _ZERO and bright:
                x, y, z = end_p[i, 0] - p[i, 0], end_p[i, 1] - p[i, 1], end_p[i, 2] - p[i, 2]
                of_light = pdf_area[f] * _dot(x, y, z, x, y, z) / cos
                mis = pdf[i] / (pdf[i] + of_light)
                for k in range(3):
                    direct[i, k] = emission[f, k] * mis
    for j in range(lane.shape[0]):
        if not blocked[j]:
            for k in range(3):
                direct[lane[j], k] += light[j, k]
