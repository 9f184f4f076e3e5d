"""Two sets of materials along the same paths: what changes from one to the other, almost without noise.

Paths are sampled by the first; the second gives each the weight that it has there, its value over the first's density.
Common random numbers alone do not do that: once a path ends with one of the two, those that follow draw other numbers.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.protocols import BSDF, LobeKernels, Materials
from neurad.core.records import BSDFSample, Rays, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import SceneModel
from neurad.integrators.renderer import first_vertices
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.walk import Roulette, scatter, walk
from neurad.integrators.world import World


class CorrelatedBSDF(BSDF):
    """A BSDF whose directions are drawn as those of other surfaces are: values are of the surface that it is asked for,
    densities of the other. Means are right where the other reflects at all.

    Args:
        drawn: surfaces by which directions are drawn, at the lanes that it is asked for.
    """

    def __init__(self, bsdf: BSDF, drawn: Surface) -> None:
        self.bsdf, self.drawn = bsdf, drawn
        self.varying_weight, self.is_diffuse = bsdf.varying_weight, bsdf.is_diffuse

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value [n, 3] of the surface and density [n] of the other."""
        return self.bsdf.eval(surface, wo, wi), self.bsdf.pdf(self.drawn, wo, wi)

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` from three uniform numbers ``u`` [n, 3] by the other surface."""
        sample = self.bsdf.sample(self.drawn, wo, u)
        return BSDFSample.of(sample.wi, self.bsdf.eval(surface, wo, sample.wi), sample.pdf)

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights [n, 3]: that of the surface, whatever directions are drawn by."""
        return self.bsdf.mean_weight(surface, wo)

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> float | Tensor:
        """Probability that :meth:`sample` draws by the cosine [n]."""
        return self.bsdf.diffuse_fraction(self.drawn, wo)

    def kernels(self, surface: Surface) -> LobeKernels | None:
        """Compiled lobes; None where one of the surfaces has none."""
        own, drawn = self.bsdf.kernels(surface), self.bsdf.kernels(self.drawn)
        return None if own is None or drawn is None else _CorrelatedKernels(own, drawn, self.drawn)


@dataclass(frozen=True)
class _CorrelatedKernels:
    """Compiled lobes of a surface with densities and directions of another."""

    own: LobeKernels
    drawn: LobeKernels
    other: Surface
    takes_any_lanes = False

    def lobes(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """Lobes of the surface [5 or 7, n], the pdf that of the other surface."""
        out = self.own.lobes(surface, wo, wi)
        out[2] = self.drawn.lobes(self.other, wo, wi)[2]
        return out

    def direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        """Directions [n, 3] that the other surface draws from ``u`` [n, 3]."""
        return self.drawn.direction(self.other, wo, u)

    def mean_lobes(self, surface: Surface, cosine: Tensor) -> Tensor:
        """Integrals of the surface's own lobes [4 or 6, n]."""
        return self.own.mean_lobes(surface, cosine)


@dataclass(frozen=True)
class CorrelatedPaths:
    """Path tracing of two sets of materials along the same paths, the first as
    :func:`~neurad.integrators.renderer.path_tracer` traces it.
    """

    world: World
    materials: Materials
    """Paths are sampled by these."""
    others: Materials
    max_depth: int | None = 20
    rr_depth: int = 8
    rr_prob: float = 0.95

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """One-sample estimates of the radiance along camera rays, by both [n, 6]."""
        world, stream = self.world, Stream(seed, device=rays.o.device)
        first, lanes, si = first_vertices(world, rays, stream)
        emitted = world.emitted(first.si)
        both = [emitted, emitted.clone()]
        if len(lanes) > 0 and (self.max_depth is None or self.max_depth > 1):
            for radiance, reflected in zip(both, self._reflected(si, stream), strict=True):
                radiance.index_add_(0, lanes, reflected)
        return torch.cat([first.attenuate(radiance) for radiance in both], -1)

    def _reflected(self, si: SurfaceInteraction, stream: Stream) -> tuple[Tensor, Tensor]:
        """``sum_{i >= 1} T^i E`` at the lanes of ``si`` by both [n, 3]."""
        ratio = torch.ones_like(si.p)  # of both throughputs, by path [n, 3]
        own: list[tuple[Tensor, Tensor]] = []
        other: list[tuple[Tensor, Tensor]] = []
        u = stream.uniform(len(si), DIMENSIONS)
        roulette = Roulette(self.rr_depth, self.rr_prob)
        scene = SceneModel(self.world, self.materials)
        for v in walk(scene, si, self.materials(si), u, stream, roulette, self.max_depth):
            along = self.world.reflecting_by(CorrelatedBSDF(self.world.bsdf, v.surface))
            step = bounce(along, v.si, self.others(v.si), v.u)
            throughput = v.throughput * ratio[v.lane]
            own.append((v.lane, v.throughput * v.bounce.direct))
            other.append((v.lane, throughput * step.direct))
            weight = v.bounce.weight
            ratio[v.lane] *= torch.where(weight > 0, step.weight / weight, 0.0)
        return scatter(own, si.p), scatter(other, si.p)
