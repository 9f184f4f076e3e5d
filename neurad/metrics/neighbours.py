"""What a surface that no photograph shows is likely to be: what is photographed of its mesh, first of all beside it."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.protocols import Tracer
from neurad.core.records import Camera, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.scene.geometry import Geometry

POINTS = 1 << 14
"""Points of photographed surface among which neighbours are looked for."""
NEAREST = 64
"""Neighbours that are averaged, each weighted by the inverse of its distance."""
LOCAL = 0.5
"""Part that these have in an answer. The mean of all that is photographed of the mesh has the rest: what was recovered
has errors and does not reach far."""
TURNED = 3.0
"""A neighbour at an angle counts as ``1 + TURNED (1 - cos)`` times as far away: 4 times one that faces to the side."""
_PAIRS = 1 << 22  # distances in memory at once
_STREAM = 53  # last number of the stream's key


class Neighbours:
    """Photographed points of every mesh.

    Args:
        geometry: the triangles.
        tracer: casts rays against them.
        cameras: the training cameras.
    """

    def __init__(self, geometry: Geometry, tracer: Tracer, cameras: list[Camera]) -> None:
        self.geometry, self.tracer, self.cameras = geometry, tracer, cameras

    @cached_property
    def points(self) -> SurfaceInteraction:
        """Random ones that the training views show, as many of each view; none without views."""
        device = self.geometry.vertices.device
        none = self.geometry.vertices.new_zeros(0)
        parts = [(torch.zeros(0, dtype=torch.int64, device=device), none, none, none.new_zeros(0, 3))]
        count = max(1, POINTS // max(len(self.cameras), 1))
        for index, camera in enumerate(self.cameras):
            xy = Stream(index, count, _STREAM, device=device).uniform(count, 2)
            rays = camera_rays(camera, xy * xy.new_tensor([camera.width, camera.height]))
            hit = self.tracer.closest(rays)
            lanes = (hit.prim >= 0).nonzero().squeeze(-1)
            parts.append((hit.prim[lanes].long(), hit.u[lanes], hit.v[lanes], -rays.d[lanes]))
        prim, u, v, wo = (torch.cat(column) for column in zip(*parts, strict=True))
        return self.geometry.interact_at(prim, u, v, wo, torch.ones_like(prim, dtype=torch.bool))

    @torch.no_grad()
    def guess(self, surface: Surface, si: SurfaceInteraction, pixel: Tensor) -> tuple[Tensor, Surface]:
        """Lanes [k] of ``si`` on meshes of which photographs show a part, and what they are guessed to be there.

        Args:
            surface: what was recovered at :attr:`points`.
            si: points that no photograph shows [n].
            pixel: number of the pixel that each is in [n]; the points of one pixel on one mesh have one answer.
        """
        mesh = self.geometry.mesh_index
        # ---------------------- One place for each pixel and mesh ----------------------
        key = pixel * (int(mesh.max()) + 1) + mesh[si.prim]
        places, of_place = torch.unique(key, return_inverse=True)
        first = torch.full_like(places, len(key)).scatter_reduce(
            0, of_place, torch.arange(len(key), device=key.device), "amin"
        )
        at = si[first]
        # ---------------------- Neighbours, mesh by mesh ----------------------
        shown = mesh[self.points.prim]  # [points]
        albedo, roughness = at.p.new_zeros(len(at), 3), at.p.new_zeros(len(at), 1)
        found = torch.zeros(len(at), dtype=torch.bool, device=key.device)
        for number in torch.unique(mesh[at.prim]).tolist():
            beside = (shown == number).nonzero().squeeze(-1)
            if len(beside) == 0:
                continue
            near = self.points[beside]
            values = (albedo, surface.albedo[beside]), (roughness, surface.roughness[beside])
            means = [value.mean(0) for _, value in values]
            mine = (mesh[at.prim] == number).nonzero().squeeze(-1)
            for lanes in mine.split(max(1, _PAIRS // len(near))):
                weight, index = _nearest(at[lanes], near)
                for (answer, value), mean in zip(values, means, strict=True):
                    answer[lanes] = torch.lerp(mean, (weight * value[index]).sum(1), LOCAL)
            found[mine] = True
        kept = found[of_place].nonzero().squeeze(-1)
        return kept, Surface(albedo[of_place[kept]], roughness[of_place[kept]])


def _nearest(at: SurfaceInteraction, near: SurfaceInteraction) -> tuple[Tensor, Tensor]:
    """Weights [n, k, 1] that sum to 1, and indices [n, k], of the points that lie nearest to each of some."""
    turned = 1.0 + TURNED * (1.0 - at.n @ near.n.T)
    index = (torch.cdist(at.p, near.p) * turned).topk(min(NEAREST, len(near)), largest=False).indices
    away = torch.linalg.vector_norm(at.p.unsqueeze(1) - near.p[index], dim=-1)  # products of matrices lose digits
    weight = 1.0 / (away * turned.gather(1, index)).clamp_min(torch.finfo(away.dtype).tiny ** 0.5)
    return (weight / weight.sum(1, keepdim=True)).unsqueeze(-1), index
