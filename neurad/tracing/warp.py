"""Ray casting with NVIDIA Warp: rays stay on their device, GPU or CPU. An optional package."""

from typing import Any

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.records import Hit, Rays
from neurad.runtime.warp import launch, load
from neurad.tracing.arrays import coordinate_extent, no_hits


class WarpTracer:
    """Closest-hit and occlusion queries against a fixed set of triangles, on the device of the rays.

    The triangles are copied to a device, and their bounding volumes built, at the first query from that device. Warp's
    triangle test is watertight (Woop et al. 2013). On the CPU it runs on one thread: good for tests, slow for training.
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        """Keep the triangles ``faces`` [F, 3], F may be 0, of ``vertices`` [V, 3].

        Raises:
            InputError: Warp is not installed.
        """
        try:
            self._warp = load()
            from neurad.tracing import warp_kernels
        except (ImportError, OSError) as error:
            raise InputError(
                f"tracer warp: NVIDIA Warp cannot be loaded ({error}); install it with `pip install 'neurad[gpu]'`, "
                "or choose embree"
            ) from error
        self._kernels: Any = warp_kernels
        corners = vertices.detach().float()[faces]  # [F, 3, 3]
        edges = corners[:, 1:].double() - corners[:, :1].double()
        # Warp's test may hit a triangle without area, so those are left out.
        self._prim = torch.linalg.cross(edges[:, 0], edges[:, 1]).abs().amax(-1).nonzero().squeeze(-1)
        self._corners = corners[self._prim].contiguous()
        self._meshes: dict[torch.device, tuple[Any, Tensor]] = {}
        self.empty = len(self._prim) == 0
        self.extent = coordinate_extent(vertices, faces[self._prim])

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit of every ray [n]."""
        hit = no_hits(len(rays), rays.o.device)
        if not self.empty and len(rays) > 0:
            prim = self._mesh(rays.o.device)[1]
            self._launch(self._kernels.closest, rays, prim, self.extent, hit.t, hit.prim, hit.u, hit.v, hit.valid)
        return hit

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether anything lies before ``t_max`` [n]: bool [n]."""
        blocked = torch.zeros(len(rays), dtype=torch.bool, device=rays.o.device)
        if not self.empty and len(rays) > 0:
            self._launch(self._kernels.occluded, rays, t_max.detach().float().contiguous(), blocked)
        return blocked

    def _launch(self, kernel: Any, rays: Rays, *arrays: Any) -> None:
        """Run a kernel, one thread a ray."""
        o, d = (x.detach().float().contiguous() for x in (rays.o, rays.d))
        launch(kernel, len(rays), o.device, self._mesh(o.device)[0].id, o, d, *arrays)

    def _mesh(self, device: torch.device) -> tuple[Any, Tensor]:
        """The triangles on a device, and their indices among all triangles."""
        if device not in self._meshes:
            wp = self._warp
            # Warp's test of a bounding box rounds without a margin, so a ray through an edge of two triangles can miss
            # both boxes: one in 1500 of those aimed at edges and vertices of a sphere did. So boxes are built from
            # triangles with larger boxes, which the original ones then replace in the array that queries read.
            points = _enlarged(self._corners).to(device)
            index = torch.arange(len(points), dtype=torch.int32, device=device)
            if device.type == "cuda":  # Warp reads on a stream of its own: torch's copies must be done
                torch.cuda.synchronize(device)
            # The best bounding volumes, not those that are built fastest: the triangles never move.
            mesh = wp.Mesh(wp.from_torch(points, dtype=wp.vec3), wp.from_torch(index), bvh_constructor="sah")
            wp.synchronize_device(wp.device_from_torch(device))
            points.copy_(self._corners.view(-1, 3))
            self._meshes[device] = mesh, self._prim.to(device)
        return self._meshes[device]


def _enlarged(corners: Tensor) -> Tensor:
    """For triangles [F, 3, 3] others whose bounding boxes have a margin: two corners of a box and its centre [3 F, 3].

    The margin is some ten times the rounding error of a box test from as far away as the scene is large.
    """
    low, high = corners.amin(1), corners.amax(1)
    size = (high.amax(0) - low.amin(0)).norm() + corners.abs().max()
    margin = 2.0**-20 * size
    low, high = low - margin, high + margin
    return torch.stack((low, high, 0.5 * (low + high)), 1).view(-1, 3).contiguous()
