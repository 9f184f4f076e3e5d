"""What a method estimates along camera rays, what its radiance field shows, and maps of materials."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.parameters import SurfaceParameter
from neurad.core.protocols import Materials
from neurad.core.records import Rays, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.method import Method, SceneModel, query_radiance
from neurad.integrators.path import PathTracing
from neurad.integrators.stratified import stratified_samples
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import NonDeltaHit, World


@dataclass(frozen=True)
class MethodRenderer:
    """The picture that a method compares with photographs: ``E`` plus its estimate of reflected light.

    With :class:`~neurad.integrators.radiometric.Radiometric` it is the paper's RHS rendering (Eq. 12), with
    :class:`~neurad.integrators.path.PathTracing` forward path tracing.
    """

    method: Method
    scene: SceneModel
    spread: int = 1
    """Rays in a row, those of a pixel, whose first bounces are spread evenly and not drawn one by one, where all rays
    make up such rows. Every bounce's numbers stay uniform."""

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """One-sample estimate of the radiance along camera rays [n, 3]."""
        stream = Stream(seed, device=rays.o.device)
        first, lane, si = first_vertices(self.scene.world, rays, stream)
        radiance = self.scene.world.emitted(first.si)  # [n, 3]
        if len(lane) > 0:
            if self.spread > 1 and len(rays) % self.spread == 0:
                u = stratified_samples(len(rays) // self.spread, self.spread, stream)[lane]
            else:
                u = stream.uniform(len(si), DIMENSIONS)
            sample = self.method.reflected(self.scene, si, self.scene.materials(si), u, stream)
            radiance.index_add_(0, lane, sample.value)
        return first.attenuate(radiance)


def first_vertices(world: World, rays: Rays, stream: Stream) -> tuple[NonDeltaHit, Tensor, SurfaceInteraction]:
    """Where camera rays [n] get to, which of them end on a surface [m], and their vertices [m]."""
    first = world.trace_past_delta(rays, stream.uniform(len(rays)))
    lane = first.si.valid.nonzero().squeeze(-1)
    return first, lane, first.si if len(lane) == len(rays) else first.si[lane]


@dataclass(frozen=True)
class FieldRenderer:
    """``E + L_theta``: what the radiance field itself shows, the paper's LHS rendering (Eq. 13)."""

    scene: SceneModel
    parts: bool = False
    """Give ``E`` beside it, in channels of its own."""

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Radiance along camera rays [n, 3 or 6]; without noise, but for the choice at glass that ``seed`` makes."""
        world, radiance = self.scene.world, self.scene.radiance
        assert radiance is not None
        first = world.trace_past_delta(rays, Stream(seed, device=rays.o.device).uniform(len(rays)))
        reflected = query_radiance(radiance, self.scene.materials, first.si)  # [n, 3]
        emitted = world.emitted(first.si)
        whole = first.attenuate(emitted + first.si.where_hit(reflected))
        return torch.cat((whole, first.attenuate(emitted)), -1) if self.parts else whole


@dataclass(frozen=True)
class MaterialMap:
    """Surface parameters at the first hit, one after the other [n, channels]; zero where nothing is hit."""

    world: World
    materials: Materials
    parameters: tuple[SurfaceParameter, ...]
    """Those of the scene."""

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Values along camera rays [n, channels]; without noise, so ``seed`` plays no part."""
        si = self.world.intersect(rays)
        return si.where_hit(self.materials(si).stacked(self.parameters))


def path_tracer(
    world: World, materials: Materials, max_depth: int | None = 20, rr_depth: int = 8, rr_prob: float = 0.95
) -> MethodRenderer:
    """Forward path tracing, the reference of everything; numbers as in :class:`PathTracing`."""
    return MethodRenderer(PathTracing(max_depth, rr_depth, rr_prob), SceneModel(world, materials))
