"""Ray casting with Embree 4 through ``embreex``, on several threads."""

from collections.abc import Callable

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from torch import Tensor

from neurad.core.records import Hit, Rays
from neurad.runtime.threads import split
from neurad.tracing.arrays import as_floats, as_indices, beyond_start, coordinate_extent, no_hits

# Rays for each thread from which on handing a slice over is worth it, about 0.2 ms of work, and about as many as have
# arrays that stay in the cache (measured on 330 k triangles).
CLOSEST_SHARD = 1024
OCCLUDED_SHARD = 2048
MAX_SHARD = 16384


class EmbreeTracer:
    """Closest-hit and occlusion queries against a fixed set of triangles.

    Embree's robust mode: no ray slips through a shared edge or vertex, and differences to the ray's origin are taken
    before anything is multiplied, so coordinates far from the origin lose nothing beyond their own float32 spacing.
    Triangles without area are never hit.
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        """Build the acceleration structure of triangles ``faces`` [F, 3], F may be 0, of ``vertices`` [V, 3]."""
        self.empty = len(faces) == 0
        self.extent = coordinate_extent(vertices, faces)
        if self.empty:
            return
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, as_floats(vertices), as_indices(faces, np.int32))
        # The first query commits the scene; from then on concurrent queries are safe.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), output=True)

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit of every ray [n]."""
        return beyond_start(self._closest, rays, self._closest(rays), self.extent)

    def _closest(self, rays: Rays) -> Hit:
        count, device = len(rays), rays.o.device
        if self.empty or count == 0:
            return no_hits(count, device)
        o, d = as_floats(rays.o), as_floats(rays.d)
        far, first, second = torch.empty(3, count, device="cpu").unbind()  # whatever torch's default device is
        prims, hits = (torch.empty(count, dtype=kind, device="cpu") for kind in (torch.int64, torch.bool))
        hit = Hit(far, prims, first, second, hits)
        t, prim, u, v, valid = (x.numpy() for x in (hit.t, hit.prim, hit.u, hit.v, hit.valid))

        def cast(part: slice) -> None:
            found = self._scene.run(o[part], d[part], output=True)
            t[part], prim[part], u[part], v[part] = found["tfar"], found["primID"], found["u"], found["v"]
            np.greater_equal(prim[part], 0, out=valid[part])
            if not valid[part].all():
                t[part][~valid[part]] = np.inf  # Embree has 1e37 there

        self._in_slices(cast, count, CLOSEST_SHARD)
        return hit.to(device)

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether anything lies before ``t_max`` [n]: bool [n]."""
        count, device = len(rays), rays.o.device
        blocked = torch.zeros(count, dtype=torch.bool, device="cpu")
        if self.empty or count == 0:
            return blocked.to(device)
        o, d = as_floats(rays.o), as_floats(rays.d)
        far = as_floats(t_max).copy()  # embreex writes into it
        out = blocked.numpy()

        def cast(part: slice) -> None:
            # This query answers 0 where something was hit and -1 where not.
            np.equal(self._scene.run(o[part], d[part], dists=far[part], query="OCCLUDED"), 0, out=out[part])

        self._in_slices(cast, count, OCCLUDED_SHARD)
        return blocked.to(device)

    @staticmethod
    def _in_slices(cast: Callable[[slice], None], count: int, least: int) -> None:
        """Run ``cast`` on slices of ``count`` rays, of ``least`` or more for each thread."""

        def work(low: int, high: int) -> None:
            for begin in range(low, high, MAX_SHARD):
                cast(slice(begin, min(begin + MAX_SHARD, high)))

        split(work, count, least)
