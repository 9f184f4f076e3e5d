"""Which surface points some training view sees."""

from collections.abc import Sequence
from typing import Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from neurad.core.camera import in_view, project, to_camera
from neurad.core.protocols import Tracer
from neurad.core.records import Rays, SurfaceInteraction
from neurad.core.scene_records import Camera, View
from neurad.images.photographs import kept_pixels
from neurad.scene.geometry import SHADOW_MARGIN, Geometry


class SeenBy:
    """Visibility of points from cameras: inside the frustum, in front of the camera, with nothing in between.

    Args:
        kept: pixels [h, w] of each that count, see :func:`neurad.images.photographs.kept_pixels`: what only others show
            is not seen. None for a camera or for all: every pixel does.
    """

    def __init__(
        self,
        geometry: Geometry,
        tracer: Tracer,
        cameras: list[Camera],
        kept: Sequence[npt.NDArray[np.bool_] | None] | None = None,
    ) -> None:
        self.geometry = geometry
        self.tracer = tracer
        self.cameras = cameras
        self.kept = list(kept or [None] * len(cameras))
        self._found = [0] * len(cameras)

    @classmethod
    def of(cls, geometry: Geometry, tracer: Tracer, views: Sequence[View]) -> Self:
        """By what photographs show: pixels of views that masks leave out, or that files do not have, show nothing."""
        return cls(geometry, tracer, [view.camera for view in views], [kept_pixels(view) for view in views])

    def by(self, index: int, si: SurfaceInteraction) -> tuple[Tensor, Tensor]:
        """Lanes [k] of ``si`` that camera ``index`` sees, and the unit directions [k, 3] from them to it."""
        camera = self.cameras[index]
        lanes = (si.valid & self.in_view(index, si.p)).nonzero().squeeze(-1)
        points = si[lanes]
        eye = torch.as_tensor(camera.to_world, dtype=si.p.dtype, device=si.p.device)[:3, 3]
        away = eye - points.p  # [k, 3]
        distance = torch.linalg.vector_norm(away, dim=-1)
        wi = away / distance.clamp_min(torch.finfo(away.dtype).tiny)[:, None]
        clear = ~self.tracer.occluded(*self.geometry.spawn_towards(points, wi, distance))
        return lanes[clear], wi[clear]

    def in_view(self, index: int, p: Tensor) -> Tensor:
        """Whether points [n, 3] lie in pixels of camera ``index`` that count, whatever is in between [n], bool."""
        camera, kept = self.cameras[index], self.kept[index]
        inside = in_view(camera, p)
        if kept is None:
            return inside
        x, y = project(camera, to_camera(camera, p)).nan_to_num(0.0).long().unbind(-1)
        counts = torch.from_numpy(kept).to(p.device)
        return inside & counts[y.clamp(0, camera.height - 1), x.clamp(0, camera.width - 1)]

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

    def at(self, index: int, p: Tensor) -> Tensor:
        """:meth:`by` for positions [n, 3] on surfaces of which no more is known: lanes [k]. Rays go from the camera to
        them and end shortly before.
        """
        camera = self.cameras[index]
        lanes = self.in_view(index, p).nonzero().squeeze(-1)
        eye = torch.as_tensor(camera.to_world, dtype=p.dtype, device=p.device)[:3, 3]
        towards = p[lanes] - eye
        distance = torch.linalg.vector_norm(towards, dim=-1)
        d = towards / distance.clamp_min(torch.finfo(p.dtype).tiny)[:, None]
        rays = Rays(eye.expand_as(d).contiguous(), d)
        return lanes[~self.tracer.occluded(rays, distance * (1.0 - SHADOW_MARGIN))]

    def any_at(self, p: Tensor) -> Tensor:
        """Whether at least one camera sees points [n, 3] that lie on surfaces: bool [n]."""
        seen = torch.zeros(len(p), dtype=torch.bool, device=p.device)
        for index in range(len(self.cameras)):
            left = (~seen).nonzero().squeeze(-1)
            seen[left[self.at(index, p[left])]] = True
        return seen
