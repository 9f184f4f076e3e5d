"""What one training step estimates: the RHS image, the field at the same points, and the prior's two sides."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from neurad.core.records import Lanes, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import Method, RadianceEstimate, SceneModel, query_radiance
from neurad.integrators.radiometric import Radiometric, field_radiance
from neurad.integrators.stratified import stratified_samples


@dataclass(frozen=True)
class Estimator(SceneModel):
    """Estimates in a world with materials and, for the methods that read one, a radiance field."""

    method: Method = field(default_factory=Radiometric)

    def image(
        self, si: SurfaceInteraction, surface: Surface, count: int, stream: Stream, stratum_size: int = 1
    ) -> RadianceEstimate:
        """The method's estimate, ``count`` samples at every lane: lane i's are i*count .. (i+1)*count - 1.

        The samples of ``stratum_size`` neighbouring lanes are stratified, and independent of all others.
        """
        assert len(si) % stratum_size == 0
        u = stratified_samples(len(si) // stratum_size, stratum_size * count, stream)
        return self.method.reflected(self, si.repeat(count), surface.repeat(count), u, stream)

    def shown(self, si: SurfaceInteraction, surface: Surface, stream: Stream) -> Tensor:
        """Reflected radiance [n, 3] by the field, without noise, or else by the mean of four samples."""
        if self.radiance is not None:
            return si.where_hit(self.radiance(si, surface.albedo))
        return self.image(si, surface, 4, stream).value.view(len(si), 4, 3).mean(1)

    def reflected(
        self,
        si: SurfaceInteraction,
        surface: Surface,
        count: int,
        stream: Stream,
        field_gradient: bool = False,
        light_gradient: bool = True,
    ) -> Tensor:
        """``count`` stratified samples of ``T_hat(E + L_theta)`` [n, count, 3]: the right side of the prior (Eq. 10).

        The samples are differentiable in ``surface``; in theta only if ``field_gradient``. Without ``light_gradient``
        their direct part is fixed.
        """
        assert self.radiance is not None
        u = stratified_samples(len(si), count, stream)
        step = bounce(self.world, si.repeat(count), surface.repeat(count), u)
        if field_gradient:
            light = step.next.where_hit(query_radiance(self.radiance, self.materials, step.next))
        else:
            light = field_radiance(self.materials, self.radiance, step.next)
        value = step.reflected(light) if light_gradient else step.direct.detach() + step.weight * light
        return value.view(len(si), count, 3)


def subsample(lanes: Lanes, fraction: float, stream: Stream, count: int) -> Tensor:
    """Indices of a random ``fraction`` of the first hits, one random bounce of each: into lanes ordered by hit,
    ``count`` bounces a hit.
    """
    hits = len(lanes) // count
    keep = max(1, round(fraction * hits))
    device = stream.device
    chosen = (
        torch.randperm(hits, generator=stream.generator, device=device)[:keep]
        if keep < hits
        else torch.arange(hits, device=device)
    )
    return chosen * count + stream.integers(count, len(chosen))
