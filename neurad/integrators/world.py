"""Everything that light needs to travel through one scene, put together once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from neurad.bsdf.principled import Principled
from neurad.bsdf.table import BSDFTable
from neurad.core.frame import dot, faceforward
from neurad.core.protocols import BSDF, Emitter
from neurad.core.records import Flash, Rays, SurfaceInteraction, first_of
from neurad.core.rng import Stream
from neurad.emitters.punctual import FlashLight
from neurad.integrators.delta import DeltaSurfaces
from neurad.integrators.guide import Guide
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.lanes import where_needed
from neurad.scene.description import Features
from neurad.scene.geometry import Geometry
from neurad.tracing.counting import CountingTracer


@dataclass(frozen=True)
class Distinct:
    """Lanes of which some are the same point seen from the same place: what depends on that alone is found once."""

    lanes: Tensor
    """A lane for each point [k]."""
    source: Tensor
    """Number of each lane's point among these [n]."""

    def spread(self, values: Tensor) -> Tensor:
        """Values [n, c] of all lanes by those of the points [k, c]."""
        if use_kernel(values.requires_grad, values, differentiable=True):
            return _Spread.apply(values, self.source)  # type: ignore[no-untyped-call, no-any-return]
        return values.index_select(0, self.source)


class _Spread(torch.autograd.Function):
    """``values[source]``, whose gradients a compiled pass adds up: torch takes an operation a row."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, source: Tensor) -> Tensor:
        ctx.shape, ctx.source = values.shape, source
        return values.index_select(0, source)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        from neurad.scene import geometry_kernels as kernels  # compiled code is loaded by those who use it

        sums = torch.zeros(ctx.shape)
        kernels.add_rows(gradient.contiguous().numpy(), ctx.source.numpy(), sums.numpy())
        return sums, None


@dataclass(frozen=True)
class NonDeltaHit:
    """Where rays got to."""

    si: SurfaceInteraction
    """First vertices that are not smooth, misses included."""
    throughput: Tensor | None
    """Product of the weights of smooth surfaces on the way [n, 3]; None in a scene without any."""
    via_delta: Tensor | None
    """Whether there was one on the way that emitter sampling does not look through [n], bool."""
    distinct: Distinct | None = None
    """Which of the vertices are the same; None where that is not known."""

    def first(self, count: int, of: int) -> NonDeltaHit:
        """The first ``count`` of every ``of`` lanes."""
        throughput, via_delta = (
            None if x is None else first_of(x, count, of) for x in (self.throughput, self.via_delta)
        )
        return NonDeltaHit(self.si.first(count, of), throughput, via_delta)

    def attenuate(self, values: Tensor) -> Tensor:
        """``values`` [n, 3] dimmed by what lay on the way."""
        return values if self.throughput is None else values * self.throughput


class World(nn.Module):
    """Geometry, its tracer, the lights and the BSDF of a scene. Has no trainable parameters of its own.

    Args:
        tracer: casts rays against the same triangles, and counts them.
        bsdf: reflection model of all surfaces that are not delta.
        features: what the scene has; parts it does not have are skipped.
        two_sided: for each triangle, whether it reflects on both sides [F], bool.
        hide_environment: rays from the camera that miss see black, as in photographs whose alpha is below 1 there.
        delta: smooth surfaces, or None in a scene that has none.
        flash: the light that moves with the camera, or None.
    """

    two_sided: Tensor
    lambert: Tensor
    """Part of recovered surfaces that has Lambert's lobe, see :meth:`set_lambert`."""

    def __init__(
        self,
        geometry: Geometry,
        tracer: CountingTracer,
        lights: Emitter,
        bsdf: BSDF,
        features: Features,
        two_sided: Tensor,
        hide_environment: bool = False,
        delta: DeltaSurfaces | None = None,
        flash: FlashLight | None = None,
    ) -> None:
        super().__init__()
        self.geometry = geometry
        self.tracer = tracer
        self.lights = lights
        self.bsdf = bsdf
        self.features = features
        self.hide_environment = hide_environment
        self.delta = delta
        self.flash = flash
        self.guide: Guide | None = None
        """Where to look for indirect light; None looks by the BSDF alone."""
        self.register_buffer("two_sided", two_sided, persistent=False)
        self.register_buffer("lambert", torch.zeros(()))
        if isinstance(fitted := self._fitted_bsdf, Principled):
            self.lambert.fill_(fitted.lambert)
        self.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda module, _: module.set_lambert(float(module.lambert))
        )

    @property
    def _fitted_bsdf(self) -> BSDF:
        return self.bsdf.fitted if isinstance(self.bsdf, BSDFTable) else self.bsdf

    def set_lambert(self, part: float) -> None:
        """Let such a part of recovered surfaces have Lambert's lobe under a coat; none has in a Lambertian scene."""
        if isinstance(fitted := self._fitted_bsdf, Principled):
            self.lambert.fill_(part)
            fitted.lambert = part

    def under(self, lights: Emitter, features: Features | None = None, flash: bool = False) -> World:
        """A world of these surfaces under other lights, without a guide, which belongs to the present ones.

        Args:
            features: of the scene with them; None for the present ones.
            flash: whether what moves with the camera stays.
        """
        return self._with(lights, self.bsdf, features or self.features, self.flash if flash else None)

    def reflecting_by(self, bsdf: BSDF) -> World:
        """This world with another BSDF, without a guide, which belongs to the present one."""
        return self._with(self.lights, bsdf, self.features, self.flash)

    def _with(self, lights: Emitter, bsdf: BSDF, features: Features, flash: FlashLight | None) -> World:
        return World(
            self.geometry, self.tracer, lights, bsdf, features, self.two_sided, self.hide_environment, self.delta,
            flash,
        )  # fmt: skip

    def intersect(self, rays: Rays) -> SurfaceInteraction:
        """Where rays end, misses and smooth surfaces included."""
        return self.flashed(self.geometry.interact(rays, self.tracer.closest(rays)), rays.flash)

    def flashed(self, si: SurfaceInteraction, flash: Flash | None) -> SurfaceInteraction:
        """Surface points that know what they see of the flash of their photographs, by a shadow ray each; ``si`` itself
        where there is none.
        """
        if self.flash is None or flash is None:
            return si
        wi, distance, arriving = self.flash.seen_from(si.p, flash)
        shines = (arriving > 0) & (flash.intensity.amax(-1) > 0) & (dot(faceforward(si), wi) > 0)
        visible = self.unblocked(si, wi, distance, shines & si.valid)  # [n]
        return replace(si, flash=replace(flash, wi=wi, arriving=arriving * visible))

    def trace_past_delta(self, rays: Rays, u: Tensor) -> NonDeltaHit:
        """The first vertices along rays that are not smooth; ``u`` [n] are uniform numbers, one a ray."""
        if self.delta is None:
            return NonDeltaHit(self.intersect(rays), None, None)
        si = self.geometry.interact(rays, self.tracer.closest(rays))
        si, throughput, via_delta = self.delta.follow(self.geometry, self.tracer, si, u)
        return NonDeltaHit(self.flashed(si, rays.flash), throughput, via_delta)

    def visibility(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Part of the light at ``t_max`` [n] that gets along rays [n]: 1, or 0 where something lies before it, or what
        panes let through [n].
        """
        blocked = self.tracer.occluded(rays, t_max)
        clear = (~blocked).to(t_max.dtype)
        if self.delta is None or not self.delta.transmits:
            return clear
        glass, geometry, tracer = self.delta, self.geometry, self.tracer
        return where_needed(blocked, clear, lambda lane: glass.transmittance(geometry, tracer, rays[lane], t_max[lane]))

    def unblocked(self, si: SurfaceInteraction, wi: Tensor, distance: Tensor, active: Tensor) -> Tensor:
        """Part of the light ``distance`` [n] away along ``wi`` [n, 3] that gets to the ``active`` lanes, else 0."""
        rays, t_max = self.geometry.spawn_towards(si, wi, distance)
        t_max = torch.where(active, t_max, 0.0)  # a ray of no length costs a tracer nothing
        return where_needed(active, torch.zeros_like(t_max), lambda lane: self.visibility(rays[lane], t_max[lane]))

    def irradiance_samples(
        self, light: Emitter, si: SurfaceInteraction, count: int, stream: Stream
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Unit directions towards a light [n, 3], and the irradiance that each brings to the viewer's side of ``si``
        [n, 3]: their sum is that of this light alone.
        """
        n = faceforward(si)
        for _ in range(count):
            ds = light.sample(si.p, stream.uniform(len(si), 3))
            rays, t_max = self.geometry.spawn_towards(si, ds.wi, ds.distance)
            seen = torch.where(ds.pdf > 0, dot(n, ds.wi).clamp_min(0.0), 0.0) * self.visibility(rays, t_max)
            yield ds.wi, ds.radiance * (seen / (count * ds.pdf.clamp_min(1e-30)))[:, None]

    def reflects(self, si: SurfaceInteraction) -> Tensor:
        """Lanes whose surface can reflect towards ``si.wo`` [n], bool."""
        if not self.features.has_one_sided:
            return si.valid
        front = dot(si.n, si.wo) > 0
        return si.valid & (front | self.two_sided[si.prim.clamp_min(0)])

    def emitted(self, si: SurfaceInteraction) -> Tensor:
        """E: radiance that the camera sees without any reflection [n, 3]."""
        light = self.lights.eval(si)
        return si.where_hit(light) if self.hide_environment else light
