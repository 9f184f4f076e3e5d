"""Smooth mirrors and glass: paths pass through them to the first other vertex, and shadow rays through panes."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from neurad.bsdf.delta import Smooth, scatter
from neurad.core.frame import Frame, dot
from neurad.core.protocols import Tracer
from neurad.core.records import Rays, SurfaceInteraction
from neurad.core.reflection import DielectricModel
from neurad.core.scene_records import Constant
from neurad.runtime.lanes import all_lanes, lanes_of, put
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

MAX_CHAIN, MAX_FULL_CHAIN = 16, 8
"""Longest chain of delta vertices; what is left then (a mirror facing a mirror) counts as absorbed. The second number
where all lanes go on together, always as often."""
STRAIGHT = 1e-3
"""Largest distance between the unit directions before and behind panes: what rounding makes of equal ones."""


class DeltaSurfaces(nn.Module):
    """Which triangles are smooth, and how rays go on from them.

    Emitter sampling looks through panes. Behind thin sheets a ray goes on where it was, so it finds all light there;
    behind a slab of glass it goes on in its direction, beside itself, so it finds light at infinity. All other chains
    are found by BSDF samples alone. Both techniques take the same way through the glass, so that their MIS weights
    add up to 1 on every path.

    Args:
        scene: its materials; the tint of a smooth one is constant.
    """

    is_delta: Tensor
    dielectric: Tensor
    thin: Tensor
    two_sided: Tensor
    eta: Tensor
    tint: Tensor
    begun: Tensor
    """Chains so far."""
    absorbed: Tensor
    """Those of them that were longer than is followed."""

    def __init__(self, scene: Scene, geometry: Geometry) -> None:
        super().__init__()
        face = geometry.material
        models = [m.model for m in scene.materials]
        glass = [model if isinstance(model, DielectricModel) else None for model in models]
        tint = [m.albedo.value if isinstance(m.albedo, Constant) else [1.0, 1.0, 1.0] for m in scene.materials]
        tables = {
            "is_delta": torch.tensor([model.is_delta for model in models]),
            "dielectric": torch.tensor([pane is not None for pane in glass]),
            "thin": torch.tensor([pane is not None and pane.thin for pane in glass]),
            "two_sided": torch.tensor([m.two_sided or isinstance(m.model, DielectricModel) for m in scene.materials]),
            "eta": torch.tensor([1.0 if pane is None else pane.eta for pane in glass]),
            "tint": torch.stack([torch.as_tensor(t, dtype=torch.float32).expand(3) for t in tint]),
        }
        for name, table in tables.items():
            self.register_buffer(name, table[face], persistent=False)
        for name in ("begun", "absorbed"):
            self.register_buffer(name, torch.zeros((), dtype=torch.int64), persistent=False)
        self.transmits = any(pane is not None for pane in glass)
        """Whether there is any glass."""

    def follow(
        self, geometry: Geometry, tracer: Tracer, si: SurfaceInteraction, u: Tensor
    ) -> tuple[SurfaceInteraction, Tensor, Tensor]:
        """Go on from lanes that ended on smooth surfaces until none does.

        Args:
            si: where rays ended.
            u: uniform numbers [n]; each is used again for the next choice of its lane, rescaled, which is exact.

        Returns:
            The first other vertices (or misses), the throughput of the chains [n, 3], and whether a lane passed
            something that emitter sampling does not look through [n].
        """
        begin = si.wo
        throughput = torch.ones_like(si.p)
        reflected, beside = torch.zeros(2, len(si), dtype=torch.bool, device=si.p.device).unbind()
        parts = {name: x for name in si.__dataclass_fields__ if (x := getattr(si, name)) is not None}
        for step in range(_longest(u)):
            now = SurfaceInteraction(**parts)
            smooth = self._smooth(now)
            if step == 0:
                self.begun += smooth.sum()
            lanes = lanes_of(smooth)
            if lanes is None:
                break
            here = now[lanes]
            lobe, wo, front, frame = self._at(here)
            reflectance = lobe.reflectance(wo[:, 2])
            wi, weight = scatter(lobe, wo, u[lanes])
            rays = geometry.spawn(here, _world(frame, wi))
            end = geometry.interact(rays, tracer.closest(rays))
            throughput = put(throughput, smooth, lanes, throughput[lanes] * weight * front.unsqueeze(-1))
            reflected = put(reflected, smooth, lanes, reflected[lanes] | (wo[:, 2] * wi[:, 2] > 0))
            beside = put(beside, smooth, lanes, beside[lanes] | ~lobe.thin)
            u = put(u, smooth, lanes, _remaining(u[lanes], lobe.dielectric, reflectance))
            parts = {name: put(values, smooth, lanes, getattr(end, name)) for name, values in parts.items()}
        now = SurfaceInteraction(**parts)
        hidden = reflected | (beside & (now.valid | ~_straight(begin, now.wo)))
        stuck = self._smooth(now)
        self.absorbed += stuck.sum()
        throughput[stuck] = 0.0
        return replace(now, valid=now.valid & ~stuck), throughput, hidden | stuck

    @torch.no_grad()
    def transmittance(self, geometry: Geometry, tracer: Tracer, rays: Rays, t_max: Tensor) -> Tensor:
        """Part of the light at ``t_max`` [n] that gets along rays [n] through panes and past nothing else [n]; behind a
        slab of glass the light has to be at infinity.
        """
        found, lane = torch.zeros_like(t_max), torch.arange(len(t_max), device=t_max.device)
        begin, carried, beside = rays.d, torch.ones_like(t_max), torch.zeros_like(t_max, dtype=torch.bool)
        for _ in range(_longest(t_max) + 1):
            hit = tracer.closest(rays)
            arrived = (hit.t >= t_max) & (~beside | (t_max.isinf() & _straight(begin, rays.d)))
            found = found.index_copy(0, lane, found[lane] + torch.where(arrived, carried, 0.0))
            here = hit.prim.clamp_min(0)
            passes = (hit.t < t_max) & self.dielectric[here]
            on = lanes_of(passes)
            if on is None:
                break
            si = geometry.interact(rays[on], hit[on])
            lobe, wo, _, frame = self._at(si)
            wi, weight = scatter(lobe, wo, torch.ones_like(carried[on]))
            through = torch.where(passes[on], (1.0 - lobe.reflectance(wo[:, 2])) * weight.mean(-1), 0.0)
            after = geometry.spawn(si, _world(frame, wi))
            t_max = t_max[on] - dot(after.o - rays.o[on], rays.d[on])
            begin, carried, beside, lane = begin[on], carried[on] * through, beside[on] | ~lobe.thin, lane[on]
            rays = after
        return found

    def _smooth(self, si: SurfaceInteraction) -> Tensor:
        """Lanes that ended on smooth surfaces [n], bool."""
        return si.valid & self.is_delta[si.prim.clamp_min(0)]

    def _at(self, si: SurfaceInteraction) -> tuple[Smooth, Tensor, Tensor, Frame]:
        """The surfaces at the lanes of ``si``, the local direction towards the viewer [n, 3], whether they are not
        seen from behind a mirror of one side, which is black [n], and the frame.
        """
        prim = si.prim.clamp_min(0)
        frame = Frame.around(si.n)
        wo = frame.to_local(si.wo)
        smooth = Smooth(self.dielectric[prim], self.thin[prim], self.eta[prim], self.tint[prim])
        return smooth, wo, self.two_sided[prim] | (wo[:, 2] > 0), frame


def _longest(like: Tensor) -> int:
    return MAX_FULL_CHAIN if all_lanes(like.device) else MAX_CHAIN


def _world(frame: Frame, wi: Tensor) -> Tensor:
    d: Tensor = torch.nn.functional.normalize(frame.to_world(wi), dim=-1)
    return d


def _straight(d: Tensor, other: Tensor) -> Tensor:
    """Whether unit directions [n, 3] are equal but for rounding [n]."""
    off = d - other
    return dot(off, off) < STRAIGHT**2


def _remaining(u: Tensor, dielectric: Tensor, reflectance: Tensor) -> Tensor:
    """Uniform numbers left over [n] after ``u`` chose between reflection (u <= F) and transmission."""
    left = torch.where(
        u > reflectance, (u - reflectance) / (1.0 - reflectance).clamp_min(1e-6), u / reflectance.clamp_min(1e-6)
    )
    return torch.where(dielectric, left.clamp(0.0, 1.0), u)
