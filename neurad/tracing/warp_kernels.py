"""Kernels of the Warp tracer; compiled by Warp for the processor or the GPU at first use and cached on disk."""
# mypy: disable-error-code="attr-defined, valid-type"
# No postponed annotations here: Warp reads the argument types when a kernel is declared.

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def closest(
    mesh: wp.uint64,
    o: wp.array(dtype=wp.vec3),
    d: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int64),
    t: wp.array(dtype=wp.float32),
    prim: wp.array(dtype=wp.int64),
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
    valid: wp.array(dtype=wp.bool),
) -> None:
    """The nearest hit of every ray; lanes that miss keep what the arrays held."""
    i = wp.tid()
    found = wp.mesh_query_ray(mesh, o[i], d[i], wp.inf)
    if found.result:
        t[i] = found.t
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
