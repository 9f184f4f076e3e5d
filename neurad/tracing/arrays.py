"""Between torch tensors on any device and the contiguous CPU arrays that ray casting libraries read."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from neurad.core.extent import subsample, typical_extent
from neurad.core.records import FloatArray, Hit, Rays

FIRST_STEP, TRIES = 2.0**-22, 8
"""First step of a ray away from the triangle that it starts on, over its largest coordinate, and how many it takes,
each four times as long as the one before."""


def as_floats(values: Tensor) -> FloatArray:
    """``values`` as a contiguous float32 array; shares memory with a tensor that is one already."""
    array: FloatArray = values.detach().to("cpu", torch.float32).contiguous().numpy()
    return array


def as_indices(values: Tensor, dtype: type[np.integer[Any]]) -> npt.NDArray[Any]:
    """``values`` as a contiguous integer array."""
    return np.ascontiguousarray(values.detach().cpu().numpy().astype(dtype))


def no_hits(count: int, device: torch.device) -> Hit:
    """``count`` misses."""
    zero = torch.zeros(count, device=device)
    miss = torch.full((count,), -1, dtype=torch.int64, device=device)
    return Hit(torch.full_like(zero, torch.inf), miss, zero, zero.clone(), miss >= 0)


def coordinate_extent(vertices: Tensor, faces: Tensor) -> float:
    """Largest coordinate of triangles [F, 3] with corners in ``vertices`` [V, 3], outliers left out."""
    if len(faces) == 0:
        return 0.0
    sizes = vertices.detach().abs().amax(-1)
    some = sizes[faces[subsample(len(faces))]]
    return typical_extent(float(sizes.max()), some.cpu().double().numpy().ravel())


def beyond_start(closest: Callable[[Rays], Hit], rays: Rays, hit: Hit, extent: float) -> Hit:
    """``hit`` with t > 0: Embree also reports t = 0, for a ray that starts exactly on a triangle.

    Such a ray is cast again from a little further on, where little begins at the float32 spacing of its origin and
    grows while rounding puts it back. A ray that never gets off the triangle runs inside its plane and misses.

    Args:
        closest: casts rays, t >= 0.
        extent: largest coordinate of the scene, see :func:`coordinate_extent`; sets the smallest step.
    """
    if len(hit) == 0 or hit.t.min() > 0:  # a miss is infinitely far away
        return hit
    on = (hit.valid & (hit.t <= 0)).nonzero()[:, 0]
    if len(on) == 0:
        return hit
    t, prim, u, v = hit.t.clone(), hit.prim.clone(), hit.u.clone(), hit.v.clone()
    step = FIRST_STEP * rays.o[on].detach().float().abs().amax(-1).clamp_min(extent / 1024)
    for _ in range(TRIES):
        start = rays[on]
        found = closest(Rays(start.o + step[:, None] * start.d, start.d))
        stuck = found.valid & (found.t <= 0)
        keep = found.valid & ~stuck
        t[on], prim[on] = torch.where(keep, found.t + step, torch.inf), torch.where(keep, found.prim, -1)
        u[on], v[on] = torch.where(keep, found.u, 0.0), torch.where(keep, found.v, 0.0)
        on, step = on[stuck], 4.0 * step[stuck]
        if len(on) == 0:
            break
    return Hit(t, prim, u, v, prim >= 0)
