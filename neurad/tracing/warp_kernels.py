"""Kernels of the Warp tracer; compiled by Warp for the processor or the GPU at first use and cached on disk."""
# mypy: disable-error-code="attr-defined, valid-type, no-untyped-call"
# No postponed annotations here: Warp reads the argument types when a kernel is declared.

import warp as wp

from neurad.tracing import arrays

TRIES = wp.constant(arrays.TRIES)
FIRST_STEP = wp.constant(arrays.FIRST_STEP)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def closest(
    mesh: wp.uint64,
    o: wp.array(dtype=wp.vec3),
    d: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int64),
    extent: float,
    t: wp.array(dtype=wp.float32),
    prim: wp.array(dtype=wp.int64),
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
    valid: wp.array(dtype=wp.bool),
) -> None:
    """The nearest hit of every ray with t > 0; lanes that miss keep what the arrays held.

    A ray that starts on a triangle is cast again as :func:`neurad.tracing.arrays.beyond_start` does it; ``extent`` is
    the largest coordinate of the scene.
    """
    i = wp.tid()
    found = wp.mesh_query_ray(mesh, o[i], d[i], wp.inf)
    offset = float(0.0)  # noqa: UP018  a number that a loop changes must be declared as one
    step = wp.max(wp.max(wp.abs(o[i])), extent / 1024.0) * FIRST_STEP
    tries = int(0)  # noqa: UP018, RUF046
    while found.result and found.t <= 0.0 and tries < TRIES:
        offset = step
        found = wp.mesh_query_ray(mesh, o[i] + offset * d[i], d[i], wp.inf)
        step *= 4.0
        tries += 1
    if found.result and found.t > 0.0:
        t[i] = found.t + offset
        prim[i] = index[found.face]
        # Warp: p = u p0 + v p1 + (1 - u - v) p2. Ours, as Embree's: p = (1 - u - v) p0 + u p1 + v p2.
        u[i] = found.v
        v[i] = wp.max(1.0 - found.u - found.v, 0.0)
        valid[i] = True


@wp.kernel
def occluded(
    mesh: wp.uint64,
    o: wp.array(dtype=wp.vec3),
    d: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    blocked: wp.array(dtype=wp.bool),
) -> None:
    """Whether anything lies before ``t_max``."""
    i = wp.tid()
    if t_max[i] > 0.0:
        blocked[i] = wp.mesh_query_ray_anyhit(mesh, o[i], d[i], t_max[i])
