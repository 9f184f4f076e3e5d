"""Every ray against every triangle in float64: what the tracers are compared with."""

import torch
from torch import Tensor

from neurad.core.records import Hit, Rays
from neurad.tracing.arrays import no_hits

MAX_PAIRS = 1 << 20
"""Pairs of a ray and a triangle that are tested at once."""


class BruteForceTracer:
    """Closest-hit and occlusion queries in O(rays x triangles), for tiny scenes: vertices [V, 3], faces [F, 3]."""

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        self.corners = vertices.detach().double()[faces]  # [F, 3, 3]

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit with t > 0 of every ray, dense [n], on the rays' device."""
        if len(self.corners) == 0 or len(rays) == 0:
            return no_hits(len(rays), rays.o.device)
        step = max(1, MAX_PAIRS // len(self.corners))
        return Hit.cat(*(self._closest(rays[i : i + step]) for i in range(0, len(rays), step)))

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether anything lies in 0 < t < t_max [n] (infinity allowed): bool [n] on the rays' device."""
        return self.closest(rays).t < t_max

    def _closest(self, rays: Rays) -> Hit:
        t, u, v = self.intersect(rays)
        t, prim = t.min(-1)
        valid = torch.isfinite(t)
        u, v = (torch.where(valid, x.gather(-1, prim[:, None])[:, 0], 0.0).float() for x in (u, v))
        return Hit(t.float(), torch.where(valid, prim, -1), u, v, valid)

    def intersect(self, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Distances [n, F] in float64, infinity where a triangle is missed, and barycentrics u, v [n, F].

        Moeller and Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection".
        """
        corners = self.corners.to(rays.o.device)
        o, d = rays.o.detach().double()[:, None], rays.d.detach().double()[:, None]  # [n, 1, 3]
        p0, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]  # [F, 3]
        s = torch.linalg.cross(d, e2.expand(len(d), -1, -1))
        det = (s * e1).sum(-1)
        inverse = torch.where(det == 0, 0.0, 1.0 / det)
        to_o = o - p0
        u = (to_o * s).sum(-1) * inverse
        q = torch.linalg.cross(to_o, e1.expand_as(to_o))
        v = (d * q).sum(-1) * inverse
        t = (e2 * q).sum(-1) * inverse
        inside = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        return torch.where(inside, t, torch.inf), u, v
