"""Smooth mirrors and glass: paths pass through them to the first other vertex."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from neurad.bsdf.delta import scatter
from neurad.bsdf.microfacet import fresnel_dielectric
from neurad.core.frame import Frame
from neurad.core.protocols import Tracer
from neurad.core.records import Constant, SurfaceInteraction
from neurad.runtime.lanes import all_lanes, lanes_of, put
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

MAX_CHAIN, MAX_FULL_CHAIN = 16, 8
"""Longest chain of delta vertices; what is left then (a mirror facing a mirror) counts as absorbed. The second number
where all lanes go on together, always as often."""


class DeltaSurfaces(nn.Module):
    """Which triangles are smooth, and how rays go on from them.

    Args:
        scene: its materials; the tint of a smooth one is constant.
        geometry: of the same scene.
    """

    is_delta: Tensor
    dielectric: Tensor
    two_sided: Tensor
    eta: Tensor
    tint: Tensor
    absorbed: Tensor
    """Chains so far that were longer than is followed."""

    def __init__(self, scene: Scene, geometry: Geometry) -> None:
        super().__init__()
        face = geometry.material
        lobes = [m.model.delta for m in scene.materials]
        tint = [m.albedo.value if isinstance(m.albedo, Constant) else [1.0, 1.0, 1.0] for m in scene.materials]
        glass = [lobe is not None and lobe.transmits for lobe in lobes]
        tables = {
            "is_delta": torch.tensor([lobe is not None for lobe in lobes]),
            "dielectric": torch.tensor(glass),
            "two_sided": torch.tensor([m.two_sided or g for m, g in zip(scene.materials, glass, strict=True)]),
            "eta": torch.tensor([1.0 if lobe is None else lobe.eta for lobe in lobes]),
            "tint": torch.stack([torch.as_tensor(t, dtype=torch.float32).expand(3) for t in tint]),
        }
        for name, table in tables.items():
            self.register_buffer(name, table[face], persistent=False)
        self.register_buffer("absorbed", torch.zeros((), dtype=torch.int64), persistent=False)

    def follow(
        self, geometry: Geometry, tracer: Tracer, si: SurfaceInteraction, u: Tensor
    ) -> tuple[SurfaceInteraction, Tensor, Tensor]:
        """Go on from lanes that ended on smooth surfaces until none does.

        Args:
            geometry: of the scene.
            tracer: of the scene.
            si: where rays ended.
            u: uniform numbers [n]; each is used again for the next choice of its lane, rescaled, which is exact.

        Returns:
            The first other vertices (or misses), the throughput of the chains [n, 3], and whether a lane passed
            anything [n].
        """
        throughput = torch.ones_like(si.p)
        via_delta = torch.zeros_like(si.valid)
        parts = {name: getattr(si, name) for name in si.__dataclass_fields__}
        for _ in range(MAX_FULL_CHAIN if all_lanes(u.device) else MAX_CHAIN):
            now = SurfaceInteraction(**parts)
            smooth = now.valid & self.is_delta[now.prim.clamp_min(0)]
            lanes = lanes_of(smooth)
            if lanes is None:
                return now, throughput, via_delta
            here = now[lanes]
            prim = here.prim.clamp_min(0)
            frame = Frame.around(here.n)
            wo = frame.to_local(here.wo)
            glass, eta = self.dielectric[prim], self.eta[prim]
            wi, weight = scatter(glass, wo, eta, self.tint[prim], u[lanes])
            u = put(u, smooth, lanes, _remaining(u[lanes], glass, wo, eta))
            d = torch.nn.functional.normalize(frame.to_world(wi), dim=-1)
            rays = geometry.spawn(here, d)
            end = geometry.interact(rays, tracer.closest(rays))
            front = self.two_sided[prim] | (wo[:, 2] > 0)  # a one-sided mirror is black from behind
            throughput = put(throughput, smooth, lanes, throughput[lanes] * weight * front.unsqueeze(-1))
            via_delta = via_delta | smooth
            parts = {name: put(values, smooth, lanes, getattr(end, name)) for name, values in parts.items()}
        now = SurfaceInteraction(**parts)
        stuck = now.valid & self.is_delta[now.prim.clamp_min(0)]
        self.absorbed += stuck.sum()
        throughput[stuck] = 0.0
        return replace(now, valid=now.valid & ~stuck), throughput, via_delta


def _remaining(u: Tensor, dielectric: Tensor, wo: Tensor, eta: Tensor) -> Tensor:
    """Uniform numbers left over [n] after ``u`` chose between reflection (u <= F) and transmission."""
    z = wo[:, 2]
    reflectance = fresnel_dielectric(z.abs().clamp_min(1e-6), torch.where(z > 0, eta, 1.0 / eta))
    left = torch.where(
        u > reflectance, (u - reflectance) / (1.0 - reflectance).clamp_min(1e-6), u / reflectance.clamp_min(1e-6)
    )
    return torch.where(dielectric, left.clamp(0.0, 1.0), u)
