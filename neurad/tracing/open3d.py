"""Ray casting with Open3D's ``RaycastingScene``: faster than embreex on large batches, but an optional package."""

import numpy as np
import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.records import Hit, Rays
from neurad.tracing.arrays import as_floats, as_indices, beyond_start, coordinate_extent, no_hits


class Open3DTracer:
    """Closest-hit and occlusion queries against a fixed set of triangles. Barycentrics come in Embree's order."""

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        """Build the acceleration structure of triangles ``faces`` [F, 3], F may be 0, of ``vertices`` [V, 3].

        Raises:
            InputError: Open3D, or a system library that it needs, is not installed.
        """
        try:
            import open3d
        except (ImportError, OSError) as error:
            raise InputError(
                f"tracer open3d: Open3D cannot be loaded ({error}); install it with `pip install 'neurad[open3d]'`, "
                "on Linux also the system libraries libusb-1.0-0, libgl1, libegl1 and libgomp1, or choose embree"
            ) from error
        self._core = open3d.core
        self.empty = len(faces) == 0
        self.extent = coordinate_extent(vertices, faces)
        if self.empty:
            return
        points = as_floats(vertices)
        low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
        self._centre = 0.5 * (low + high)
        self._radius = 0.5 * float(np.linalg.norm(high - low))
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._core.Tensor.from_numpy(points), self._core.Tensor.from_numpy(as_indices(faces, np.uint32))
        )
        # The first query commits the scene; from then on concurrent queries are safe.
        self._scene.cast_rays(self._core.Tensor.from_numpy(np.ones((1, 6), np.float32)))

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit of every ray [n]."""
        return beyond_start(self._closest, rays, self._closest(rays), self.extent)

    def _closest(self, rays: Rays) -> Hit:
        count, device = len(rays), rays.o.device
        if self.empty or count == 0:
            return no_hits(count, device)
        both = np.concatenate((as_floats(rays.o), as_floats(rays.d)), -1)
        found = self._scene.cast_rays(self._core.Tensor.from_numpy(both))
        t = torch.from_numpy(found["t_hit"].numpy())  # infinity at a miss
        valid = torch.isfinite(t)
        prim = torch.from_numpy(found["primitive_ids"].numpy().astype(np.int64)).masked_fill_(~valid, -1)
        uv = torch.from_numpy(found["primitive_uvs"].numpy()).masked_fill_(~valid[:, None], 0.0)
        u, v = uv.T.contiguous()
        return Hit(t, prim, u, v, valid).to(device)

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether anything lies before ``t_max`` [n]: bool [n]."""
        count, device = len(rays), rays.o.device
        if self.empty or count == 0:
            return torch.zeros(count, dtype=torch.bool, device=device)
        o, d = as_floats(rays.o), as_floats(rays.d)
        # Open3D takes one far distance for all rays: it is 1 here, and each direction is scaled by the ray's own t_max.
        # Infinity becomes a distance beyond the bounding sphere.
        outside = 2.0 * (np.linalg.norm(o - self._centre, axis=-1) + self._radius)
        far = np.minimum(as_floats(t_max), outside).astype(np.float32)
        both = np.concatenate((o, d * far[:, None]), -1)
        found = self._scene.test_occlusions(self._core.Tensor.from_numpy(both), 0.0, 1.0)
        return (torch.from_numpy(found.numpy()) & (torch.from_numpy(far) > 0)).to(device)
