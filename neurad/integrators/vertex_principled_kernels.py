"""Kernels of :mod:`neurad.integrators.vertex_principled`: what is not the BSDF's own of a bounce.

Compiled at first use and cached on disk; they release the interpreter lock and run on the calling thread.
"""

from typing import NamedTuple

import numpy as np

from neurad.core.records import BoolArray, FloatArray, IntArray
from neurad.integrators.vertex_kernels_shared import (
    ONE,
    ZERO,
    ShadowRays,
    Triangles,
    Vertices,
    dot,
    emitter_pdf,
    pick_triangle,
    ray_offset,
    sample_triangle,
    spawn_ray,
    spawn_shadow_ray,
    tangents,
)  # fmt: skip
from neurad.runtime.jit import kernel


class LocalSamples(NamedTuple):
    """Vertices in their shading frames, and a point of a light for each."""

    n: FloatArray
    """Shading normal on the viewer's side, world [m, 3]."""
    wo: FloatArray
    """Towards the viewer, local [m, 3]."""
    wi_em: FloatArray
    """Towards the point of a light, local [m, 3]."""
    ds_d: FloatArray
    """Direction towards the point of a light, world [m, 3]."""
    ds_dist_pdf: FloatArray
    """Its distance, and its density by solid angle [m, 2]."""
    ds_prim: IntArray
    """Its triangle [m]."""


class Derivatives(NamedTuple):
    """What a bounce gives, in q = 2 or 3 rows: direct light, weight and, with a control variate, its deviation."""

    value: FloatArray
    """[q, m, 3]."""
    by_albedo: FloatArray
    """Derivatives by the albedo's same channel [q, m, 3]."""
    by_scalars: FloatArray
    """Derivatives by scalar parameters, the roughness first [q, scalars, m, 3]."""
    relative: FloatArray
    """Weight over its mean [m, 3]; [0, 3] without a control variate."""


@kernel
def sample_emitter(
    vertices: Vertices, u: FloatArray, lights: Triangles, out: LocalSamples
) -> None:  # pragma: no cover - compiled
    """Fill ``out`` [m]: frames around ``vertices`` [m], and emitter samples from the uniform numbers ``u`` [m, 7]."""
    p, _, n, wo, _, _ = vertices
    for i in range(p.shape[0]):
        # Frame
        x, y, z = n[i, 0], n[i, 1], n[i, 2]
        vx, vy, vz = wo[i, 0], wo[i, 1], wo[i, 2]
        if dot(x, y, z, vx, vy, vz) < ZERO:
            x, y, z = -x, -y, -z
        s0, s1, s2, t0, t1, t2 = tangents(x, y, z)
        out.n[i, 0], out.n[i, 1], out.n[i, 2] = x, y, z
        out.wo[i, 0], out.wo[i, 1] = dot(vx, vy, vz, s0, s1, s2), dot(vx, vy, vz, t0, t1, t2)
        out.wo[i, 2] = dot(vx, vy, vz, x, y, z)

        # Emitter sampling
        chosen = pick_triangle(lights.cdf, u[i, 2])
        f = lights.face[chosen]
        wx, wy, wz, distance, pdf = sample_triangle(
            p[i, 0], p[i, 1], p[i, 2], lights.table[chosen], lights.pdf_area[f], u[i, 0], u[i, 1]
        )  # fmt: skip
        out.ds_d[i, 0], out.ds_d[i, 1], out.ds_d[i, 2] = wx, wy, wz
        out.wi_em[i, 0], out.wi_em[i, 1] = dot(wx, wy, wz, s0, s1, s2), dot(wx, wy, wz, t0, t1, t2)
        out.wi_em[i, 2] = dot(wx, wy, wz, x, y, z)
        out.ds_dist_pdf[i, 0], out.ds_dist_pdf[i, 1], out.ds_prim[i] = distance, pdf, f


@kernel
def spawn_rays_principled(
    vertices: Vertices, reflects: BoolArray, face_offset: FloatArray, radius: np.float32, local: LocalSamples,
    bsdf_em: FloatArray, wi: FloatArray, emission: FloatArray, o: FloatArray, d: FloatArray, shadow: ShadowRays,
) -> int:  # fmt: skip  # pragma: no cover - compiled
    """Rays that leave principled vertices: one along ``wi`` from each, and one to a light where light could come.

    Args:
        vertices: [m].
        reflects: whether they reflect towards ``wo`` [m].
        face_offset: the geometry's offsets [F].
        radius: the geometry's scale.
        local: what :func:`sample_emitter` filled [m].
        bsdf_em: rows of the BSDF towards the lights: d, s, pdf, and derivatives [5 or 7, m].
        wi: BSDF samples, local [m, 3].
        emission: radiance of every triangle [F, 3].
        o, d: filled with the rays of the BSDF samples [m, 3].
        shadow: filled, for a BSDF of 1.

    Returns:
        The number of shadow rays.
    """
    p, ng, _, _, prim, _ = vertices
    n = local.n
    count = 0
    for i in range(p.shape[0]):
        offset = ray_offset(p[i, 0], p[i, 1], p[i, 2], face_offset[max(prim[i], 0)], radius)
        if reflects[i] and local.ds_dist_pdf[i, 1] > ZERO and (bsdf_em[0, i] > ZERO or bsdf_em[1, i] > ZERO):
            shadow.lane[count] = i
            shadow.t_max[count] = spawn_shadow_ray(
                p[i], ng[i], local.ds_d[i, 0], local.ds_d[i, 1], local.ds_d[i, 2], local.ds_dist_pdf[i, 0], offset,
                shadow.o[count], shadow.d[count],
            )  # fmt: skip
            scale = ONE / (local.ds_dist_pdf[i, 1] + bsdf_em[2, i])  # MIS weight / pdf
            for k in range(3):
                shadow.radiance[count, k] = emission[local.ds_prim[i], k] * scale
            count += 1
        spawn_ray(
            p[i], ng[i], n[i, 0], n[i, 1], n[i, 2], wi[i, 0], wi[i, 1], wi[i, 2], offset, o[i], d[i]
        )  # fmt: skip
    return count


