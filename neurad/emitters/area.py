"""Emitting triangles."""

import math

import torch
from torch import Tensor, nn

from neurad.core.colour import luminance
from neurad.core.errors import InputError
from neurad.core.frame import dot
from neurad.core.records import EmitterSample, SurfaceInteraction
from neurad.core.sampling import uniform_triangle
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import GRAIN, split
from neurad.scene.geometry import Geometry


class AreaLights(nn.Module):
    """All emitting triangles of a scene as one :class:`~neurad.core.protocols.Emitter`.

    A triangle is chosen with probability proportional to area times luminance and a point uniformly on it. Light leaves
    on the side of the geometric normal only, or of triangles that are turned on the other. The radiance is
    differentiable in ``emission``, which starts as the scene's; the choice of triangles stays as it was built.

    Args:
        geometry: the triangles; those with non-zero ``emission`` and ``face_area`` are sampled.
        emission: radiance that leaves each triangle [F, 3], in place of the geometry's.
        turned: triangles that send light to their backs instead [F], bool.
        dark: none of them shines, so that samples have density 0: in a room that a flash alone lights.

    Raises:
        InputError: no emitting triangle has an area, and it is not ``dark``.
    """

    emission: Tensor
    pdf_area: Tensor
    face: Tensor
    cdf: Tensor
    table: Tensor
    turned: Tensor | None
    """None where no triangle is: kernels know of none."""

    def __init__(
        self, geometry: Geometry, emission: Tensor | None = None, turned: Tensor | None = None, dark: bool = False
    ) -> None:
        super().__init__()
        emission = geometry.emission if emission is None else emission
        emission = torch.zeros_like(emission) if dark else emission
        radiance = luminance(emission.double())
        power = radiance * geometry.face_area.double()
        face = power.nonzero().squeeze(-1)
        total = power.sum()
        if dark:
            face, total = torch.zeros(1, dtype=torch.int64), torch.ones_like(total)
        if len(face) == 0:
            raise InputError(
                "the scene's area lights cannot send light: every emitting triangle has zero area or is black"
            )
        cdf = (power[face] / total).cumsum(0)
        corner, p1, p2 = geometry.vertices[geometry.faces[face]].unbind(1)
        normal = geometry.face_normal[face]
        if turned is not None:
            normal = torch.where(turned[face, None], -normal, normal)
            turned = turned if bool(turned[face].any()) else None
        # corner, two edges and normal side by side: one gather brings everything that a sample needs
        table = torch.cat((corner, p1 - corner, p2 - corner, normal), -1)
        self.power = math.pi * float(power.sum())  # luminous
        for name, value in {
            "emission": emission,  # [F, 3]
            "pdf_area": torch.where(power > 0, radiance / total, 0.0).to(emission.dtype),  # [F], 1 / area
            "face": face,  # [k]
            "cdf": cdf[:-1],  # [k - 1]: the last step is left out, so that rounding never runs past the end
            "table": table,  # [k, 12]
        }.items():
            self.register_buffer(name, value.detach(), persistent=False)
        self.register_buffer("turned", turned, persistent=False)  # [F], or None

    @property
    def trains(self) -> bool:
        """Whether the radiance is recovered, and its derivative wanted now."""
        return False

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """A point on a triangle, seen from ``p`` [n, 3]; ``u`` [n, 3]: the point by the first two, the triangle by the
        third. The pdf is 0 where the point is seen from behind or edge-on.
        """
        k = self._choose(u[:, 2])
        bary = uniform_triangle(u[:, :2])
        corner, e1, e2, normal = self.table.index_select(0, k).view(-1, 4, 3).unbind(1)
        to_light = corner + bary[:, :1] * e1 + bary[:, 1:] * e2 - p
        squared = dot(to_light, to_light)
        distance = squared.sqrt()
        wi = to_light / distance.clamp_min(torch.finfo(p.dtype).tiny)[:, None]
        cos = -dot(normal, wi)
        face = self.face.index_select(0, k)
        lit = (cos > 0) & (squared > 0)
        pdf = torch.where(lit, self.pdf_area.index_select(0, face) * squared / torch.where(lit, cos, 1.0), 0.0)
        return EmitterSample(wi, distance, torch.where(lit[:, None], self.radiance_of(face), 0.0), pdf)

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Radiance [n, 3] that leaves the surface at ``si`` towards ``si.wo``; 0 from behind and where not valid.

        Hides ``Module.eval()``; modules around this one switch their mode through ``train(False)``, which still works.
        """
        if not use_kernel(not self.trains and self.turned is None, si.ng, si.wo, self.emission):
            return self.eval_reference(si)
        from neurad.emitters import area_kernels as kernels  # imported at first use: numba is slow to load

        out = torch.empty(len(si), 3)
        given = si.prim, si.valid, si.ng, si.wo, self.emission, out
        arrays = [x.contiguous().numpy() for x in given]
        split(lambda low, high: kernels.emitted(low, high, *arrays), len(si), GRAIN)
        return out

    def eval_reference(self, si: SurfaceInteraction) -> Tensor:
        """:meth:`eval` in plain torch, on any device and differentiable in ``emission``."""
        lit = si.valid & (self._cos(si) > 0)
        return torch.where(lit[:, None], self.radiance_of(si.prim.clamp_min(0)), 0.0)

    def radiance_of(self, face: Tensor) -> Tensor:
        """Radiance [n, 3] that leaves triangles [n]."""
        return self.emission.index_select(0, face)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Solid-angle density [n] at ``p`` [n, 3] of the direction that ended at ``si``: area density * d^2 / cos."""
        to_light = si.p - p
        cos = self._cos(si)
        lit = si.valid & (cos > 0)
        density = self.pdf_area.index_select(0, si.prim.clamp_min(0)) * dot(to_light, to_light)
        return torch.where(lit, density / torch.where(lit, cos, 1.0), 0.0)

    def _cos(self, si: SurfaceInteraction) -> Tensor:
        """Cosine [n] between ``si.wo`` and the side of the surface on which light leaves."""
        cos = dot(si.ng, si.wo)
        return cos if self.turned is None else torch.where(self.turned[si.prim.clamp_min(0)], -cos, cos)

    def chosen(self, u: Tensor) -> Tensor:
        """The triangle [n] that the third number [n] of a sample picks."""
        return self.face.index_select(0, self._choose(u))

    def _choose(self, u: Tensor) -> Tensor:
        """Row [n] among the emitting triangles for uniform numbers [n]."""
        return torch.searchsorted(self.cdf, u.to(self.cdf.dtype), right=True)
