"""Photographs laid onto the surfaces that they show, so that they can be looked at from anywhere."""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from neurad.core.camera import project, to_camera
from neurad.core.frame import dot
from neurad.core.records import Rays, SurfaceInteraction
from neurad.core.scene_records import Development, View
from neurad.images.photographs import read_photograph
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy
from neurad.scene.geometry import Geometry

NEAREST = 12
"""Photographs that are looked at for one picture."""
MAX_PHOTOGRAPHS = 32
"""Photographs in memory."""
TOGETHER = (2, 8)
"""Lanes in a row of which one stands for those that lie on the same mesh."""
ALIKE = 0.98
"""Cosine between normals from which they count as one surface."""

OfLanes = Callable[[SurfaceInteraction], Tensor]
"""Values [n] of lanes, each of which has its own."""


@lru_cache(MAX_PHOTOGRAPHS)
def _read(path: str, development: Development) -> Tensor:
    """The colours of a photograph [1, 3, h, w]."""
    colours = read_photograph(path, development)[..., :3]
    return torch.from_numpy(np.ascontiguousarray(colours)).permute(2, 0, 1)[None]


class PhotographMap:
    """What photographs show of the surfaces along camera rays.

    Every surface point gets the colour that it has in the photograph, among the :data:`NEAREST` to the camera, that
    shows it from the most similar direction. Highlights therefore stay where the photograph saw them.
    """

    def __init__(self, world: World, views: Sequence[View]) -> None:
        self.world = world
        self.views = [view for view in views if view.image is not None]
        self.seen = SeenBy.of(world.geometry, world.tracer, self.views)

    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Radiance, and 1 where a photograph shows the surface or there is none, else 0: [n, 4]; without noise."""
        return self._colours(rays, lambda si, choose: choose(si))

    def quick(self, rays: Rays, seed: int) -> Tensor:
        """The same while the camera moves: neighbours take their colours from one photograph."""
        return self._colours(rays, partial(by_neighbours, self.world.geometry))

    @torch.no_grad()
    def _colours(self, rays: Rays, at: Callable[[SurfaceInteraction, OfLanes], Tensor]) -> Tensor:
        si = self.world.intersect(rays)
        nearest = self._nearest(rays)
        chosen = at(si, lambda points: self._chosen(points, nearest)).cpu()
        p = si.p.cpu()
        out = torch.zeros(len(si), 4)
        out[:, 3] = ((chosen >= 0) | ~si.valid.cpu()).float()
        for index in nearest:
            camera, image = self.views[index].camera, self.views[index].image
            assert image is not None
            lanes = (chosen == index).nonzero().squeeze(-1)
            if len(lanes) == 0:
                continue
            xy = project(camera, to_camera(camera, p[lanes])).float()
            size = torch.tensor([camera.width, camera.height])
            photograph = _read(image, self.views[index].development)
            colours = grid_sample(
                photograph, (2 * xy / size - 1)[None, None], padding_mode="border", align_corners=False
            )
            out[lanes, :3] = colours[0, :, 0].T
        return out.to(si.p.device)

    def _chosen(self, si: SurfaceInteraction, nearest: Sequence[int]) -> Tensor:
        """The photograph, of some, that shows each lane of ``si`` from the most similar direction [n]; -1 for none."""
        best = torch.where(si.valid, -2.0, 2.0)
        found = torch.full((len(si),), -1, device=si.p.device)
        for index in nearest:
            eye = torch.as_tensor(self.views[index].camera.to_world, dtype=si.p.dtype, device=si.p.device)[:3, 3]
            likeness = dot(normalize(eye - si.p, dim=-1), si.wo)
            better = (likeness > best).nonzero().squeeze(-1)  # only there it matters whether something is in between
            lanes = better[self.seen.at(index, si.p[better])]
            best[lanes], found[lanes] = likeness[lanes], index
        return found

    def _nearest(self, rays: Rays) -> list[int]:
        """Indices of the photographs taken nearest to a camera and in the most similar direction."""
        eye, ahead = rays.o[0].cpu().numpy(), rays.d.mean(0).cpu().numpy()
        poses = np.stack([view.camera.to_world for view in self.views])
        away = np.linalg.norm(poses[:, :3, 3] - eye, axis=-1) / max(self.world.geometry.scale, 1e-30)
        turned = 1.0 + poses[:, :3, 2] @ (ahead / max(float(np.linalg.norm(ahead)), 1e-30))
        return [int(index) for index in np.argsort(away + turned, kind="stable")[:NEAREST]]


def by_neighbours(geometry: Geometry, si: SurfaceInteraction, values: OfLanes) -> Tensor:
    """``values`` of the lanes of ``si`` [n], asked for at few of them.

    Of :data:`TOGETHER` lanes in a row the first stands for those that hit the same mesh where it faces the same way.
    """
    lane = torch.arange(len(si), device=si.p.device)
    mesh = torch.where(si.valid, geometry.mesh_index[si.prim.clamp_min(0)], -1)
    stands = lane
    for together in TOGETHER:
        first = lane - lane % together
        alike = (mesh == mesh[first]) & (dot(si.n, si.n[first]) > ALIKE)
        stands = torch.where(alike, first, stands)
    own, place = torch.unique(stands, return_inverse=True)
    return values(si[own])[place]