@kernel
def resolve_hits_principled(
    shadow: ShadowRays, blocked: BoolArray, bsdf_em: FloatArray, p: FloatArray, reflects: BoolArray,
    albedo: FloatArray, bsdf_wi: FloatArray, mean: FloatArray, ends: Vertices, via_delta: BoolArray,
    throughput: FloatArray, lights: Triangles, out: Derivatives,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """What both techniques found, joined by MIS, and its derivatives.

    Args:
        shadow: rays to lights [k].
        blocked: whether they met something [k].
        bsdf_em: rows of the BSDF towards the lights: d, s, pdf, then dd/dx, ds/dx by scalar parameters [5 or 7, m].
        p: vertices [m, 3].
        reflects: whether they reflect towards the viewer [m].
        albedo: there [m, 3].
        bsdf_wi: rows of the BSDF along its own samples [5 or 7, m].
        mean: means over the pdf of d, s and their derivatives [4 or 6, m]; [4, 0] without a control variate.
        ends: where the BSDF samples ended, after smooth surfaces [m].
        via_delta: whether there was one [m]; [0] in a scene without any.
        throughput: of these surfaces [m, 3]; [0, 3] in a scene without any.
        out: filled.
    """
    value, by_albedo, by_scalars, relative = out
    emission = lights.emission
    for i in range(p.shape[0]):
        # Weight of the BSDF sample
        inverse = ONE / bsdf_wi[2, i] if reflects[i] and bsdf_wi[2, i] > ZERO else ZERO
        d, s = bsdf_wi[0, i] * inverse, bsdf_wi[1, i] * inverse

        # Its MIS weight, where it ended on a light
        f, mis = 0, ZERO
        if inverse > ZERO and ends.valid[i]:
            f = ends.prim[i]
            pdf_em = emitter_pdf(f, ends.ng[i], ends.wo[i], ends.p[i], p[i], lights.pdf_area, emission)
            if pdf_em >= ZERO:  # emitter sampling cannot look through smooth surfaces
                seen = via_delta.shape[0] > 0 and via_delta[i]
                mis = ONE if seen else bsdf_wi[2, i] / (bsdf_wi[2, i] + pdf_em)

        # Values, and derivatives by the albedo
        for k in range(3):
            a = albedo[i, k]
            w = a * d + s
            if mean.shape[1] > 0:
                on = ONE if reflects[i] else ZERO
                md, ms = mean[0, i] * on, mean[1, i] * on
                fixed = a * md + ms
                value[2, i, k], by_albedo[2, i, k] = w - fixed, d - md
                relative[i, k] = w / fixed if fixed > ZERO else ZERO
            t = throughput[i, k] if via_delta.shape[0] > 0 else ONE
            e = emission[f, k] * mis
            value[1, i, k], by_albedo[1, i, k] = w * t, d * t
            value[0, i, k], by_albedo[0, i, k] = w * t * e, d * t * e

        # Derivatives by scalar parameters
        for x in range(by_scalars.shape[1]):
            d_by, s_by = bsdf_wi[3 + 2 * x, i] * inverse, bsdf_wi[4 + 2 * x, i] * inverse
            for k in range(3):
                a = albedo[i, k]
                w_by = a * d_by + s_by
                if mean.shape[1] > 0:
                    on = ONE if reflects[i] else ZERO
                    by_scalars[2, x, i, k] = w_by - on * (a * mean[2 + 2 * x, i] + mean[3 + 2 * x, i])
                t = throughput[i, k] if via_delta.shape[0] > 0 else ONE
                by_scalars[1, x, i, k] = w_by * t
                by_scalars[0, x, i, k] = w_by * t * (emission[f, k] * mis)

    # Emitter sampling: what unoccluded shadow rays carry
    for j in range(shadow.lane.shape[0]):
        if not blocked[j]:
            i = shadow.lane[j]
            for k in range(3):
                a, e = albedo[i, k], shadow.radiance[j, k]
                value[0, i, k] += (a * bsdf_em[0, i] + bsdf_em[1, i]) * e
                by_albedo[0, i, k] += bsdf_em[0, i] * e
                for x in range(by_scalars.shape[1]):
                    by_scalars[0, x, i, k] += (a * bsdf_em[3 + 2 * x, i] + bsdf_em[4 + 2 * x, i]) * e


@kernel
def vjp(
    gradient: FloatArray, by_albedo: FloatArray, by_scalars: FloatArray, albedo: FloatArray, scalars: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add a gradient [m, 3] times derivatives, by the albedo [m, 3] and by scalar parameters [scalars, m, 3], to the
    gradients of these [m, 3] and [scalars, m, 1].
    """
    for i in range(gradient.shape[0]):
        for k in range(3):
            albedo[i, k] += gradient[i, k] * by_albedo[i, k]
            for x in range(scalars.shape[0]):
                scalars[x, i, 0] += gradient[i, k] * by_scalars[x, i, k]
