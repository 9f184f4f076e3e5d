"""Which surface points some training view sees."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.core.camera import in_view
from neurad.core.protocols import Tracer
from neurad.core.records import Camera, Rays, SurfaceInteraction
from neurad.scene.geometry import SHADOW_MARGIN, Geometry


class SeenBy:
    """Visibility of points from cameras: inside the frustum, in front of the camera, with nothing in between.

    Args:
        geometry: the triangles.
        tracer: casts rays against them.
        cameras: the training cameras.
    """

    def __init__(self, geometry: Geometry, tracer: Tracer, cameras: list[Camera]) -> None:
        self.geometry = geometry
        self.tracer = tracer
        self.cameras = cameras
        self._found = [0] * len(cameras)

    def by(self, index: int, si: SurfaceInteraction) -> tuple[Tensor, Tensor]:
        """Lanes [k] of ``si`` that camera ``index`` sees, and the unit directions [k, 3] from them to it."""
        camera = self.cameras[index]
        lanes = (si.valid & in_view(camera, si.p)).nonzero().squeeze(-1)
        points = si[lanes]
        eye = torch.as_tensor(camera.to_world, dtype=si.p.dtype, device=si.p.device)[:3, 3]
        away = eye - points.p  # [k, 3]
        distance = torch.linalg.vector_norm(away, dim=-1)
        wi = away / distance.clamp_min(torch.finfo(away.dtype).tiny)[:, None]
        clear = ~self.tracer.occluded(*self.geometry.spawn_towards(points, wi, distance))
        return lanes[clear], wi[clear]

    def any(self, si: SurfaceInteraction) -> Tensor:
        """Whether at least one camera sees the lanes of ``si``: bool [n].

        Cameras are tested in turn on the lanes that none has seen yet; those that saw most so far come first.
        """
        seen = torch.zeros(len(si), dtype=torch.bool, device=si.p.device)
        left = si.valid.nonzero().squeeze(-1)
        for index in sorted(range(len(self.cameras)), key=lambda i: -self._found[i]):
            if len(left) == 0:
                break
            lanes, _ = self.by(index, si[left])
            self._found[index] += len(lanes)
            seen[left[lanes]] = True
            left = left[~seen[left]]
        return seen

    def any_at(self, p: Tensor) -> Tensor:
        """Whether at least one camera sees points [n, 3] that lie on surfaces: bool [n].

        :meth:`any` for positions of which no more is known: rays go from the cameras to them and end shortly before.
        """
        seen = torch.zeros(len(p), dtype=torch.bool, device=p.device)
        for camera in self.cameras:
            lanes = (~seen & in_view(camera, p)).nonzero().squeeze(-1)
            eye = torch.as_tensor(camera.to_world, dtype=p.dtype, device=p.device)[:3, 3]
            towards = p[lanes] - eye
            distance = torch.linalg.vector_norm(towards, dim=-1)
            d = towards / distance.clamp_min(torch.finfo(p.dtype).tiny)[:, None]
            rays = Rays(eye.expand_as(d).contiguous(), d)
            seen[lanes] = ~self.tracer.occluded(rays, distance * (1.0 - SHADOW_MARGIN))
        return seen
